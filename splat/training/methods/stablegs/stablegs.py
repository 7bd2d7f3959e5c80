"""StableGS (Algorithm 1): training on the images of probed Gaussians, and on their agreement from probed viewpoints.

    L = L_recon(Theta) + asp_weight L_recon(Theta') + vsp_weight mean_k l(I_k(Theta), I_k(Theta'))      Eqs. (15), (21), (22)

Theta' is one probed copy of all Gaussians in all attributes (`attribute_probe.py`), new at every step and constant to the
derivative; k are probed viewpoints (`viewpoint_probe.py`), one for each training view or only for the sampled one; l is the
loss of training, between two renders.  Of the gradient in Theta, what comes from an image of Theta' is pulled back through
Eq. (14).  L_recon is the sampled view's, as Algorithm 1 has it.

Probing starts after `warm_up` steps.  Every `every` steps the magnitudes rho are worked out anew from the traces of the
Hessian's blocks over all training views, and with them the dominant occlusion edge of each view; both change slowly.  Density
control sees the sampled view's own gradient alone.  Where no training view sees a Gaussian, as 3DGS goes on, so does this:
with the last magnitudes and edges, or none.  The history notes it, and counts the probed viewpoints that see none.

Left out because it cannot matter: the traces of attributes that are not probed; the probed copy where every rho is 0; each
loss of weight 0; viewpoints that see nothing; the edges where nothing turns about them.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from landscape.traces.trace import PAPER, estimate_traces
from splat.curvature.hessian import SceneHessian
from splat.curvature.objective import NothingInSight
from splat.curvature.traces import exact_traces
from splat.losses.autograd import consistency_loss
from splat.model.camera import Camera
from splat.model.capture import capture_geometry
from splat.projection.reference import on_screen
from splat.render.loss_and_gradient import LossAndGradient, loss_and_gradient
from splat.render.render import render, render_depth
from splat.scenes.view import View
from splat.training.methods.stablegs.attribute_probe import (
    Attribute,
    Magnitude,
    Probed,
    ProbeSettings,
    magnitudes,
    probe_attributes,
)
from splat.training.methods.stablegs.occlusion_edge import dominant_edge
from splat.training.methods.stablegs.viewpoint_probe import ViewpointSettings, composite_pose
from splat.training.plain_types import fits, short
from splat.training.state import Method, Regularizer, Step, Training

# of the coupling between pixels: on a trained scene an error of 1% of the traces, seldom 10%; rho takes the root
SAMPLES = 4


@dataclass(frozen=True)
class StableGS(Method):
    """The paper's settings.

    warm_up: steps before probing starts; every: steps between two diagnoses (magnitudes and edges).
    asp_weight, vsp_weight: of the probed copy's loss, and of the agreement from probed viewpoints; 0 leaves it out.
    traces: "exact" but for a few samples, or "paper": Eq. (6)'s ten Gaussian samples a block.
    viewpoints: "all" is the paper's K = M probes a step, "one" K = 1, that of the sampled view.
    probe, viewpoint: of the attribute probes and of the viewpoint probes.
    """

    name: Literal["stablegs"] = "stablegs"
    warm_up: int = 1000
    every: int = 100
    asp_weight: float = 1.0
    vsp_weight: float = 0.5
    traces: Literal["exact", "paper"] = "exact"
    viewpoints: Literal["all", "one"] = "all"
    probe: ProbeSettings = field(default_factory=ProbeSettings)
    viewpoint: ViewpointSettings = field(default_factory=ViewpointSettings)

    def __post_init__(self) -> None:
        if self.warm_up < 0 or self.every < 1:
            raise ValueError(f"expected warm_up >= 0 and every >= 1, got {self.warm_up} and {self.every}")
        if not (0 <= self.asp_weight < float("inf") and 0 <= self.vsp_weight < float("inf")):
            raise ValueError(f"expected finite weights of at least 0, got {self.asp_weight} and {self.vsp_weight}")
        if self.traces not in ("exact", "paper") or self.viewpoints not in ("all", "one"):
            raise ValueError(
                f"expected traces 'exact' or 'paper' and viewpoints 'all' or 'one', got {self.traces!r} and "
                f"{self.viewpoints!r}"
            )

    def regularizer(self, seed: int) -> "StableRegularizer":
        return StableRegularizer(self, seed)


class StableRegularizer(Regularizer):
    """magnitudes: of the attributes that are probed; normals: of each training view's edges, pixels, 0 where it has none."""

    def __init__(self, settings: StableGS, seed: int):
        super().__init__(seed)
        self.settings = settings
        self.magnitudes: dict[str, Magnitude] = {}
        self.normals: list[Tensor] = []

    def begin(self, training: Training, views: Sequence[View]) -> None:
        if self.settings.vsp_weight:
            self.geometry = capture_geometry([view.camera for view in views])
        if len(self.normals) not in (0, len(views)):  # restored
            raise ValueError(
                f"expected an edge's normal for each of {len(views)} training views, found {len(self.normals)} in the saved "
                "training; take another copy of it, or train anew"
            )

    def gradient(self, step: Step, base: LossAndGradient) -> Float[Tensor, " p"]:
        settings = self.settings
        since = step.number - settings.warm_up - 1
        if since < 0 or (settings.asp_weight == settings.vsp_weight == 0):
            return base.gradient
        if since % settings.every == 0:
            self._diagnose(step)
        probed = probe_attributes(
            step.gaussians, base.gradient, step.camera, base.splats, self.magnitudes, settings.probe, self.generator
        )
        poses = self._poses(step)
        # without magnitudes the probed copy is the original: its gradient is known, and both agree from everywhere
        if not self.magnitudes:
            return (1 + settings.asp_weight) * base.gradient
        total = base.gradient.clone()
        if settings.asp_weight:
            again = loss_and_gradient(probed.gaussians, step.camera, step.loss, step.background, step.config.render)
            total.add_(probed.pull(again.gradient), alpha=settings.asp_weight)
        for pose in poses:
            if (disagreement := _disagreement(step, probed, pose)) is None:
                self._count_unseen(step)
            else:
                total.add_(disagreement, alpha=settings.vsp_weight / len(poses))
        return total

    def _diagnose(self, step: Step) -> None:
        """Magnitudes from the traces, and the edges."""
        settings, config, names = self.settings, step.config, self.settings.probe.on
        try:
            objective = config.objective(step.gaussians, step.views)
        except NothingInSight:
            self.history.append({"step": step.number, "note": "no Gaussian in sight: magnitudes kept"})
            return
        if not names:
            estimates = {}
        elif settings.traces == "exact":
            estimates = exact_traces(objective, self.generator, names=names, samples=SAMPLES)
        else:
            estimates = estimate_traces(SceneHessian(objective), self.generator, PAPER, names)
        self.magnitudes = magnitudes(
            {name: estimate.value for name, estimate in estimates.items()},
            len(objective.active),
            step.gaussians.sh_degree,
            step.training.extent,
            settings.probe,
        )
        for name, magnitude in self.magnitudes.items():
            self.history.append(
                {
                    "step": step.number,
                    "attribute": name,
                    **asdict(magnitude),
                    "standard_error": estimates[name].standard_error,
                    "capped": magnitude.capped,
                    "negative": magnitude.negative,
                }
            )
        if settings.vsp_weight and settings.viewpoint.edge_rotation:
            self.normals = [_edge_normal(step, view.camera) for view in step.views]

    def _count_unseen(self, step: Step) -> None:
        """One more probed viewpoint that sees nothing, in a row of its own after the last diagnosis."""
        if not self.history or "count" not in self.history[-1]:
            note = "probed viewpoints without a Gaussian in sight, until the next diagnosis"
            self.history.append({"step": step.number, "note": note, "count": 0})
        self.history[-1]["count"] += 1

    def _poses(self, step: Step) -> list[Camera]:
        """The viewpoints of this step."""
        settings = self.settings
        if not settings.vsp_weight:
            return []
        cameras = [view.camera for view in step.views]
        which = range(len(cameras)) if settings.viewpoints == "all" else [step.chosen]
        still = torch.zeros(2)
        return [
            composite_pose(
                cameras, m, self.normals[m] if self.normals else still, self.geometry, settings.viewpoint,
                generator=self.generator,
            )
            for m in which
        ]  # fmt: skip

    def state(self) -> dict[str, Any]:
        magnitudes = {name: asdict(magnitude) for name, magnitude in self.magnitudes.items()}
        return {**super().state(), "magnitudes": magnitudes, "normals": self.normals}

    def restore(self, state: dict[str, Any]) -> None:
        super().restore(state)
        if not fits(state["magnitudes"], dict[Attribute, dict[str, float]]):
            raise ValueError(
                f"expected numbers for the magnitude of each attribute, found {short(state['magnitudes'])}"
            )
        self.magnitudes = {name: Magnitude(**values) for name, values in state["magnitudes"].items()}
        self.normals = state["normals"]
        if type(self.normals) is not list or not all(isinstance(n, Tensor) and n.shape == (2,) for n in self.normals):
            raise ValueError(f"expected the normals as vectors of two numbers, found {short(self.normals)}")


def _edge_normal(step: Step, camera: Camera) -> Float[Tensor, "2"]:
    with torch.no_grad():
        return dominant_edge(*render_depth(step.gaussians, camera, step.config.render))[0]


def _disagreement(step: Step, probed: Probed, pose: Camera) -> Float[Tensor, " p"] | None:
    """The gradient of the loss between the images of the Gaussians and of their probed copy at a pose (Eq. (21)).

    None where neither has a Gaussian in sight there.
    """
    flats = [gaussians.flat.detach().requires_grad_() for gaussians in (step.gaussians, probed.gaussians)]
    renders = [render(step.gaussians.with_flat(flat), pose, step.background, step.config.render) for flat in flats]
    if not any(on_screen(each.splats.detach(), pose).any() for each in renders):
        return None
    loss = consistency_loss(renders[0].image, renders[1].image, step.config.loss)
    own, other = torch.autograd.grad(loss, flats)
    return own.add_(probed.pull(other))
