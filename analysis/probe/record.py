"""The record (`analysis.records.records.ProbeRecord`) and the arrays of a probe's results."""

from collections.abc import Mapping
from dataclasses import replace
from math import isfinite

import numpy as np
from msgspec import UNSET, convert, structs

from analysis.measures.gradient_check import ENOUGH
from analysis.measures.localization import conditions, localize, mass_shares
from analysis.probe.measured import LeftOut, Measured, PlaneSlice
from analysis.probe.settings import TEN
from analysis.records import schema
from analysis.records.provenance import Provenance
from analysis.records.records import Check, Counts, ProbeRecord, counts_of, objective_of
from analysis.records.tables import NEEDS_DENSITY
from landscape import EigenEnds, Eigenpairs, TraceEstimate, anisotropy, eigenvalue_ratio
from landscape.results import Bracket, finite_or_none, sampling_error
from landscape.slices.finite_probe import FiniteProbe
from landscape.spectrum.concentration import half, top
from landscape.spectrum.rules import SpectralDensity
from splat.curvature.objective import SceneObjective
from splat.curvature.traces import curvature_scale

NAMES = ("e₁", "e₂")  # of the slice's directions


def probe_record(
    found: Measured, objective: SceneObjective, made: Provenance, timing: Mapping[str, float]
) -> ProbeRecord:
    """The record without the families.  timing: seconds of the stages so far."""
    left_out = found.left_out
    # the others' blocks have full rank: mean 3, log-scales 3, quaternion 3, logit 1
    seen = {"sh": found.rank - 10 * objective.counts.visible_gaussians}
    of_loss = UNSET if left_out is None else sampling_error(left_out.losses, left_out.population)
    return ProbeRecord(
        objective=objective_of(objective, found.value, found.gradient_norm, of_loss),
        traces={name: trace_record(trace, left_out, seen.get(name)) for name, trace in found.traces.items()},
        eigenvalues=_eigenvalues(found, objective),
        anisotropy=anisotropy_record(found.ends, found.density, found.power),
        concentration=concentration_record(found.density),
        depth=found.depth,
        step_rises=UNSET if found.rendered is None else found.rendered.rises,
        slice=found.plane and slice_record(found.plane, found.ends.largest),
        counts=_counts(found, objective),
        checks=_checks(found, objective.counts.views),
        notes=[*found.notes, *left_out_note(objective.counts.views, left_out and left_out.population)],
        provenance=made,
        timing=dict(timing),
    )


def probe_arrays(
    traces: Mapping[str, TraceEstimate], ends: EigenEnds, density: SpectralDensity | None, plane: PlaneSlice | None
) -> dict[str, dict[str, np.ndarray]]:
    """The arrays, by file (`analysis.records.records.ARRAYS`)."""
    assert ends.ritz is not None
    values, residuals = ends.ritz.numpy()
    arrays = {
        "traces": {name: trace.samples.numpy() for name, trace in traces.items()},
        "spectrum": {"ritz_values": values, "residuals": residuals},
        "eigenvectors": {end: getattr(ends, end).vectors.cpu().numpy() for end in ("largest", "smallest")},
    }
    if density is not None:
        arrays["spectrum"] |= dict(zip(("nodes", "weights"), (x.numpy() for x in density.table()), strict=True))
    if plane is not None:
        arrays["slice"] = plane.slice.arrays()
    return arrays


def left_out_note(views: int, population: int | None) -> list[str]:
    """Note on the standard errors due to views left out; population: number of training views, None where all are measured."""
    if population is None:
        return []
    return [
        f"measured on {views} of {population} training views: what the others would change stands beside the loss, the "
        "traces and, along the directions found, the eigenvalues, as if the views had been drawn at random: twice it holds as "
        "often as two standard errors; the largest eigenvalue of few views is usually too large (around an object of 24 views "
        "by a median of 72% to 76% from 2 of them, 48% to 52% from 3, 17% to 44% from 4, 5% to 12% from 8; where all cameras "
        "face one way by at most 3%); for the other numbers it is not known"
    ]


def index_of(bracket: Bracket) -> schema.Index:
    return convert(bracket.record(), schema.Index)


def trace_record(trace: TraceEstimate, left_out: LeftOut | None = None, rank: int | None = None) -> schema.Trace:
    """rank: of the block, where it is below its size: for colours, the directions that some view sees."""
    numbers = {**trace.record(), **({} if rank is None else {"dim": rank})}
    method = "Gauss-Newton, by backward passes" if trace.method == "pixels" else trace.method
    tau = curvature_scale(numbers["value"] or 0.0, numbers["dim"], 1, "active")
    found = convert({**numbers, "tau": tau, "method": method}, schema.Trace)
    found.views_error = UNSET if left_out is None else trace.left_out(left_out.population)
    return found


def eigenvalue_record(of: EigenEnds, pairs: Eigenpairs, index: int, blocks: Mapping[str, slice]) -> schema.Eigenvalue:
    shares = mass_shares(pairs.vectors[:, index], blocks)
    return schema.Eigenvalue(**pairs.record(index), matvecs=of.matvecs, method=of.method, shares=shares)  # pyright: ignore[reportArgumentType]


def _eigenvalues(found: Measured, objective: SceneObjective) -> schema.Eigenvalues:
    ends, power, gaussians = found.ends, found.power, objective.active
    needles = conditions(gaussians, [view.camera for view in objective.views], objective.settings)

    def exact(pairs: Eigenpairs, index: int) -> schema.Eigenvalue:
        found_end = eigenvalue_record(ends, pairs, index, gaussians.blocks)
        found_end.lives_on = localize(pairs.vectors[:, index], gaussians, needles)
        return found_end

    largest, smallest = ends.largest, ends.smallest
    rows = schema.Eigenvalues(max=exact(largest, 0), second=exact(largest, 1), min=exact(smallest, 0))
    if power is not None:
        ends_of_power = (
            eigenvalue_record(power, pairs, 0, gaussians.blocks) for pairs in (power.largest, power.smallest)
        )
        rows.power_max, rows.power_min = ends_of_power
    if found.rendered is not None:
        made = found.rendered
        rendered = zip(made.ends, made.steps, made.kinks, made.carriers, found.spreads, strict=True)
        for end, (probe, step, kinks, carrier, spreads) in zip((rows.max, rows.min), rendered, strict=True):
            wide = [(i + 1, *pair) for i, pair in enumerate(spreads) if pair[1] > TEN]
            end.carrier = structs.replace(carrier, found=len(spreads), wide=wide[0] if wide else UNSET)
            end.renders = UNSET if probe is None else renders_record(probe, step, kinks)
    if found.left_out is not None:
        for end, curvatures in zip((rows.max, rows.second, rows.min), found.left_out.curvatures.T, strict=True):
            if end:
                end.views_error = sampling_error(curvatures, found.left_out.population)
    return rows


def renders_record(probe: FiniteProbe, step: float = 0.0, kinks: float = 0.0) -> schema.Renders:
    """step: the optimiser's along this direction; 0 where it is not known."""
    confirmed, steps = probe.confirmation(step / 10)
    low, high = steps or (None, None)
    numbers = {
        "steps": probe.steps,
        "ratios": probe.curvatures / probe.infinitesimal,
        "errors": probe.round_off / abs(probe.infinitesimal),
    }
    return convert(
        {name: [finite_or_none(x) for x in found.tolist()] for name, found in numbers.items()}
        | {"confirmed": confirmed, "low": low, "high": high, "optimiser_step": step, "kinks": kinks},
        schema.Renders,
    )


def anisotropy_record(
    ends: EigenEnds, density: SpectralDensity | None, power: EigenEnds | None = None
) -> schema.Anisotropy:
    """All indices; those that need the density are undetermined without it."""
    family = anisotropy(ends, density)
    left_out = schema.Index(value=None, low=None, high=None, note=NEEDS_DENSITY)
    known = {name: getattr(family, name) for name in schema.INDICES}
    indices = schema.Anisotropy(**{name: index_of(bracket) if bracket else left_out for name, bracket in known.items()})
    if power is not None:
        indices.eigenvalue_ratio = paper_index(ends, power)
    return indices


def concentration_record(density: SpectralDensity | None) -> schema.Maybe[schema.Concentration]:
    if density is None:
        return UNSET
    brackets = {"half": half(density), "top_10": top(density, 10), "top_100": top(density, 100)}
    return schema.Concentration(**{name: index_of(bracket) for name, bracket in brackets.items()})


def paper_index(ends: EigenEnds, power: EigenEnds) -> schema.Index:
    """The paper's index: of its power iteration where that converged, else of the ends; with the bracket of the ends.

    It has converged where it lies in the bracket.  An unbounded bracket excludes nothing: there it must not end at a budget.
    """
    certain, paper, method = eigenvalue_ratio(ends), eigenvalue_ratio(power), ends.method.capitalize()
    value, note = paper.value, f"by power iteration, as the paper takes it; the bracket is that of {method}"
    bounded = isfinite(certain.low) and isfinite(certain.high)
    ran_out = any(end.reason.endswith("budget") for end in (power.largest, power.smallest))
    if value is None or not certain.low <= value <= certain.high or (ran_out and not bounded):
        value, note = certain.value, f"by {method}: the paper's power iteration did not arrive"
    if certain.note not in ("definite", "indefinite"):
        note += f" ({certain.note})"
    return index_of(replace(certain, value=value, note=note))


def slice_record(plane: PlaneSlice, pairs: Eigenpairs) -> schema.Slice:
    numbers = zip(NAMES, pairs.values.tolist(), pairs.residuals.tolist(), plane.units, strict=False)
    return schema.Slice(
        directions=[
            schema.Direction(name=name, curvature=value, residual=error, unit=unit)
            for name, value, error, unit in numbers
        ],
        loss_scale=plane.loss_scale,
        **plane.slice.record(),  # pyright: ignore[reportArgumentType]
    )


def _counts(found: Measured, objective: SceneObjective) -> Counts:
    evaluations = 0 if found.plane is None else found.plane.slice.evaluations
    evaluations += sum(each.evaluations for each in (found.rendered.ends if found.rendered else ()) if each)
    return counts_of(
        objective.counts,
        found.left_out and found.left_out.population,
        rank=found.rank,
        products=found.matvecs,
        renders=evaluations * objective.counts.views,
    )


def _checks(found: Measured, views: int) -> dict[str, Check]:
    operator, gradient = found.operator_check, found.gradient_check
    noise, noise_note = operator.noise, UNSET
    note = f"{gradient.views} of {views} views, each by itself; gradients {gradient.step:.0e} apart"
    if gradient.signs:
        note += f", across the kinks of {gradient.signs} residuals, which are left out"
    if gradient.left_out:
        note += f"; {gradient.left_out} more jump at every step, and are left out"
    if gradient.rounding:
        noise = max(noise, gradient.rounding)
        noise_note = "single against double precision, which order depths that are nearly equal each its own way"
        note += "; products in double precision"
    compared = Check(value=None, bound=None, passed=None, note=note)
    if gradient.views:
        # differences are not much better in float64: hence ENOUGH
        compared = _check(gradient.error, max(operator.tolerance, ENOUGH), note)
    return {
        "symmetry": _check(operator.symmetry, operator.tolerance),
        "round_off": _check(noise, operator.tolerance, noise_note),
        "finiteness": _check(0.0 if operator.finite else 1.0, 0.0),
        "finite_difference": compared,
    }


def _check(value: float, bound: float, note: schema.Maybe[str] = UNSET) -> Check:
    return Check(value=value, bound=bound, passed=value <= bound, note=note)
