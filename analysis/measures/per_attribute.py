"""Anisotropy of a checkpoint's curvature: of all attributes together and of each, of the Hessian and of Gauss-Newton.

A family is both ends of the spectrum, the density and the indices (`landscape.spectrum.block_anisotropy`) of one of these:

    scene       "trained": the checkpoint; "split": with every Gaussian in sight split into two coincident halves
                (`analysis.measures.split_control`), which leaves the images nearly unchanged
    operator    "hessian", exact, or "gauss-newton"; D H D in the units of a metric (`analysis.measures.units`)
    block       "all", or an attribute: that diagonal block of the operator

The effect of the split is an index of the split scene over that of the trained one: what the number of Gaussians alone changes.
Every family stops at its tolerance or its budget of products.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from math import inf
from typing import Literal

import torch
from msgspec import UNSET, convert, structs
from torch import Tensor

from analysis.console.stages import Stage
from analysis.measures.memory import basis_within, vectors_within
from analysis.measures.split_control import SplitControl, split_control
from analysis.measures.units import Metric, optimiser_units
from analysis.records import schema
from analysis.records.quantities import quantity
from analysis.records.records import ProbeRecord
from landscape import BlockAnisotropy, BlockAnisotropySettings, RestrictedOperator, ScaledOperator, block_anisotropy
from landscape.eigen.pairs import EigenEnds
from landscape.errors import InputError
from landscape.probes import spawn
from landscape.results import Bracket, Progress, finite_or_none
from landscape.spectrum.block_anisotropy import WHOLE
from landscape.traces.trace import total_trace
from splat.curvature.block_eigenvectors import BlockEigenvectors
from splat.curvature.hessian import SceneHessian
from splat.curvature.null.active_spaces import active_spaces
from splat.curvature.objective import SceneObjective
from splat.curvature.traces import exact_traces
from splat.training.state import Training

SceneName = Literal["trained", "split"]
OPERATORS: dict[schema.Operator, bool] = {"hessian": False, "gauss-newton": True}  # name -> gauss_newton
PARTS = 6  # the whole and five attributes
TRACE_SAMPLES = 8  # of SSIM's coupling: to a few percent, less than the error from the density's start vectors
PRODUCTS = 26.0  # expected of a family, with a batch of vectors
SPLIT = 1.5  # factor of their cost in the split scene


@dataclass(frozen=True)
class PerAttributeOptions:
    """Metric, split control and budget of the families.  family: of each; memory: GiB for the vectors of a basis."""

    metric: Metric = "parameters"
    split_control: bool = False
    family: BlockAnisotropySettings = field(default_factory=BlockAnisotropySettings)
    memory: float = 2.0

    @property
    def products(self) -> float:
        """Expected number of products with a batch of vectors, in units of a product of the trained scene."""
        return len(OPERATORS) * PARTS * PRODUCTS * (1 + SPLIT * self.split_control)


@dataclass(frozen=True, eq=False)
class FamilyRow:
    """One family."""

    scene: SceneName
    operator: schema.Operator
    block: str
    gaussians: int
    family: BlockAnisotropy

    def record(self, metric: Metric, unit: str) -> schema.BlockAnisotropy:
        found, ends = self.family, self.family.ends
        return schema.BlockAnisotropy(
            metric=metric,
            unit=unit,
            operator=self.operator,
            block=self.block,
            split=self.scene == "split",
            gaussians=self.gaussians,
            rank=found.rank,
            lambda_max=convert(ends.largest.record(), schema.End),
            lambda_min=convert(ends.smallest.record(), schema.End),
            beyond=finite_or_none(ends.beyond),
            indices=convert(found.indices.record(), schema.Anisotropy),
        )


@dataclass(frozen=True, eq=False)
class FamilyFindings:
    """All families.  unit: the metric's, in words; control, effects: None and empty without the split control."""

    rows: tuple[FamilyRow, ...]
    control: SplitControl | None
    effects: tuple[schema.Effect, ...]
    notes: tuple[str, ...]
    metric: Metric
    unit: str

    def added_to(self, record: ProbeRecord) -> ProbeRecord:
        """The record of a probe with the families, the effects of the split, and notes on what was left out."""
        families, control = [row.record(self.metric, self.unit) for row in self.rows], UNSET
        if split := self.control:
            about = {"rms": split.rms, "psnr": split.psnr if split.rms else None, "effects": list(self.effects)}
            control = schema.SplitControl(gaussians=len(split.gaussians), **about)
        notes = [*record.notes, *self.notes]
        return structs.replace(record, per_attribute=families, split_control=control, notes=notes)


def measure_per_attribute(
    objective: SceneObjective,
    training: Training,
    options: PerAttributeOptions,
    generator: torch.Generator,
    stage: Stage,
    ends: EigenEnds | None = None,
) -> FamilyFindings:
    """Every family of the scene and, if asked for, of the split scene.

    training: that of the checkpoint; stage: see `analysis.console.stages`; ends: of the objective's Hessian in the stored
    parameters, where known.
    """
    scenes: dict[SceneName, SceneObjective] = {"trained": objective}
    control, notes = None, []
    if options.split_control:
        with stage("split control"):
            control = split_control(
                objective.active, [view.camera for view in objective.views], objective.background, objective.settings
            )
            same = objective.loss_of_active, objective.background, objective.settings
            scenes["split"] = SceneObjective(control.gaussians, objective.views, *same)
    unit, scale = _metric(options.metric, objective, training)
    streams: dict[tuple[SceneName, schema.Operator], torch.Generator] = {
        (scene, operator): spawn(generator)
        for scene in scenes  # the trained one first: its numbers are the same without the split control
        for operator in OPERATORS
    }
    rows: list[FamilyRow] = []
    for (scene, operator), stream in streams.items():
        with stage(f"per attribute: {operator}{', split' if scene == 'split' else ''}") as report:
            hessian = SceneHessian(scenes[scene], gauss_newton=OPERATORS[operator])
            D = scale(scenes[scene])
            known = ends if scene == "trained" and operator == "hessian" and D is None else None
            measured = _of_operator(hessian, D, known, options, stream, report, notes)
            count = len(scenes[scene].active)
            rows += [FamilyRow(scene, operator, block, count, found) for block, found in measured]
    return FamilyFindings(tuple(rows), control, _effects(rows), tuple(dict.fromkeys(notes)), options.metric, unit)


def _metric(
    metric: Metric, objective: SceneObjective, training: Training
) -> tuple[str, Callable[[SceneObjective], Tensor | None]]:
    """The unit in words, and D of a scene; the split scene has the units of the trained one."""
    if metric == "parameters":
        return "the stored parameters as they are", lambda _: None
    rates, extent = training.config.rates, training.extent
    positions = f"{quantity(rates.position * extent)} (extent {quantity(extent)})"
    if not (optimiser_units(objective, rates, extent) > 0).all():
        raise InputError(f"expected learning rates above 0 for the optimiser's metric, got {rates}")
    words = (
        f"steps of the training's first learning rates: position {positions}, "
        f"log scale {rates.log_scales:g}, rotation {rates.quats:g}, opacity {rates.opacity_logits:g}, "
        f"colour {rates.sh_constant:g} and {rates.sh_higher:g}"
    )
    return words, lambda scene: optimiser_units(scene, rates, extent)


def _of_operator(
    hessian: SceneHessian,
    scale: Tensor | None,
    ends: EigenEnds | None,
    options: PerAttributeOptions,
    generator: torch.Generator,
    report: Progress,
    notes: list[str],
) -> list[tuple[str, BlockAnisotropy]]:
    """(block, family) of the whole and of every attribute of one operator.

    ends: of the whole, where known.  notes: gets sentences on what was left out.
    """
    operator = hessian if scale is None else ScaledOperator(hessian, scale)
    spaces, found = active_spaces(hessian.objective, hessian.projector, scale), []
    traces = _traces(hessian, scale, spawn(generator))
    names, settings = [WHOLE, *hessian.blocks], _fitted(hessian.objective, options, notes)
    for done, name in enumerate(names):
        stream = spawn(generator)
        if name != WHOLE and name not in spaces:  # an attribute of rank 0
            continue
        report(done, len(names), name)

        def say(_: int, __: int, state: str, done: int = done, name: str = name) -> None:
            report(done, len(names), f"{name}: {state}")

        part = operator if name == WHOLE else RestrictedOperator(operator, name)
        start = _start(hessian, name, scale, ends)
        family = block_anisotropy(part, spawn(stream), settings, spaces.get(name), say, start, traces.get(name))
        found.append((name, family))
    report(len(names), len(names), "done")
    return found


def _traces(hessian: SceneHessian, scale: Tensor | None, generator: torch.Generator) -> dict[str, tuple[float, float]]:
    """The operator's traces with standard errors, of the whole and of every attribute."""
    found = exact_traces(
        hessian.objective, generator, samples=TRACE_SAMPLES, gauss_newton=hessian.gauss_newton, scale=scale
    )
    return {WHOLE: total_trace(found), **{name: total_trace({name: trace}) for name, trace in found.items()}}


def _start(hessian: SceneHessian, name: str, scale: Tensor | None, ends: EigenEnds | None) -> Tensor | None:
    """Start vectors (n, k) of the search for the ends of a part: where the whole's are known these, else eigenvectors of the
    diagonal blocks of Gaussians; None, for random ones, where these say nothing of the part's ends.

    Of positions and of Gauss-Newton they say where the largest end is alone: the smallest one of positions spreads over
    several Gaussians, that of Gauss-Newton is 0.
    """
    if name == WHOLE and ends is not None:
        return torch.cat([ends.largest.vectors[:, :1], ends.smallest.vectors[:, :1]], dim=1)
    if name not in (WHOLE, "means", "quats"):
        return None
    objective, attribute = hessian.objective, None if name == WHOLE else name
    blocks, pixelwise = objective.approximate_blocks
    if hessian.gauss_newton:
        blocks = objective.pixelwise_blocks
    known = BlockEigenvectors(objective, blocks, pixelwise, attribute, scale)
    return known.steepest(1, 0) if hessian.gauss_newton or name == "means" else known.warm_start()


def _fitted(objective: SceneObjective, options: PerAttributeOptions, notes: list[str]) -> BlockAnisotropySettings:
    """The budget of a family: basis and batch fit into memory.  notes: gets sentences on what was cut down."""
    settings, room = options.family, vectors_within(objective, options.memory)
    basis = basis_within(settings.eigen, room)
    if basis < settings.eigen.basis:
        notes.append(
            f"the searches by attribute kept {basis} vectors instead of {settings.eigen.basis}, to stay within memory"
        )
    batch = max(1, min(settings.batch, room // settings.steps))  # a run of the density keeps a vector a step
    return replace(settings, eigen=replace(settings.eigen, basis=basis), batch=batch)


def _effects(rows: list[FamilyRow]) -> tuple[schema.Effect, ...]:
    """Every index of the split scene over that of the trained one."""
    split_rows = {(row.operator, row.block): row.family for row in rows if row.scene == "split"}
    effects = []
    for row in rows:
        after = split_rows.get((row.operator, row.block))
        if row.scene == "split" or after is None:
            continue
        for index, before in vars(row.family.indices).items():
            factor = quotient(getattr(after.indices, index), before).record()
            about = {"operator": row.operator, "block": row.block, "index": index}
            effects.append(convert(about | factor, schema.Effect))
    return tuple(effects)


def quotient(after: Bracket | None, before: Bracket | None) -> Bracket:
    """after / before with the bracket that both brackets imply; undetermined where either may be 0 or is unbounded.

    Two brackets at 95% give one at 90%.

    >>> str(quotient(Bracket(6.0, 5.0, 8.0), Bracket(2.0, 2.0, 2.5)))
    '3 in [2, 4]'
    """
    for bracket in (after, before):
        if bracket is None or bracket.value is None or not _bounded(bracket):
            note = "" if bracket is None else bracket.note
            return Bracket(None, inf, inf, note or "not determined")
    assert after and before and after.value is not None and before.value is not None
    corners = [a / b for a in (after.low, after.high) for b in (before.low, before.high)]
    return Bracket(after.value / before.value, min(corners), max(corners))


def _bounded(bracket: Bracket) -> bool:
    return -inf < bracket.low <= bracket.high < inf and bracket.low * bracket.high > 0
