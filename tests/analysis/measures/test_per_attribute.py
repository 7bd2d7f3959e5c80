"""The families in a probe: each against dense matrices, the split control's effect, what the record and the page say."""

import copy
import io
import re
from contextlib import nullcontext
from dataclasses import astuple
from html.parser import HTMLParser
from itertools import product
from pathlib import Path

import pytest
import torch
from msgspec import UNSET
from rich.console import Console
from scipy.stats import binom

from analysis.commands.cli import main
from analysis.measures.per_attribute import FamilyFindings, PerAttributeOptions, measure_per_attribute, quotient
from analysis.measures.split_control import split_in_two
from analysis.records.page.report import render_report
from analysis.records.records import ProbeRecord, Record, read_record
from analysis.records.schema import INDICES, End, Index
from analysis.records.tables import Cell, family_lines, family_table
from landscape import (
    BlockAnisotropySettings,
    Bracket,
    EigenSettings,
    RestrictedOperator,
    block_anisotropy,
    extreme_eigenpairs,
)
from landscape.eigen.pairs import EigenEnds
from splat.curvature.block_eigenvectors import BlockEigenvectors
from splat.curvature.hessian import SceneHessian
from splat.curvature.objective import SceneObjective
from splat.scenes.synthetic import SyntheticSettings, synthetic_scene
from splat.scenes.write import write_transforms_scene
from splat.training.checkpoint import load_checkpoint
from splat.training.origin.subject import Checkpoint
from tests.analysis.probe.probed import save_double
from tests.recorded import soft

SCENE = SyntheticSettings(gaussians=50, views=4, width=16, height=12)
BUDGET = BlockAnisotropySettings(EigenSettings(rtol=1e-2, max_matvecs=40), starts=3, steps=6)
BLOCKS = ["all", "means", "log_scales", "quats", "opacity_logits", "sh"]
QUICK = ["--quick", "--slice-points", "5"]


@pytest.fixture(scope="module")
def path(tmp_path_factory) -> Path:
    """A checkpoint in double precision beside its scene."""
    folder = tmp_path_factory.mktemp("per_attribute")
    write_transforms_scene(synthetic_scene(SCENE).scene, folder / "still")
    command = ["train", str(folder / "still"), "--out", str(folder / "run"), "--iterations", "10", "--no-densify"]
    assert main([*command, "--sh-degree", "1"]) == 0
    double = folder / "run" / "double.pt"
    save_double(folder / "run" / "checkpoint.pt", double, lambda g: g.select(torch.arange(len(g)), 1))
    return double


@pytest.fixture(scope="module")
def checkpoint(path: Path) -> Checkpoint:
    return load_checkpoint(path)


@pytest.fixture(scope="module")
def objective(path: Path, checkpoint: Checkpoint) -> SceneObjective:
    return checkpoint.with_scene(path).objective()


def silent(name: str) -> nullcontext:
    return nullcontext(lambda done, most, state: None)


def found(
    objective: SceneObjective, checkpoint: Checkpoint, ends: EigenEnds | None = None, **options
) -> FamilyFindings:
    generator = torch.Generator().manual_seed(0)
    options = {"family": BUDGET, **options}
    return measure_per_attribute(
        objective, checkpoint.training, PerAttributeOptions(**options), generator, silent, ends
    )


@pytest.fixture(scope="module")
def split(objective: SceneObjective, checkpoint: Checkpoint) -> FamilyFindings:
    return found(objective, checkpoint, metric="optimiser", split_control=True)


@pytest.fixture(scope="module")
def record(path: Path) -> Record[ProbeRecord]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("analysis.console.drawing.drawing", lambda *_: nullcontext(lambda target: []))
        command = ["probe", str(path), "--split-control", "--metric", "optimiser", *QUICK]
        assert main([*command, "--out", str(path.parent / "recorded")]) == 0
    return read_record(path.parent / "recorded", ProbeRecord)


def dense(objective: SceneObjective, training, operator: str) -> torch.Tensor:
    """D H D in steps of the first learning rates."""
    hessian = SceneHessian(objective, gauss_newton=operator == "gauss-newton")
    H = hessian.apply(torch.eye(hessian.dim, dtype=torch.float64))
    rates = objective.active.with_flat(torch.ones(hessian.dim, dtype=torch.float64))
    rates.means.fill_(1.6e-4 * training.extent)
    rates.log_scales.fill_(5e-3)
    rates.quats.fill_(1e-3)
    rates.opacity_logits.fill_(0.05)
    rates.sh[:, 0], rates.sh[:, 1:] = 2.5e-3, 1.25e-4
    return rates.flat[:, None] * H * rates.flat


def spectra(objective: SceneObjective, checkpoint: Checkpoint, operator: str) -> dict[str, torch.Tensor]:
    matrix = dense(objective, checkpoint.training, operator)
    blocks = {"all": slice(0, len(matrix)), **objective.blocks}
    return {name: torch.linalg.eigvalsh((matrix + matrix.T)[rows, rows] / 2) for name, rows in blocks.items()}


def indices(spectrum: torch.Tensor) -> dict[str, float]:
    total = float(spectrum.abs().sum())
    return {"top_mass": float(spectrum[-1]) / total, "participation_ratio": total**2 / float(spectrum.square().sum())}


def most_misses(brackets: int, level: float) -> int:
    """Brackets that each miss with the probability `level` miss more often than this once in ten thousand runs."""
    return int(binom.ppf(1 - 1e-4, brackets, level))


def of_split(objective: SceneObjective, checkpoint: Checkpoint) -> SceneObjective:
    return SceneObjective(
        split_in_two(objective.active), objective.views, checkpoint.training.config.loss, objective.background
    )


@pytest.mark.parametrize("operator", ["hessian", "gauss-newton"])
def test_every_family_is_that_of_the_dense_block_in_the_metrics_units(split, objective, checkpoint, operator):
    held, resolved = [], 0
    for scene, of in (("trained", objective), ("split", of_split(objective, checkpoint))):
        true = spectra(of, checkpoint, operator)
        rows = [row for row in split.rows if (row.scene, row.operator) == (scene, operator)]
        assert [row.block for row in rows] == BLOCKS
        for row in rows:
            spectrum, ends, family = true[row.block], row.family.ends, row.family
            size = float(spectrum.abs().max())
            assert row.gaussians == len(of.active)
            assert int((spectrum.abs() > 1e-12 * size).sum()) <= family.rank <= len(spectrum)
            low, high = ends.largest.interval()
            assert low - 1e-9 * size <= float(spectrum[-1]) <= high + 1e-9 * size, (row.block, scene)
            least, residual = float(ends.smallest.values[0]), float(ends.smallest.residuals[0])
            assert float((spectrum - least).abs().min()) <= residual + 1e-9 * size
            # of Gauss-Newton's, next to nothing, 40 products may see no end
            if not ends.smallest.reason.endswith("budget"):
                assert least - residual <= float(spectrum[0]) + 1e-9 * size, (row.block, scene)
                resolved += 1
            for name, value in indices(spectrum).items():
                bracket = getattr(family.indices, name)
                held.append(bracket.low * (1 - 1e-9) <= value <= bracket.high * (1 + 1e-9))
    assert held.count(False) <= most_misses(len(held), 0.05), held
    assert resolved >= (10 if operator == "hessian" else 5)


def test_the_splits_effect_brackets_the_quotient_of_dense_indices(split, objective, checkpoint):
    assert {(e.operator, e.block) for e in split.effects} == {*product(("hessian", "gauss-newton"), BLOCKS)}
    held = []
    for operator in ("hessian", "gauss-newton"):
        before, after = (spectra(of, checkpoint, operator) for of in (objective, of_split(objective, checkpoint)))
        for effect in (
            e for e in split.effects if e.operator == operator and e.index in ("top_mass", "participation_ratio")
        ):
            true = indices(after[effect.block])[effect.index] / indices(before[effect.block])[effect.index]
            held.append(effect.low <= true <= effect.high)
            both = [row.family.indices for row in split.rows if (row.operator, row.block) == (operator, effect.block)]
            assert effect.value == getattr(both[1], effect.index).value / getattr(both[0], effect.index).value
    assert held.count(False) <= most_misses(len(held), 0.1), held


def test_a_quotient_is_undetermined_where_a_bracket_has_0_or_no_end():
    assert str(quotient(Bracket(-6.0, -8.0, -5.0), Bracket(2.0, 2.0, 2.5))) == "-3 in [-4, -2]"
    for unknown in (Bracket(1.0, -1.0, 2.0), Bracket(1.0, 0.5, float("inf"), "why"), None):
        assert quotient(unknown, Bracket(2.0, 1.0, 3.0)).record()["low"] is None
        assert quotient(Bracket(2.0, 1.0, 3.0), unknown).value is None


def test_the_trained_scenes_numbers_are_the_same_without_the_split_control(split, objective, checkpoint):
    alone = found(objective, checkpoint, metric="optimiser")
    assert alone.control is None and alone.effects == ()
    numbers = [[row.record("optimiser", "") for row in of.rows if row.scene == "trained"] for of in (alone, split)]
    assert numbers[0] == numbers[1] and len(numbers[0]) == len(alone.rows)


def test_the_metrics_have_the_units_that_they_name(objective, checkpoint, split):
    plain = found(objective, checkpoint)
    top = [{row.block: float(row.family.ends.largest.values[0]) for row in of.rows} for of in (plain, split)]
    assert top[1]["quats"] == pytest.approx(1e-6 * top[0]["quats"], rel=0.5)
    assert f"extent {checkpoint.training.extent:.4g}" in split.unit


def test_the_record_and_the_page_hold_every_family_and_what_the_split_does(record, split):
    rows = record.data.per_attribute
    assert len(rows) == 24 and {row.metric for row in rows} == {"optimiser"} and rows[0].unit == split.unit
    assert [row.block for row in rows[:6]] == BLOCKS and sum(row.split for row in rows) == 12
    control = record.data.split_control
    assert control.psnr == pytest.approx(split.control.psnr) and len(control.effects) == 12 * len(INDICES)
    page = Tables((record.folder / "report.html").read_text(encoding="utf-8"))
    lines = page.rows("per_attribute")
    assert len(lines) == 1 + 3 * 12 and all(len(line) == len(lines[0]) == 7 + len(INDICES) for line in lines)
    assert sum("×" in line[7 + 2] for line in lines if line[2] == "changes by") == 12  # the share
    assert soft(split.unit) in page.text


def test_a_family_whose_small_end_is_not_resolved_is_given_by_its_bound(record):
    data = copy.deepcopy(record.data)
    indices = data.per_attribute[0].indices
    indices.eigenvalue_ratio = Index(value=7.0, low=34.2, high=None, note="lambda_min is not resolved")
    indices.participation_ratio = Index(value=7.0, low=0.0, high=None, note="2 steps")
    cells = family_lines(data)[0].indices
    assert cells[0].value == "≥ 34.2" and cells[0].note == "lambda_min is not resolved"
    assert cells[-1].value == "–"  # a bound that says nothing
    page = Tables(render_report(Record(record.folder, data, record.arrays)))
    assert page.rows("per_attribute")[1][7] == "≥ 34.2"


def test_an_end_that_was_not_reached_says_so_with_its_bound(record):
    data = copy.deepcopy(record.data)
    row = data.per_attribute[0]
    data.per_attribute, data.split_control = [row], UNSET

    def ends() -> tuple[Cell, ...]:
        return family_lines(data)[0].ends

    row.lambda_min = End(value=1e-5, residual=2.4e-4, reason="matvec budget")
    for row.beyond, bracket in ((0.03, "−0.0302 … 2.50 × 10⁻⁴"), (None, "≤ 2.50 × 10⁻⁴")):
        value, found, note = astuple(ends()[1])
        assert (value, soft(found), note) == ("not reached", bracket, "matvec budget")
    row.lambda_max, row.beyond = End(value=2.0, residual=0.1, reason="matvec budget"), 0.5
    assert ends()[0] == Cell("not reached", "1.90 … 2.60", "matvec budget")
    row.lambda_min.reason = "tolerance"
    assert soft(ends()[1].value) == "(0.1 ± 2.4) × 10⁻⁴"
    assert record.data.per_attribute[0].beyond is not None


def test_at_80_columns_every_number_and_label_is_whole(record):
    data = copy.deepcopy(record.data)
    wide = Index(value=-1.234e-4, low=-1.274e-4, high=-1.194e-4, note="")
    bracket = Index(value=8.25e-4, low=7.45e-4, high=1.02e4, note="")
    for row in data.per_attribute:
        row.indices.eigenvalue_ratio, row.indices.top_mass, row.indices.participation_ratio = wide, bracket, bracket
    for effect in data.split_control.effects:
        numbers = wide if effect.index == "eigenvalue_ratio" else bracket
        effect.value, effect.low, effect.high, effect.note = numbers.value, numbers.low, numbers.high, ""
    console = Console(width=80, file=io.StringIO())
    console.print(family_table(data))
    assert isinstance(console.file, io.StringIO)
    lines = console.file.getvalue().splitlines()
    assert max(map(len, lines)) <= 80
    said = soft("\n".join(lines))
    for whole in ("Gauss-Newton", "colour (SH)", "  changes by", "participation ratio"):
        assert whole in said
    assert said.count("± 0.04) × 10⁻⁴") == 36 and said.count("7.45 × 10⁻⁴ …") == said.count("1.02 × 10⁴") >= 72
    assert not re.search(r"\S…", said)  # where text was cut off


def test_the_families_leave_the_other_numbers_as_they_are(path, record, monkeypatch, capsys):
    monkeypatch.setattr("analysis.console.drawing.drawing", lambda *_: nullcontext(lambda target: []))
    assert main(["probe", str(path), *QUICK, "--out", str(path.parent / "plain")]) == 0
    plain = read_record(path.parent / "plain", ProbeRecord)
    assert not plain.data.per_attribute and not plain.data.split_control and "per_attribute" not in plain.arrays
    for key in ("traces", "eigenvalues", "anisotropy", "slice"):
        assert getattr(plain.data, key) == getattr(record.data, key)
    assert "Anisotropy by attribute" not in (plain.folder / "report.html").read_text(encoding="utf-8")
    assert "Anisotropy by attribute" not in capsys.readouterr().out


@pytest.mark.parametrize("metric", ["parameters", "optimiser"])
def test_the_own_blocks_lead_where_they_know_the_ends_in_every_metric(objective, checkpoint, metric, monkeypatch):
    seen = {}

    def watched(operator, *given):
        whole, block = (operator.inner, *operator.blocks) if hasattr(operator, "rows") else (operator, "all")
        seen[getattr(whole, "inner", whole).gauss_newton, block] = whole, *given[4:]
        return block_anisotropy(operator, *given)

    monkeypatch.setattr("analysis.measures.per_attribute.block_anisotropy", watched)
    found(objective, checkpoint, metric=metric)
    assert len(seen) == 2 * len(BLOCKS)
    own, pixelwise = objective.approximate_blocks
    for (gauss_newton, block), (operator, start, _) in seen.items():
        scale = None if metric == "parameters" else operator.scale[:, 0]
        attribute = None if block == "all" else block
        if block not in ("all", "means", "quats"):
            assert start is None
        else:
            known = BlockEigenvectors(objective, pixelwise if gauss_newton else own, pixelwise, attribute, scale)
            upwards = gauss_newton or block == "means"
            assert torch.equal(start, known.steepest(1, 0) if upwards else known.warm_start())
    eye = torch.eye(objective.active.flat.numel(), dtype=torch.float64)
    diagonals = {newton: seen[newton, "all"][0].apply(eye).diagonal() for newton in (False, True)}
    for (gauss_newton, block), (_, _, (value, error)) in seen.items():
        diagonal, rows = diagonals[gauss_newton], slice(None) if block == "all" else objective.blocks[block]
        assert abs(value - float(diagonal[rows].sum())) < 4 * error + 1e-9 * float(diagonal[rows].abs().sum())


@pytest.mark.parametrize("metric", ["parameters", "optimiser"])
def test_the_ends_that_were_looked_for_lead_to_those_of_the_whole(objective, checkpoint, metric, monkeypatch):
    starts = []

    def watched(*given):
        starts.append((type(given[0]) is not RestrictedOperator, given[5]))
        return block_anisotropy(*given)

    monkeypatch.setattr("analysis.measures.per_attribute.block_anisotropy", watched)
    ends = extreme_eigenpairs(SceneHessian(objective), torch.Generator().manual_seed(1), EigenSettings(2, 1))
    found(objective, checkpoint, metric=metric, split_control=True, ends=ends)
    known = torch.stack([ends.largest.vectors[:, 0], ends.smallest.vectors[:, 0]], dim=1)
    begins = [whole for whole, start in starts if start is not None and torch.equal(start, known)]
    assert begins == ([True] if metric == "parameters" else [])  # those of the trained scene's Hessian alone


def test_memory_bounds_the_vectors_that_are_kept(objective, checkpoint):
    small = found(objective, checkpoint, memory=10 * objective.active.flat.numel() * 8 / 2**30)
    assert any("kept 10 vectors instead of 64" in note for note in small.notes)


class Tables(HTMLParser):
    """The visible text of a page, and the cells of its tables by their class."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.texts: list[str] = []
        self.tables: dict[str | None, list[list[str]]] = {}
        self.current: list[list[str]] = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        if tag == "table":
            self.current = self.tables.setdefault(dict(attrs).get("class"), [])
        elif tag == "tr":
            self.current.append([])
        elif tag in ("td", "th"):
            self.current[-1].append("")

    def handle_data(self, data):
        self.texts.append(data)
        if self.current and self.current[-1]:
            self.current[-1][-1] += data

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.texts).split())

    def rows(self, name: str) -> list[list[str]]:
        return [[" ".join(cell.split()) for cell in row] for row in self.tables[name]]
