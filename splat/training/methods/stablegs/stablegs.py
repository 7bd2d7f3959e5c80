"""StableGS (Zhao et al., Algorithm 1): training on images of probed Gaussians, and on their agreement from probed viewpoints.

    L = L_recon(Theta) + asp_weight L_recon(Theta') + vsp_weight mean_k l(I_k(Theta), I_k(Theta'))      Eqs. (15), (21), (22)

Theta' is a probed copy of all Gaussians in all attributes (`attribute_probe.py`), new at every step.  Its steps count as
constant: Eq. (14), Theta' = Theta + steps, gives gradients in Theta' to Theta as they are, those of quaternions turned back.
L_recon compares renders with photographs: of one view, for Theta' with asp_views = "all" of all M training views.  k is one
of K probed viewpoints (`viewpoint_probe.py`); l is the loss of training, between two renders.  There is no released code.

Probing starts after `warm_up` steps.  A diagnosis every `every` steps computes the magnitudes rho = c / (tau + eps), tau =
sqrt(max(tr H_b, 0) / dim) (Eq. (5); dim: `ProbeSettings.dimension`), from the traces of the Hessian's blocks H_b over all
training views, and the dominant occlusion edge of each view; both change slowly.  Density control is that of 3DGS, by the
gradient of the sampled view only.  Where no training view sees a Gaussian, training continues with the last magnitudes and
edges, or none.  The history notes this, and counts the probed viewpoints that see no Gaussian.

What the paper leaves open (more in `attribute_probe.py` and `viewpoint_probe.py`):

    setting                default    what speaks for it                        what the other changes
    vsp_gradient           both       Eq. (22) is differentiated whole, and     "probed": the base render is a target; one
                                      Eq. (21) depends on Theta twice           backward pass less, another direction
    asp_views              sampled    Algorithm 1, lines 9 and 13               "all": Eq. (15); M renders a step, not 1
    viewpoints             one        one drawn at random has Eq. (21) as mean   "all": Sec. 3.4, K = M; 2 M renders, not 2
    probe.rotation_unit    radian     omega of Eq. (9) is an angle              "quaternion": the unit of tr(H_q); turns twice
                                                                                as far, up to the cap
    probe.dose             constants  one c = 0.01 for all (Sec. 4)             "equal": one rise of the loss for all
    densify_after_warm_up  false      "we build on 3DGS", from step 500 on      true: Algorithm 1, line 18

The same expectation for less; with sampled_every about the same, as a ratio is kept while the scene changes:

    viewpoints = "one"     drawn independently of the sampled view: the probe depends on that view, and always to pair the two
                           would change the mean of Eq. (21)
    antithetic             two steps share the random numbers of the probe, with opposite signs: half the draws
    sampled_every          the sampled part of a trace (see Accuracy) is new in one of so many diagnoses; the others take its
                           last ratio to an exact part
    vsp_share              the share of the steps that probe viewpoints, by chance, with the weight vsp_weight / vsp_share

Schedule.  The paper trains for 10,000 steps, 1,000 of them warm-up (Sec. 4, Algorithm 1).  In a training of another length T,
`StableGS.scaled` multiplies the warm-up by T / 10,000; `landscape train` does so unless it is given.

Accuracy.  tr H_b has an exact part and a sampled one (`splat/curvature/traces.py`).  The number of samples, from 8 to
MOST_SAMPLES (four where `accuracy` is inf), is such that the 95% interval of rho is within `accuracy`; rho goes like the
inverse root of the trace.  A trace that almost cancels can miss the accuracy: its standard error is in the history.

Left out because it has no effect: the traces of attributes that are not probed; each loss of weight 0; viewpoints that see
nothing; the edges without edge rotation.
"""

from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass, field, replace
from math import inf
from typing import Annotated, Any, Literal

import torch
from jaxtyping import Float
from msgspec import Meta
from torch import Tensor

from landscape.errors import InputError
from landscape.traces.estimate import TraceEstimate
from landscape.traces.hutchinson import TraceSettings
from landscape.traces.trace import PAPER, estimate_traces
from splat.curvature.hessian import SceneHessian
from splat.curvature.objective import NothingInSight, SceneObjective
from splat.curvature.traces import LEAST_SAMPLES, carried_traces, coupling_ratios, exact_traces
from splat.model.camera import Camera, capture_geometry
from splat.model.gaussians import Gaussians
from splat.model.typed import LARGEST, Count, Length, NonNegative, typed
from splat.render.loss_and_gradient import LossAndGradient
from splat.render.render import render_depth
from splat.scenes.view import View
from splat.training.densify import DensifySettings
from splat.training.methods.agreement import agreement
from splat.training.methods.dropout import rising_dropout
from splat.training.methods.stablegs import attribute_probe as asp
from splat.training.methods.stablegs.viewpoint_probe import ViewpointSettings, composite_pose, dominant_edge
from splat.training.state import Method, MethodSettings, Step, TrainConfig, Training

PAPERS_STEPS = 10_000
MOST_SAMPLES = 64  # of a trace
Ratio = Annotated[float, Meta(ge=-LARGEST, le=LARGEST)]


@dataclass(frozen=True)
class StableGS(MethodSettings):
    """Settings of StableGS; where the defaults differ from the paper's, the module says so.

    warm_up: steps before probing starts; every: steps between two diagnoses (magnitudes and edges).
    asp_weight, vsp_weight: of the probed copy's loss, and of the agreement from probed viewpoints; 0 leaves it out, both 0
    leave nothing of the probing.
    traces: "exact": only the coupling between pixels is sampled, and that in one of sampled_every diagnoses; "paper": Eq. (6),
    ten Gaussian vectors a block, in every diagnosis.
    accuracy: of rho with "exact" traces, relative, with 95% confidence; inf takes the fewest samples, four.
    densify_after_warm_up: Gaussians are cloned, split and removed only after the warm-up.
    drop_share: p_max of DropGaussian, which leaves Gaussians out of the sampled view's render from the first step on; not the
    paper's, and 0 by default: with both weights 0 the training is DropGaussian's.
    probe, viewpoint: of the attribute probes and of the viewpoint probes.  The others: the table of the module.
    """

    name: Literal["stablegs"] = "stablegs"
    warm_up: Count = 1000
    every: Length = 100
    asp_weight: NonNegative = 1.0
    vsp_weight: NonNegative = 0.5
    traces: Literal["exact", "paper"] = "exact"
    accuracy: Annotated[float, Meta(gt=0)] = 0.05
    sampled_every: Length = 10
    asp_views: Literal["sampled", "all"] = "sampled"
    viewpoints: Literal["all", "one"] = "one"
    vsp_gradient: Literal["both", "probed"] = "both"
    vsp_share: Annotated[float, Meta(gt=0, le=1)] = 1.0
    antithetic: bool = True
    densify_after_warm_up: bool = False
    drop_share: Annotated[float, Meta(ge=0, lt=1)] = 0.0
    probe: asp.ProbeSettings = field(default_factory=asp.ProbeSettings)
    viewpoint: ViewpointSettings = field(default_factory=ViewpointSettings)

    def create(self, seed: int) -> Method:
        return StableGSMethod(self, seed)

    def parts(self, config: TrainConfig) -> dict[str, int]:
        # without a probed attribute the copy is the original, and only a factor of the gradient changes
        return {"warm_up": self.warm_up} if self.probe.on and (self.asp_weight or self.vsp_weight) else {}

    def density_control(self, config: TrainConfig) -> DensifySettings:
        if not self.densify_after_warm_up:
            return config.densify
        start = max(config.densify.begins(config.iterations), self.warm_up)
        return replace(config.densify, start=start, start_share=1.0)  # it begins after min(start, start_share T)

    def scaled(self, config: TrainConfig, keep: Collection[str] = ()) -> TrainConfig:
        warm_up = round(self.warm_up * config.iterations / PAPERS_STEPS)
        return config if "warm_up" in keep else replace(config, method=replace(self, warm_up=warm_up))


class RhoAccuracy(TraceSettings):
    """Settings of traces for rho: a trace is also accurate enough once its interval is below 0, where rho is at its cap."""

    def reached(self, value: float, low: float, high: float) -> bool:
        return high <= 0 or super().reached(value, low, high)


class StableGSMethod(Method[StableGS]):
    """Training with StableGS.

    magnitudes: of the probed attributes, by name.  normals: unit normal (x, y) of each view's dominant edge, 0 where it
    has none.  coupling: by attribute, the sampled part of its trace over an exact part, and its standard error.  pair: seeds of
    the last probe and its number of parameters, where the next step takes the opposite probe.
    """

    def __init__(self, settings: StableGS, seed: int):
        super().__init__(settings, seed)
        self.magnitudes: dict[str, asp.Magnitude] = {}
        self.normals: list[Tensor] = []
        self.coupling: dict[str, tuple[float, float]] = {}
        self.pair: tuple[list[int], int] | None = None
        self._drawn: dict[str, Tensor] | None = None  # of the pair; drawn again from its seeds after a resume

    def on_start(self, training: Training, views: Sequence[View]) -> None:
        if self.settings.vsp_weight:
            self.geometry = capture_geometry([view.camera for view in views])
        if len(self.normals) not in (0, len(views)):  # from a saved state
            raise InputError(
                f"expected an edge's normal for each of {len(views)} training views, found {len(self.normals)} in the saved "
                "training; take another copy of it, or train anew"
            )

    def opacity_scale(self, step: Step) -> Float[Tensor, " n"] | None:
        share = self.settings.drop_share
        return rising_dropout(step, share, self.generator) if share else None

    def gradient(self, step: Step, base: LossAndGradient) -> LossAndGradient:
        settings = self.settings
        since = step.number - settings.warm_up - 1
        if since < 0 or (settings.asp_weight == settings.vsp_weight == 0):
            return base
        if since % settings.every == 0:
            self._diagnose(step, sampled=(since // settings.every) % settings.sampled_every == 0)
        # without magnitudes the probed copy equals the original, and agrees with it from everywhere; the gradient at hand
        # stands for that of its render, also with asp_views = "all" and where Gaussians are dropped
        if not self.magnitudes:
            return replace(base, gradient=(1 + settings.asp_weight) * base.gradient)
        draws, sign = self._draws(step.gaussians)
        probed = asp.probe_attributes(
            step.gaussians, base.gradient, step.camera, base.splats, self.magnitudes, settings.probe, draws, sign
        )
        in_base, in_probed = None, None  # gradients: of the agreement in Theta, of both losses in Theta'
        if settings.asp_weight:
            views = range(len(step.views)) if settings.asp_views == "all" else [step.chosen]
            for m in views:
                found = step.of_view(m, probed.gaussians).gradient
                in_probed = _plus(in_probed, found, settings.asp_weight / len(views))
        poses = self._poses(step)
        for pose in poses:
            compared = agreement(step, (step.gaussians, probed.gaussians), pose)
            if compared is None:
                self._count_unseen(step)
                continue
            weight = settings.vsp_weight / (settings.vsp_share * len(poses))
            in_probed = _plus(in_probed, compared.gradient(1), weight)  # 1: in Theta', 0: in Theta
            if settings.vsp_gradient == "both":
                in_base = _plus(in_base, compared.gradient(0), weight)
        total = base.gradient if in_probed is None else base.gradient + probed.pull(in_probed)
        return replace(base, gradient=total if in_base is None else total.add_(in_base))

    def _draws(self, gaussians: Gaussians) -> tuple[dict[str, Tensor], float]:
        """The numbers of `draw_steps` for this step, and their sign."""
        pair, drawn = self.pair, self._drawn
        self.pair = self._drawn = None
        if pair and pair[1] == gaussians.flat.numel():
            return (drawn or asp.draw_steps(gaussians, self.magnitudes, pair[0])), -1.0
        seeds = asp.draw_seeds(self.generator)
        drawn = asp.draw_steps(gaussians, self.magnitudes, seeds)
        if self.settings.antithetic:
            self.pair, self._drawn = (seeds, gaussians.flat.numel()), drawn
        return drawn, 1.0

    def _diagnose(self, step: Step, *, sampled: bool) -> None:
        """Compute the magnitudes, which go to the history too, and the normals of the edges.  sampled: see `traces`."""
        settings = self.settings
        try:
            objective = step.config.objective(step.gaussians, step.views)
        except NothingInSight:
            self.history.append({"step": step.number, "note": "no Gaussian in sight: magnitudes kept"})
            return
        estimates = self.traces(objective, sampled=sampled)
        values, active = {name: estimate.value for name, estimate in estimates.items()}, len(objective.active)
        degree, extent = step.gaussians.sh_degree, step.training.extent
        self.magnitudes = asp.magnitudes(values, active, degree, extent, settings.probe)
        for name, magnitude in self.magnitudes.items():
            row = {"step": step.number, "attribute": name, **asdict(magnitude)}
            row |= {"standard_error": estimates[name].standard_error, "samples": estimates[name].probes}
            self.history.append(row | {"capped": magnitude.capped, "negative": magnitude.negative})
        if settings.vsp_weight and settings.viewpoint.edge_rotation:
            with torch.no_grad():
                depths = (render_depth(step.gaussians, view.camera, step.config.render) for view in step.views)
                self.normals = [dominant_edge(depth, alpha) for depth, alpha in depths]

    def traces(self, objective: SceneObjective, *, sampled: bool = True) -> dict[str, TraceEstimate]:
        """Traces of the Hessian's blocks of the probed attributes.  sampled: whether the coupling of pixels is sampled anew."""
        settings, names = self.settings, self.settings.probe.on
        if not names:
            return {}
        if settings.traces == "paper":
            return estimate_traces(SceneHessian(objective), self.generator, PAPER, names)
        if not sampled and self.coupling.keys() >= set(names):
            return carried_traces(objective, self.coupling)
        if settings.accuracy == inf:
            found = exact_traces(objective, self.generator, names=names, samples=LEAST_SAMPLES)
        else:
            # rho goes like the inverse root
            enough = RhoAccuracy(rtol=2 * settings.accuracy, max_probes=MOST_SAMPLES)
            found = exact_traces(objective, self.generator, enough, names=names)
        self.coupling = coupling_ratios(objective, found)
        return found

    def _count_unseen(self, step: Step) -> None:
        """Count a probed viewpoint that sees nothing: one row of the history between two diagnoses."""
        if not self.history or "count" not in self.history[-1]:
            note = "probed viewpoints without a Gaussian in sight, until the next diagnosis"
            self.history.append({"step": step.number, "note": note, "count": 0})
        self.history[-1]["count"] += 1

    def _poses(self, step: Step) -> list[Camera]:
        """The viewpoints of this step."""
        settings, cameras = self.settings, [view.camera for view in step.views]
        if not settings.vsp_weight or (settings.vsp_share < 1 and self._random() >= settings.vsp_share):
            return []
        which = range(len(cameras)) if settings.viewpoints == "all" else [int(self._random() * len(cameras))]
        return [
            composite_pose(
                cameras, m, self.normals[m] if self.normals else torch.zeros(2), self.geometry, settings.viewpoint,
                generator=self.generator,
            )
            for m in which
        ]  # fmt: skip

    def _random(self) -> float:
        """Uniform in [0, 1)."""
        return float(torch.rand((), generator=self.generator, dtype=torch.float64))

    def state(self) -> dict[str, Any]:
        magnitudes = {name: asdict(magnitude) for name, magnitude in self.magnitudes.items()}
        own = {"magnitudes": magnitudes, "normals": self.normals, "coupling": self.coupling, "pair": self.pair}
        return {**super().state(), **own}

    def restore(self, state: dict[str, Any]) -> None:
        super().restore(state)
        self.magnitudes = typed(dict[asp.Attribute, asp.Magnitude], state["magnitudes"], "magnitudes")
        self.normals = typed(list[Tensor], state["normals"], "normals")
        self.coupling = typed(dict[asp.Attribute, tuple[Ratio, NonNegative]], state["coupling"], "coupling")
        self.pair = typed(tuple[list[Count], Count] | None, state["pair"], "pair")
        if self.pair and len(self.pair[0]) != len(asp.DRAWN):
            raise InputError(f"'pair': expected {len(asp.DRAWN)} seeds, got {len(self.pair[0])}")
        if not all(normal.shape == (2,) for normal in self.normals):
            raise InputError("'normals': expected vectors of two numbers")


def _plus(total: Float[Tensor, " p"] | None, gradient: Float[Tensor, " p"], weight: float) -> Float[Tensor, " p"]:
    """total + weight gradient, in place of one of them."""
    return gradient.mul_(weight) if total is None else total.add_(gradient, alpha=weight)
