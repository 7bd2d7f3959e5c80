"""What a probe found as the `data` and `arrays` of a record (the keys are those of `analysis.records.records`)."""

from collections.abc import Mapping
from dataclasses import replace
from math import isfinite, isnan, sqrt
from typing import Any

import numpy as np
import torch

from analysis.console.budget import NEEDS_DENSITY
from analysis.measures.localization import conditions, localize, mass_shares
from analysis.probe.measurement import Findings, PlaneSlice
from landscape import EigenEnds, Eigenpairs, SpectralDensity, TraceEstimate, anisotropy, literal
from landscape.operators.checks import ROUND_OFFS
from landscape.spectrum.quantiles import quantile
from splat.curvature.objective import ActiveCounts, SceneObjective
from splat.losses.reference import LossSettings

NAMES = ("e₁", "e₂")  # of the slice's directions
QUANTILES = (0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99)


def probe_data(findings: Findings, objective: SceneObjective) -> dict[str, Any]:
    """All scalars save timing and provenance."""
    return {
        "objective": {
            **objective_of(objective),
            "operator": "hessian",
            "value": findings.value,
            "gradient_norm": findings.gradient_norm,
        },
        "traces": {name: _trace(trace) for name, trace in findings.traces.items()},
        "eigenvalues": _eigenvalues(findings, objective),
        "anisotropy": _anisotropy(findings),
        "quantiles": _quantiles(findings.density),
        "finite_probe": None if findings.finite is None else {"direction": NAMES[0], **findings.finite.record()},
        "depth": None if findings.depth is None else findings.depth.record(),
        "slice": None if findings.plane is None else _slice(findings.plane, findings.ends.largest),
        "counts": {**counts(objective.counts), **_work(findings, objective)},
        "checks": _checks(findings),
        "notes": list(findings.notes),
    }


def probe_arrays(findings: Findings) -> dict[str, dict[str, np.ndarray]]:
    """The arrays, by file."""
    arrays = {"traces": {name: trace.samples.numpy() for name, trace in findings.traces.items()}}
    assert findings.ends.ritz is not None
    values, residuals = findings.ends.ritz.numpy()
    arrays["spectrum"] = {"ritz_values": values, "residuals": residuals}
    arrays["eigenvectors"] = {"largest": findings.ends.largest.vectors.cpu().numpy()}
    if findings.density is not None:
        arrays["spectrum"] |= dict(
            zip(("nodes", "weights"), (x.numpy() for x in findings.density.table()), strict=True)
        )
    if findings.plane is not None:
        plane = findings.plane.slice
        x, y = plane.coordinates
        arrays["slice"] = {"x": x.numpy(), "y": y.numpy(), "loss": plane.loss.numpy()}
        optional = {"model": plane.model, "crossed": plane.discontinuous, "evaluated": plane.evaluated}
        arrays["slice"] |= {name: array.numpy() for name, array in optional.items() if array is not None}
    return arrays


def loss_name(loss: LossSettings) -> str:
    """The loss as a formula in words.

    >>> loss_name(LossSettings()), loss_name(LossSettings("charbonnier", 0.0, eps=0.001))
    ('0.8 L1 + 0.2 (1 − SSIM)', 'Charbonnier (eps 0.001)')
    """
    pixel = {"l1": "L1", "l2": "L2", "charbonnier": f"Charbonnier (eps {loss.eps:g})"}[loss.pixel]
    if loss.ssim_weight == 0:
        return pixel
    weighted = pixel if loss.pixel_weight == 1 else f"{loss.pixel_weight:g} {pixel}"
    return f"{weighted} + {loss.ssim_weight:g} (1 − SSIM)"


def objective_of(objective: SceneObjective) -> dict[str, Any]:
    """What, beside the training views, makes the function whose curvature is measured."""
    return {
        "loss": loss_name(objective.loss_settings),
        "sizes": [[view.camera.width, view.camera.height] for view in objective.views],
        "background": objective.background.tolist(),
    }


def _trace(trace: TraceEstimate) -> dict[str, Any]:
    sampled = trace.probes > 0
    method = "exact, the coupling of pixels sampled with random signs" if sampled else "exact"
    return {**trace.record(), "tau": sqrt(max(trace.value, 0.0) / trace.dim) if trace.dim else 0.0, "method": method}


def _eigenvalues(findings: Findings, objective: SceneObjective) -> dict[str, dict[str, Any]]:
    ends, power, gaussians = findings.ends, findings.power, objective.active
    needles = conditions(gaussians, [view.camera for view in objective.views], objective.settings)
    exact = {"max": (ends.largest, 0), "second": (ends.largest, 1), "min": (ends.smallest, 0)}
    rows = {}
    for name, (pairs, index) in exact.items():
        where = localize(pairs.vectors[:, index], gaussians, needles)
        rows[name] = {**_pair(ends, pairs, index, gaussians.blocks), "lives_on": where.record()}
    if power is not None:
        rows["power_max"] = _pair(power, power.largest, 0, gaussians.blocks)
        rows["power_min"] = _pair(power, power.smallest, 0, gaussians.blocks)
    return rows


def _pair(ends: EigenEnds, pairs: Eigenpairs, index: int, blocks: Mapping[str, slice]) -> dict[str, Any]:
    shares = mass_shares(pairs.vectors[:, index], blocks)
    return {**pairs.record(index), "matvecs": ends.matvecs, "method": ends.method, "shares": shares}


def _quantiles(density: SpectralDensity | None) -> dict[str, dict[str, Any]] | None:
    """Of the eigenvalues, those of the exact null space left out."""
    if density is None:
        return None
    return {f"{share:g}": quantile(density, share).record() for share in QUANTILES}


def _anisotropy(findings: Findings) -> dict[str, dict[str, Any]]:
    family: dict[str, Any] = anisotropy(findings.ends, findings.density).record()
    if findings.power is not None:
        family["literal"] = literal_index(findings.ends, findings.power)
    left_out = {"value": None, "low": None, "high": None, "note": NEEDS_DENSITY}
    return {**family, **{name: left_out for name in ("share", "effective_rank", "mass_quantile") if name not in family}}


def literal_index(ends: EigenEnds, power: EigenEnds) -> dict[str, Any]:
    """The paper's index from its power iteration, where that arrived within the certain bracket; else that of the ends.

    Everything lies within a bracket without bound: there it has arrived where it stopped by itself.
    """
    certain, paper, method = literal(ends), literal(power), ends.method.capitalize()
    value, note = paper.value, f"by power iteration, as the paper takes it; the bracket is that of {method}"
    bounded = isfinite(certain.low) and isfinite(certain.high)
    ran_out = any(end.reason.endswith("budget") for end in (power.largest, power.smallest))
    if value is None or not certain.low <= value <= certain.high or (ran_out and not bounded):
        value, note = certain.value, f"by {method}: the paper's power iteration did not arrive"
    if certain.note not in ("definite", "indefinite"):
        note += f" ({certain.note})"
    return {**replace(certain, value=value).record(), "note": note}


def _slice(plane: PlaneSlice, pairs: Eigenpairs) -> dict[str, Any]:
    found = plane.slice
    x, y = (float(axis.abs().max()) for axis in found.coordinates)
    units = [reach / unit for reach, unit in zip((x, y), plane.units, strict=True)]
    return {
        "directions": [
            {"name": name, "curvature": float(value), "residual": float(residual), "unit": unit}
            for name, value, residual, unit in zip(NAMES, pairs.values, pairs.residuals, plane.units, strict=False)
        ],
        "loss_scale": plane.loss_scale,
        **found.record(),
        "note": f"±{units[0]:.3g} curvature units each way: ±{x:.3g} along e₁ and ±{y:.3g} along e₂, parameter units",
    }


def counts(active: ActiveCounts) -> dict[str, int]:
    return {
        "gaussians": active.gaussians,
        "visible_gaussians": active.active_gaussians,
        "skipped_gaussians": active.gaussians - active.active_gaussians,
        "parameters": active.parameters,
        "active_parameters": active.active_parameters,
        "skipped_quaternion_lengths": active.radial_quaternions,
        "sh_degree_stored": active.sh_degree,
        "sh_degree_active": active.active_sh_degree,
        "views": active.views,
    }


def _work(findings: Findings, objective: SceneObjective) -> dict[str, int]:
    return {
        "rank": findings.rank,
        "views_kept_linearised": objective.linearized.kept,
        "products": findings.matvecs,
        "renders": 0 if findings.plane is None else findings.plane.slice.evaluations * objective.counts.views,
    }


def _checks(findings: Findings) -> dict[str, dict[str, Any]]:
    operator, derivative = findings.operator_check, findings.gradient_check
    bound = operator.tolerance
    close = max(bound, ROUND_OFFS * torch.finfo(torch.float32).eps)  # differences are not much better in float64
    steps = len(derivative.steps) + derivative.skipped
    skipped = f"the order of the splats changed on {derivative.skipped} of {steps} steps"
    ran = not isnan(derivative.error)
    return {
        "symmetry": _check(operator.symmetry, bound),
        "round_off": _check(operator.noise, bound),
        "finiteness": _check(0.0 if operator.finite else 1.0, 0.0),
        "finite_difference": {
            "value": derivative.error if ran else None,
            "bound": close,
            "passed": derivative.error <= close if ran else None,
            "note": f"gradients {derivative.step:.0e} apart, {skipped}" if ran else skipped,
        },
    }


def _check(value: float, bound: float) -> dict[str, Any]:
    return {"value": value, "bound": bound, "passed": value <= bound}
