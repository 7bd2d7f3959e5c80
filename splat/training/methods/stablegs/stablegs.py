"""StableGS (Zhao et al., Algorithm 1): training on images of probed Gaussians, and on their agreement from probed viewpoints.

    L = L_recon(Theta) + asp_weight L_recon(Theta') + vsp_weight mean_k l(I_k(Theta), I_k(Theta'))      Eqs. (15), (21), (22)

Theta' is a probed copy of all Gaussians in all attributes (`attribute_probe.py`), new at every step.  The probe counts as
constant: gradients in Theta' are pulled back to Theta through Eq. (14).  k are probed viewpoints (`viewpoint_probe.py`), one
for each training view or only for the sampled one; l is the loss of training, between two renders.  L_recon is the loss of the
sampled view, as in Algorithm 1.  There is no released code.

Probing starts after `warm_up` steps.  A diagnosis every `every` steps computes the magnitudes rho from the traces of the
Hessian's blocks over all training views, and the dominant occlusion edge of each view; both change slowly.  Density control
uses the gradient of the sampled view only.  Where no training view sees a Gaussian, training continues with the last magnitudes
and edges, or none.  The history notes this, and counts the probed viewpoints that see no Gaussian.

Schedule.  The paper trains for 10,000 steps, 1,000 of them warm-up (Sec. 4, Algorithm 1).  Algorithm 1 densifies only after the
warm-up (line 18), but the text builds on 3DGS, which begins after step 500: `densify_after_warm_up` chooses.  In a training of
another length T, `StableGS.scaled` multiplies the warm-up and the first and last step of density control by T / 10,000, so that
probing and densification overlap as in the paper; `landscape train` does so for settings that are not given.  The steps between
two densifications and between resets of the opacities stay: in this time Gaussians move and become opaque again, whatever T.

Accuracy.  tr H_b has an exact part and a sampled one (`splat/curvature/traces.py`).  The number of samples, from 8 to
MOST_SAMPLES, is such that the 95% interval of rho is within `accuracy`; rho depends on the root of the trace.  A trace that
almost cancels can miss the accuracy: its standard error is in the history.

Left out because it has no effect: the traces of attributes that are not probed; the probed copy where every rho is 0; each loss
of weight 0; viewpoints that see nothing; the edges without edge rotation.
"""

from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass, field, replace
from math import inf
from typing import Annotated, Any, Literal

import torch
from msgspec import Meta
from torch import Tensor

from landscape.errors import InputError
from landscape.traces.estimate import TraceEstimate
from landscape.traces.hutchinson import TraceSettings
from landscape.traces.trace import PAPER, estimate_traces
from splat.curvature.hessian import SceneHessian
from splat.curvature.objective import NothingInSight, SceneObjective
from splat.curvature.traces import LEAST_SAMPLES, exact_traces
from splat.model.camera import Camera
from splat.model.capture import capture_geometry
from splat.model.typed import Count, Length, NonNegative, typed
from splat.render.loss_and_gradient import LossAndGradient
from splat.render.render import render_depth
from splat.scenes.view import View
from splat.training.densify import DensifySettings
from splat.training.methods.agreement import agreement_gradients
from splat.training.methods.stablegs.attribute_probe import (
    Attribute,
    Magnitude,
    ProbeSettings,
    magnitudes,
    probe_attributes,
)
from splat.training.methods.stablegs.occlusion_edge import dominant_edge
from splat.training.methods.stablegs.viewpoint_probe import ViewpointSettings, composite_pose
from splat.training.state import Method, MethodSettings, Step, TrainConfig, Training

PAPERS_STEPS = 10_000
MOST_SAMPLES = 64  # of a trace


@dataclass(frozen=True)
class StableGS(MethodSettings):
    """Settings of StableGS; by default the paper's.

    warm_up: steps before probing starts; every: steps between two diagnoses (magnitudes and edges).
    asp_weight, vsp_weight: of the probed copy's loss, and of the agreement from probed viewpoints; 0 leaves it out.
    traces: "exact": only the coupling between pixels is sampled; "paper": Eq. (6), ten Gaussian samples a block.
    accuracy: of rho with "exact" traces, relative, with 95% confidence; inf takes the fewest samples, four.
    viewpoints: "all" is the paper's K = M probes a step, "one" K = 1, that of the sampled view.
    densify_after_warm_up: Gaussians are cloned, split and removed only after the warm-up.
    probe, viewpoint: of the attribute probes and of the viewpoint probes.
    """

    name: Literal["stablegs"] = "stablegs"
    warm_up: Count = 1000
    every: Length = 100
    asp_weight: NonNegative = 1.0
    vsp_weight: NonNegative = 0.5
    traces: Literal["exact", "paper"] = "exact"
    accuracy: Annotated[float, Meta(gt=0)] = 0.05
    viewpoints: Literal["all", "one"] = "all"
    densify_after_warm_up: bool = False
    probe: ProbeSettings = field(default_factory=ProbeSettings)
    viewpoint: ViewpointSettings = field(default_factory=ViewpointSettings)

    def create(self, seed: int) -> Method:
        return StableGSMethod(self, seed)

    def parts(self, config: TrainConfig) -> dict[str, int]:
        # without a probed attribute both losses compare the Gaussians with themselves
        return {"warm_up": self.warm_up} if self.probe.on and (self.asp_weight or self.vsp_weight) else {}

    def density_control(self, config: TrainConfig) -> DensifySettings:
        if not self.densify_after_warm_up:
            return config.densify
        start = max(config.densify.begins(config.iterations), self.warm_up)
        return replace(config.densify, start=start, start_share=1.0)

    def scaled(self, config: TrainConfig, keep: Collection[str] = ()) -> TrainConfig:
        def steps(name: str, value: int) -> int:
            return value if name in keep else round(value * config.iterations / PAPERS_STEPS)

        density = config.densify
        density = replace(
            density, start=steps("densify.start", density.start), stop=steps("densify.stop", density.stop)
        )
        return replace(config, densify=density, method=replace(self, warm_up=steps("warm_up", self.warm_up)))


class RhoAccuracy(TraceSettings):
    """Settings of traces for rho: a trace is also accurate enough once its interval is below 0, where rho is at its cap."""

    def reached(self, value: float, low: float, high: float) -> bool:
        return high <= 0 or super().reached(value, low, high)


class StableGSMethod(Method[StableGS]):
    """Training with StableGS.

    magnitudes: of the probed attributes, by name.  normals: (x, y) in pixels of each training view's edge, 0 where it has none.
    """

    def __init__(self, settings: StableGS, seed: int):
        super().__init__(settings, seed)
        self.magnitudes: dict[str, Magnitude] = {}
        self.normals: list[Tensor] = []

    def on_start(self, training: Training, views: Sequence[View]) -> None:
        if self.settings.vsp_weight:
            self.geometry = capture_geometry([view.camera for view in views])
        if len(self.normals) not in (0, len(views)):  # from a saved state
            raise InputError(
                f"expected an edge's normal for each of {len(views)} training views, found {len(self.normals)} in the saved "
                "training; take another copy of it, or train anew"
            )

    def gradient(self, step: Step, base: LossAndGradient) -> LossAndGradient:
        settings = self.settings
        since = step.number - settings.warm_up - 1
        if since < 0 or (settings.asp_weight == settings.vsp_weight == 0):
            return base
        if since % settings.every == 0:
            self._diagnose(step)
        probed = probe_attributes(
            step.gaussians, base.gradient, step.camera, base.splats, self.magnitudes, settings.probe, self.generator
        )
        poses = self._poses(step)
        # without magnitudes the probed copy equals the original: same gradient, and no disagreement from any viewpoint
        if not self.magnitudes:
            return replace(base, gradient=(1 + settings.asp_weight) * base.gradient)
        total = base.gradient.clone()
        if settings.asp_weight:
            of_probed = step.loss_and_gradient(probed.gaussians)
            total.add_(probed.pull(of_probed.gradient), alpha=settings.asp_weight)
        for pose in poses:
            if found := agreement_gradients(step, (step.gaussians, probed.gaussians), pose):
                disagreement = found[0].add_(probed.pull(found[1]))
                total.add_(disagreement, alpha=settings.vsp_weight / len(poses))
            else:
                self._count_unseen(step)
        return replace(base, gradient=total)

    def _diagnose(self, step: Step) -> None:
        """Compute the magnitudes, which go to the history too, and the normals of the edges."""
        settings = self.settings
        try:
            objective = step.config.objective(step.gaussians, step.views)
        except NothingInSight:
            self.history.append({"step": step.number, "note": "no Gaussian in sight: magnitudes kept"})
            return
        estimates = self.traces(objective)
        values, active = {name: estimate.value for name, estimate in estimates.items()}, len(objective.active)
        degree, extent = step.gaussians.sh_degree, step.training.extent
        self.magnitudes = magnitudes(values, active, degree, extent, settings.probe)
        for name, magnitude in self.magnitudes.items():
            row = {"step": step.number, "attribute": name, **asdict(magnitude)}
            row["standard_error"] = estimates[name].standard_error
            self.history.append(row | {"capped": magnitude.capped, "negative": magnitude.negative})
        if settings.vsp_weight and settings.viewpoint.edge_rotation:
            with torch.no_grad():
                depths = (render_depth(step.gaussians, view.camera, step.config.render) for view in step.views)
                self.normals = [dominant_edge(depth, alpha)[0] for depth, alpha in depths]

    def traces(self, objective: SceneObjective) -> dict[str, TraceEstimate]:
        """Traces of the Hessian's blocks of the probed attributes."""
        settings, names = self.settings, self.settings.probe.on
        if not names:
            return {}
        if settings.traces == "paper":
            return estimate_traces(SceneHessian(objective), self.generator, PAPER, names)
        if settings.accuracy == inf:
            return exact_traces(objective, self.generator, names=names, samples=LEAST_SAMPLES)
        enough = RhoAccuracy(rtol=2 * settings.accuracy, max_probes=MOST_SAMPLES)
        return exact_traces(objective, self.generator, enough, names=names)

    def _count_unseen(self, step: Step) -> None:
        """Count a probed viewpoint that sees nothing, in a row of the history after the last diagnosis."""
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
        return [
            composite_pose(
                cameras, m, self.normals[m] if self.normals else torch.zeros(2), self.geometry, settings.viewpoint,
                generator=self.generator,
            )
            for m in which
        ]  # fmt: skip

    def state(self) -> dict[str, Any]:
        magnitudes = {name: asdict(magnitude) for name, magnitude in self.magnitudes.items()}
        return {**super().state(), "magnitudes": magnitudes, "normals": self.normals}

    def restore(self, state: dict[str, Any]) -> None:
        super().restore(state)
        self.magnitudes = typed(dict[Attribute, Magnitude], state["magnitudes"], "magnitudes")
        self.normals = typed(list[Tensor], state["normals"], "normals")
        if not all(normal.shape == (2,) for normal in self.normals):
            raise InputError("'normals': expected vectors of two numbers")
