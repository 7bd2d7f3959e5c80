"""The traces of the attributes' Hessian blocks: exact but for the coupling between pixels, which is sampled.

With E_b the columns of block b, J the Jacobian of the images, D the pixel-diagonal of l'':

    tr(H_b) = T_b + E[x - y],   T_b exact from `block_diagonal` (D in place of l''),
    x = |J E_b z|^2 in the metric l'',  y = the same in the metric D,  z random signs;  E[y] = C_b is exact too

so y is a control variate: each sample is x - c (y - C_b), with c fitted to the other samples (so that no sample takes part in
its own coefficient and the mean stays unbiased).  A sample costs one J u of as many vectors as there are blocks whose error is
not yet small enough, and no backward pass.  Where the loss is a sum over pixels, l'' = D and the traces are exact.
"""

from math import ceil
from time import monotonic

import torch
from torch import Tensor

from landscape.control import controlled
from landscape.probes import draw_probes
from landscape.results import Progress, StopReason, TraceEstimate, t_interval
from landscape.trace import TraceSettings
from splat.curvature import SceneObjective

ONE_PERCENT = TraceSettings(rtol=0.01, max_probes=64)
GROWTH = 1.5  # of the number of samples between two looks


def exact_traces(
    objective: SceneObjective,
    generator: torch.Generator,
    settings: TraceSettings = ONE_PERCENT,
    progress: Progress | None = None,
) -> dict[str, TraceEstimate]:
    """The trace of every attribute's block of H, on the complement of the quaternions' radial directions.

    settings: rtol, atol, confidence, the numbers of samples and max_seconds count; the distribution is always random signs.
    """
    quats = objective.active.quats
    known = objective.block_diagonal().traces(quats)
    sizes = {name: rows.stop - rows.start for name, rows in objective.blocks.items()}
    sizes["quats"] -= len(objective.active)
    if not objective.couples_pixels:
        exact = torch.zeros(0, dtype=torch.float64)
        return {
            name: TraceEstimate(name, sizes[name], value, 0.0, value, value, settings.confidence, 0, 0, "exact", exact)
            for name, value in known.items()
        }
    pixelwise = objective.block_diagonal(gauss_newton=True).traces(quats)
    estimates: dict[str, TraceEstimate] = {}
    open_blocks, deadline = list(known), monotonic() + settings.max_seconds
    full, diagonal = {name: [] for name in known}, {name: [] for name in known}
    count, look = 0, settings.min_probes
    while open_blocks:
        for name, x, y in zip(open_blocks, *_sample(objective, generator, open_blocks), strict=True):
            full[name].append(x)
            diagonal[name].append(y)
        count += 1
        if progress:
            progress(count, settings.max_probes, f"traces: {count} samples of the coupling between pixels")
        late = monotonic() > deadline and count >= settings.min_probes
        if count < look and not late:
            continue
        look = min(ceil(GROWTH * count), settings.max_probes)
        reason: StopReason = "time budget" if late else "matvec budget"
        for name in open_blocks:
            x, y = (torch.stack(samples[name]) for samples in (full, diagonal))
            samples = known[name] - pixelwise[name] + controlled(x, y, pixelwise[name])
            estimates[name] = _estimate(name, sizes[name], samples, settings, reason)
        if late or count == settings.max_probes:
            break
        open_blocks = [name for name in open_blocks if estimates[name].reason != "tolerance"]
    return {name: estimates[name] for name in known}


def _sample(objective: SceneObjective, generator: torch.Generator, names: list[str]) -> tuple[Tensor, Tensor]:
    """x and y of the named blocks, for one draw of signs; the draw is the same whatever the names are."""
    p = objective.active.flat.numel()
    z = draw_probes(p, 1, generator, objective.active.flat.dtype, "rademacher")
    U = torch.zeros(p, len(names), dtype=z.dtype)
    for i, name in enumerate(names):
        rows = objective.blocks[name]
        U[rows, i] = z[rows, 0]
    total = torch.stack([torch.stack(view.loss_curvatures(U)) for view in objective.linearized]).sum(dim=0)
    return tuple(objective.mean(total))  # pyright: ignore[reportReturnType]


def _estimate(name: str, dim: int, samples: Tensor, settings: TraceSettings, reason: StopReason) -> TraceEstimate:
    value, error, low, high = t_interval(samples, settings.confidence)
    reached = (high - low) / 2 <= max(settings.rtol * abs(value), settings.atol)
    return TraceEstimate(
        name, dim, value, error, low, high, settings.confidence, len(samples), len(samples),
        "tolerance" if reached else reason, samples,
    )  # fmt: skip
