"""CoR-GS (Zhang et al., ECCV 2024): two fields on the same views; each keeps the Gaussians that the other confirms.

Both start from the same Gaussians and see the same view at every step; they drift apart because each draws other splits.
The training's Gaussians are one field, which is also the result.  The other, the partner, is a second training, with
optimiser, density control and generator, which the method holds.

co-pruning      every `prune_every` steps after `prune_start`, after density control: a Gaussian of either field stays only if
                the other has one within `distance` of it, between the means; both fields are looked at before either changes
co-regularisation   after `pseudo_start` steps, at every step, for both fields:

    L = L_recon + weight l(I(P), I'(P))     I, I' the two fields' images, the other's constant; l the loss of training

P, the pseudo-view, is a random training camera m: its intrinsics, the rotation half way to that of the camera that is
nearest to it, n, and the centre t_m + noise r N(0, 1), r the cameras' mean distance from their centroid.

The published code (jiaw-z/CoR-GS, train.py) has the whole weight from the first step of the co-regularisation on: it works out
FSGS's ramp over 500 steps and does not apply it.  It differs from this in that it

    draws the centre of P from the box of the cameras and looks at a common focus, for which it needs a depth range;
    co-regularises at the steps 2000 to 10,000, here from 2001 to the end;
    resets opacities at the steps 2001, 5001, 8001, ..., and raises the SH degree every 500: here both are those of 3DGS.

distance 5 is the published threshold, in the units of COLMAP's reconstructions; it has to be chosen for scenes of another
size.  A step costs two of 3DGS and two renders at the pseudo-view.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf
from typing import Any, Literal

import scipy
import torch
from jaxtyping import Bool
from torch import Tensor

from landscape.errors import InputError
from splat.model.camera import Camera, slerp
from splat.model.gaussians import Gaussians
from splat.model.typed import Count, NonNegative, Positive
from splat.render.loss_and_gradient import LossAndGradient
from splat.scenes.view import View
from splat.training.densify import Densified
from splat.training.methods.agreement import agreement
from splat.training.state import Method, MethodSettings, Step, ThreeDGS, TrainConfig, Training


@dataclass(frozen=True)
class CoRGS(MethodSettings):
    """distance: world units; noise: in units of the cameras' mean distance from their centroid.

    prune_every, prune_start, pseudo_start: steps; weight: of the co-regularisation.  prune_every 0 leaves out
    the co-pruning, weight 0 the co-regularisation.
    """

    name: Literal["cor-gs"] = "cor-gs"
    prune_every: Count = 500
    prune_start: Count = 500
    distance: Positive = 5.0
    pseudo_start: Count = 2000
    weight: NonNegative = 1.0
    noise: NonNegative = 0.1

    def create(self, seed: int) -> "CoRGSMethod":
        return CoRGSMethod(self, seed)

    def parts(self, config: TrainConfig) -> dict[str, int]:
        pruning = {"prune_start": self.prune_start} if self.prune_every else {}
        return pruning | ({"pseudo_start": self.pseudo_start} if self.weight else {})


class CoRGSMethod(Method[CoRGS]):
    """partner: the other field's training, None before the first step.  history: how many Gaussians co-pruning removed."""

    partner: Training | None = None

    def on_start(self, training: Training, views: Sequence[View]) -> None:
        if self.partner is None:
            seed = int(torch.randint(2**63 - 1, (), generator=self.generator))
            config = replace(training.config, seed=seed, method=ThreeDGS())
            self.partner = Training.start(training.gaussians, training.extent, config)
        self.partner.move(training.gaussians.flat.device)  # one that was restored is on the CPU

    def gradient(self, step: Step, base: LossAndGradient) -> LossAndGradient:
        """The first field's; the partner makes its whole step here."""
        settings, partner = self.settings, self.partner
        assert partner is not None
        partner.raise_sh_degree(step.gaussians.sh_degree)
        other = step.loss_and_gradient(partner.gaussians)
        if settings.weight and step.number > settings.pseudo_start:
            pose = pseudo_view([view.camera for view in step.views], settings.noise, self.generator)
            if found := agreement(step, (step.gaussians, partner.gaussians), pose):
                base = replace(base, gradient=base.gradient + settings.weight * found.gradient(0))
                other = replace(other, gradient=other.gradient + settings.weight * found.gradient(1))
        partner.descend(other.gradient, step.number)
        partner.control_density(step.number, step.camera, other)
        partner.update_filter(step.number, [view.camera for view in step.views])
        partner.step = step.number
        return base

    def after_step(self, step: Step) -> None:
        settings, training, partner = self.settings, step.training, self.partner
        assert partner is not None
        if not settings.prune_every or step.number <= settings.prune_start or step.number % settings.prune_every:
            return
        own, theirs = training.gaussians, partner.gaussians
        keep = confirmed(own, theirs, settings.distance), confirmed(theirs, own, settings.distance)
        if not keep[0].any():  # then there is no pair at all, and none of the partner stays either
            raise InputError(
                f"expected Gaussians of the two fields within {settings.distance} of each other, got none at step "
                f"{step.number}; raise distance, which is in world units"
            )
        self.history.append(
            {"step": step.number, "pruned": int((~keep[0]).sum()), "partner_pruned": int((~keep[1]).sum())}
        )
        for each, stays in zip((training, partner), keep, strict=True):
            if not stays.all():
                each.replace_gaussians(_pruned(each.gaussians, stays))

    def state(self) -> dict[str, Any]:
        return {**super().state(), "partner": self.partner}

    def restore(self, state: dict[str, Any]) -> None:
        super().restore(state)
        if not isinstance(state["partner"], Training | None):
            raise InputError("'partner' is no training")
        self.partner = state["partner"]


def pseudo_view(cameras: Sequence[Camera], noise: float, generator: torch.Generator) -> Camera:
    """Between a random camera and the one whose centre is nearest to it; a single camera keeps its rotation."""
    m = int(torch.randint(len(cameras), (), generator=generator))
    jitter = noise * torch.randn(3, generator=generator, dtype=torch.float64)
    camera, centres = cameras[m], torch.stack([each.centre for each in cameras])
    apart = (centres - camera.centre).norm(dim=1)
    apart[m] = inf
    radius = (centres - centres.mean(dim=0)).norm(dim=1).mean()
    rotation = slerp(camera.rotation, cameras[int(apart.argmin())].rotation, 0.5)
    return replace(camera, rotation=rotation, centre=camera.centre + radius * jitter)


def confirmed(gaussians: Gaussians, others: Gaussians, distance: float) -> Bool[Tensor, " n"]:
    """Mask of the Gaussians with one of the others within this distance."""
    own, theirs = (each.means.cpu().double().numpy() for each in (gaussians, others))
    nearest, _ = scipy.spatial.KDTree(theirs).query(own)
    return torch.as_tensor(nearest <= distance).to(gaussians.flat.device)


def _pruned(gaussians: Gaussians, stays: Bool[Tensor, " n"]) -> Densified:
    kept = stays.nonzero()[:, 0]
    return Densified(gaussians.select(kept), kept, fresh=torch.zeros_like(kept, dtype=torch.bool))
