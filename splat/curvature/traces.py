"""Traces of the attributes' Hessian blocks: exact but for the coupling of pixels by the loss, which is sampled.

With E_b the columns of the identity in block b, J the Jacobian of the images, D the diagonal of the loss's l'':

    tr(H_b) = T_b + E[x - y]      T_b: trace with D in place of l'' (`SceneObjective.approximate_blocks`)
    x = (J E_b z)^T l'' (J E_b z),  y = (J E_b z)^T D (J E_b z)      z: random signs;  E[y] = C_b is known exactly

y is a control variate: each sample is T_b - C_b + x - c (y - C_b), where c is fitted to the other samples so that the mean
stays unbiased.  x and y are means over M views with independent random signs, which lowers the variance up to M times.  A
sample costs one product J u for each block whose error is not small enough yet, and no backward pass.  Where the loss is a sum
over pixels, l'' = D and the traces are exact.

`sampled_traces` does the same for other parts of the parameters, such as positions along the rays
(`analysis/measures/depth.py`).
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from math import sqrt
from typing import Literal

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from landscape.errors import InputError
from landscape.probes import draw_probes
from landscape.results import Progress, StopReason, t_quantile
from landscape.traces.estimate import TraceEstimate
from landscape.traces.hutchinson import CONFIRMATION, WIDENING, StoppingRule, TraceSettings
from splat.curvature.objective import SceneObjective
from splat.model.gaussians import ATTRIBUTES

SAMPLED = "exact, but SSIM's window is sampled"
ONE_PERCENT = TraceSettings(rtol=0.01, max_probes=64)
EPS = torch.finfo(torch.float64).eps
ROUND_OFFS = 10  # of the sum of squares: a smaller spread of the other controls means that they are equal
LEAST_SAMPLES = 4  # for a mean, a slope, and a variance with two degrees of freedom
COLUMNS = 5  # most vectors in a pass over the pixels: one for each attribute

Dimension = Literal["active", "attribute"]
Draw = Callable[[int, Sequence[torch.Generator], Sequence[str]], Float[Tensor, "p b s"]]
"""(index of a view of this process, generators, names): for each name and each generator a random vector over the active
parameters, with mean 0 and, as its covariance, the projector onto the named part."""


def exact_traces(
    objective: SceneObjective,
    generator: torch.Generator,
    settings: TraceSettings = ONE_PERCENT,
    progress: Progress | None = None,
    names: Sequence[str] = ATTRIBUTES,
    samples: int | None = None,
    *,
    gauss_newton: bool = False,
    scale: Float[Tensor, " p"] | None = None,
) -> dict[str, TraceEstimate]:
    """Traces of the named attributes' blocks of H, without the quaternions' radial directions, by name.

    By default to 1%, with 8 to 64 samples; exact where the loss does not couple pixels (ssim_weight = 0).
    gauss_newton: of the Gauss-Newton part, where T_b = C_b.  scale: (p,) positive; of S H S, S = diag(scale), instead of H.
    settings: rtol, atol, confidence, min_probes and max_probes (of samples); the rest is ignored.
    samples: an exact number, at least LEAST_SAMPLES, for rough values; overrides the settings.

    >>> from splat import SceneObjective, SyntheticSettings, synthetic_scene
    >>> made = synthetic_scene(SyntheticSettings(gaussians=50, views=2, width=16, height=12))
    >>> objective = SceneObjective(made.truth, made.scene.load())
    >>> traces = exact_traces(objective, torch.Generator().manual_seed(0), samples=4)
    >>> list(traces), traces["means"].probes
    (['means', 'log_scales', 'quats', 'opacity_logits', 'sh'], 4)
    """
    if samples is not None and samples < LEAST_SAMPLES:
        raise InputError(f"expected at least {LEAST_SAMPLES} samples, got {samples}")
    quats, units = objective.active.quats, None if scale is None else objective.active.with_flat(scale)
    whole, coupled = objective.approximate_blocks
    if gauss_newton:
        whole = objective.pixelwise_blocks
    known = {name: value for name, value in whole.traces(quats, units).items() if name in names}
    pixelwise = {} if coupled is None else coupled.traces(quats, units)
    first, most = (samples, samples) if samples else (settings.min_probes, settings.max_probes)
    traces = [
        SampledTrace(
            name, objective.block_dims[name], known[name], pixelwise.get(name), settings, first, most,
            None if scale is not None else [view[name] for view in whole.views],
        )
        for name in known
    ]  # fmt: skip
    return sampled_traces(objective, generator, partial(_signs, objective, scale), traces, progress)


def block_traces(objective: SceneObjective, progress: Progress | None = None) -> dict[str, TraceEstimate]:
    """The same traces without sampling: sums over `objective.exact_blocks`, which are made anew; on the CPU only."""
    objective.exact_blocks = blocks = objective.block_diagonals(parts=(False,), progress=progress)[0]
    found = {}
    for name, value in blocks.traces(objective.active.quats).items():
        terms = torch.tensor([view[name] for view in blocks.views], dtype=torch.float64)
        dim = objective.block_dims[name]
        found[name] = TraceEstimate.exact(name, dim, value, ONE_PERCENT.confidence, terms=terms)
    return found


def coupling_ratios(objective: SceneObjective, traces: Mapping[str, TraceEstimate]) -> dict[str, tuple[float, float]]:
    """E[x - y] of estimated traces and its standard error, in units of C_b, by name: for `carried_traces`."""
    known, pixelwise = _pixel_traces(objective, traces)
    unit = {name: pixelwise.get(name, 0.0) or 1.0 for name in traces}  # C_b = 0: no coupling, and nothing was sampled
    return {
        name: ((trace.value - known[name]) / unit[name], abs(trace.standard_error / unit[name]))
        for name, trace in traces.items()
    }


def carried_traces(objective: SceneObjective, ratios: Mapping[str, tuple[float, float]]) -> dict[str, TraceEstimate]:
    """Traces without sampling, where E[x - y] / C_b is as `coupling_ratios` found it elsewhere, for instance some steps before.

    standard_error: that of the ratio alone, not of its change since.
    """
    known, pixelwise = _pixel_traces(objective, ratios)
    found = {}
    for name, (ratio, error) in ratios.items():
        unit = pixelwise.get(name, 0.0)
        trace = TraceEstimate.exact(
            name, objective.block_dims[name], known[name] + ratio * unit, ONE_PERCENT.confidence
        )
        found[name] = replace(trace, standard_error=error * abs(unit))
    return found


def _pixel_traces(objective: SceneObjective, names: Collection[str]) -> tuple[dict[str, float], dict[str, float]]:
    """T_b and C_b of the named blocks; no C_b where the loss does not couple pixels."""
    quats = objective.active.quats
    whole, coupled = ({} if blocks is None else blocks.traces(quats) for blocks in objective.approximate_blocks)
    return {name: whole[name] for name in names}, coupled


def curvature_scale(trace: float, parameters: int, gaussians: int, dimension: Dimension) -> float:
    """Curvature scale tau of an attribute's block, as in StableGS: sqrt(max(trace, 0) / dim), 0 for an empty block.

    parameters: of the block, N d for N active Gaussians; d = 3 for means, log-scales and quaternions (on the unit sphere), 1
    for opacities and 3 (l + 1)^2 for SH of degree l.  In the paper H spans all Gaussians, but d is that of a single one:

    dimension "active"      dim = N d: the root of the mean curvature of a parameter; what `landscape probe` records
    dimension "attribute"   dim = d: larger by sqrt(N); as the paper says, and the default of its probes (`ProbeSettings`)

    >>> curvature_scale(12.0, 12, 4, "active"), curvature_scale(12.0, 12, 4, "attribute")
    (1.0, 2.0)
    """
    dim = parameters if dimension == "active" else parameters // max(gaussians, 1)
    return sqrt(max(trace, 0.0) / dim) if dim else 0.0


def sampled_traces(
    objective: SceneObjective,
    generator: torch.Generator,
    draw: Draw,
    traces: Sequence["SampledTrace"],
    progress: Progress | None = None,
) -> dict[str, TraceEstimate]:
    """Estimates of traces, sampled together until each is accurate enough or out of samples."""
    while unfinished := [trace for trace in traces if trace.open]:
        count, next_check = unfinished[0].count, min(trace.rule.next for trace in unfinished)
        # few traces leave room for several samples in the pass over the pixels
        batch = min(max(COLUMNS // len(unfinished), 1), next_check - count)
        sampled = coupling_samples(objective, generator, draw, [trace.name for trace in unfinished], batch)
        for trace, x, y in zip(unfinished, *(part.unbind(dim=1) for part in sampled), strict=True):
            trace.add(x, y)
        if progress:
            state = f"traces: {count + batch} random samples of what pairs of pixels add"
            progress(count + batch, unfinished[0].most, state)
    return {trace.name: trace.estimate() for trace in traces}


class SampledTrace:
    """Samples of one trace, at least `first` and at most `most`, and whether it needs more (`open`).

    dim: dimension of the block.  known: T_b of the module's docstring.  pixelwise: C_b; None where the loss does not couple
    pixels, so that T_b is the trace.  views: T_b of each view, for `TraceEstimate.terms`.
    """

    def __init__(
        self,
        name: str,
        dim: int,
        known: float,
        pixelwise: float | None,
        settings: TraceSettings,
        first: int,
        most: int,
        views: Sequence[float] | None = None,
    ):
        self.name, self.dim, self.settings, self.first, self.most = name, dim, settings, first, most
        self.known, self.pixelwise, self.views = known, pixelwise, views
        self.x = self.y = torch.zeros(0, dtype=torch.float64)
        self.differences: list[Float64[Tensor, "m s"]] = []  # x - y of each view
        # a run can end at `first` samples: where the tolerance holds there and CONFIRMATION samples earlier
        check = most if first == most else max(first - CONFIRMATION, LEAST_SAMPLES)
        self.rule, self.open = StoppingRule(check, most), pixelwise is not None

    @property
    def count(self) -> int:
        return len(self.x)

    def add(self, x: Float64[Tensor, "m s"], y: Float64[Tensor, "m s"]) -> None:
        """Take in samples of every view."""
        self.x, self.y = torch.cat([self.x, x.mean(dim=0)]), torch.cat([self.y, y.mean(dim=0)])
        self.differences.append(x - y)
        if self.count == self.rule.next:
            self.open = not self.rule.end(self.count, self.estimate().reason == "tolerance")

    def estimate(self) -> TraceEstimate:
        settings, terms = self.settings, None if self.views is None else torch.tensor(self.views, dtype=torch.float64)
        if self.pixelwise is None:
            return TraceEstimate.exact(self.name, self.dim, self.known, settings.confidence, terms=terms)
        if terms is not None:
            terms += torch.cat(self.differences, dim=1).mean(dim=1)  # T_b + E[x - y] of every view
        samples = self.known - self.pixelwise + controlled(self.x, self.y, self.pixelwise)
        value = float(samples.mean())
        error = max(float(samples.std()) / sqrt(self.count), regression_error(self.x, self.y, self.pixelwise))
        # the fitted coefficient takes one more degree of freedom than the mean
        quantile = t_quantile(self.count - 2, settings.confidence)
        half = quantile * error * (WIDENING if settings.adaptive and self.first < self.most else 1.0)
        reason: StopReason = "tolerance" if settings.reached(value, value - half, value + half) else "matvec budget"
        return TraceEstimate(
            self.name, self.dim, value, error, value - half, value + half, settings.confidence, self.count, self.count,
            reason, samples, SAMPLED, terms=terms,
        )  # fmt: skip


def regression_error(samples: Float64[Tensor, " s"], control: Float64[Tensor, " s"], mean: float) -> float:
    """Standard error of the regression line of samples on control, at control = mean; 0 where control is constant.

    With few samples it is often larger than the standard error of the controlled samples, whose slopes are correlated.
    """
    count, centred = len(samples), control - control.mean()
    spread = float(centred.square().sum())
    if count < 3 or spread == 0:
        return 0.0
    residuals = samples - samples.mean() - float((samples * centred).sum()) / spread * centred
    offset = float(control.mean()) - mean
    return sqrt(float(residuals.square().sum()) / (count - 2) * (1 / count + offset**2 / spread))


def coupling_samples(
    objective: SceneObjective, generator: torch.Generator, draw: Draw, names: Sequence[str], count: int
) -> tuple[Float64[Tensor, "m b s"], Float64[Tensor, "m b s"]]:
    """x and y of every view and named part for `count` draws; neither names nor count change the random numbers of a draw."""
    seeds = torch.randint(2**62, (count,), generator=generator, device=generator.device).tolist()
    found = []
    for index, linearized in enumerate(objective.linearized):
        generators = [torch.Generator(generator.device).manual_seed(seed + index) for seed in seeds]
        found.append(torch.stack(linearized.loss_curvatures(draw(index, generators, names).flatten(1))).cpu())
    x, y = torch.stack(found).view(-1, 2, len(names), count).unbind(dim=1)
    return x, y


def _signs(
    objective: SceneObjective,
    scale: Float[Tensor, " p"] | None,
    _index: int,
    generators: Sequence[torch.Generator],
    names: Sequence[str],
) -> Float[Tensor, "p b s"]:
    """Random signs in each named block, times scale: a `Draw`."""
    flat = objective.active.flat
    U = flat.new_zeros(flat.numel(), len(names), len(generators))
    for j, generator in enumerate(generators):
        z = draw_probes(flat.numel(), 1, generator, flat.dtype, "rademacher")[:, 0]
        z = z if scale is None else z * scale
        for i, name in enumerate(names):
            rows = objective.blocks[name]
            U[rows, i, j] = z[rows]
    return U


def controlled(samples: Float64[Tensor, " s"], control: Float64[Tensor, " s"], mean: float) -> Float64[Tensor, " s"]:
    """samples - c (control - mean), where c is fitted for each sample to all others by least squares (0 if their controls are
    equal; fewer than 3 samples are returned as they are).

    >>> x = torch.tensor([1.0, 2.0, 4.0, 8.0]).double()
    >>> controlled(3 * x + 5, x, mean=2.0).round(decimals=9)  # 3 x + 5 has the mean 11, and x explains all of it
    tensor([11., 11., 11., 11.], dtype=torch.float64)
    """
    if len(samples) < 3:
        return samples
    x, y = samples - samples.mean(), control - control.mean()
    unit = float(y.abs().max()) or 1.0
    y = y / unit  # squares of y may leave the range of floats
    left = len(samples) / (len(samples) - 1)  # the means move, too, when a sample is left out
    cross, spread = (x * y).sum() - left * x * y, y.square().sum() - left * y.square()
    varies = spread > ROUND_OFFS * EPS * y.square().sum()
    slope = torch.where(varies, cross / spread.clamp_min(1e-300), torch.zeros_like(cross))
    return samples - slope * ((control - mean) / unit)
