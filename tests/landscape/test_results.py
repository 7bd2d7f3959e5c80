import json
from dataclasses import dataclass, fields, is_dataclass, make_dataclass
from math import inf, nan

import pytest
import torch
from torch import Tensor

import landscape
import splat
from landscape.eigen.eigen import extreme_eigenpairs
from landscape.eigen.power import power_ends
from landscape.results import Bracket, ShortRepr, standard_deviation
from landscape.slices.refinement import SliceSettings
from landscape.slices.slices import evaluate_slice
from landscape.spectrum.anisotropy import anisotropy
from landscape.spectrum.density import spectral_density
from landscape.traces.trace import estimate_traces
from tests.landscape.spectra import N, generator, operator


@pytest.mark.parametrize("size", [1.0, 2.0**600, 2.0**-600])
def test_a_standard_deviation_is_the_textbooks_at_any_size(size):
    samples = size * torch.tensor([[1.0, 0.0], [2.0, 0.0], [3.0, 0.0], [4.0, 0.0]], dtype=torch.float64)
    assert standard_deviation(samples).tolist() == pytest.approx([size * (5 / 3) ** 0.5, 0.0], rel=1e-14)


@pytest.mark.parametrize("name", ["both tails", "zero", "rank-deficient"])
def test_every_record_is_strict_json(name):
    H = operator(name)
    ends = extreme_eigenpairs(H, generator())
    records = [
        {block: estimate.record() for block, estimate in estimate_traces(H, generator()).items()},
        [pairs.record() for found in (ends, power_ends(H, generator())) for pairs in (found.largest, found.smallest)],
        anisotropy(ends, spectral_density(H, generator())).record(),
    ]
    assert json.loads(json.dumps(records, allow_nan=False)) == records


def test_a_record_has_no_number_where_there_is_none():
    assert Bracket(nan, -inf, 2.0).record() == {"value": None, "low": None, "high": 2.0, "note": ""}


def test_a_bracket_reads_as_a_sentence():
    assert str(Bracket(2.0, 1.0, 3.0, "a note")) == "2 in [1, 3] (a note)"
    assert str(Bracket(None, 5.0, inf, "why")) == ">= 5: why"
    assert str(Bracket(None, 0.0, 5.0, "why")) == "in [0, 5]: why"
    assert str(Bracket(None, inf, inf, "why")) == "undefined: why"


def test_results_are_shown_in_three_lines():
    H = operator("both tails")
    ends = extreme_eigenpairs(H, generator())
    density = spectral_density(H, generator(), 24, ends=ends)
    (trace,) = estimate_traces(H, generator()).values()
    x = torch.linspace(-1, 1, 5, dtype=torch.float64)
    plane = evaluate_slice(
        lambda v: (v @ v, None), torch.zeros(3), torch.eye(3)[:, :2], [x, x], settings=SliceSettings(None)
    )
    for result, words in (
        (ends, f"largest   {float(ends.largest.values):.6g} ±"),
        (density, f"of {N} eigenvalues"),
        (trace, f"({N} rows)"),
        (plane, "5 x 5"),
    ):
        lines = repr(result).splitlines()
        assert len(lines) == 3 and max(map(len, lines)) <= 120 and words in lines[0]


@dataclass(frozen=True, repr=False)
class Much(ShortRepr):
    tensor: Tensor
    names: tuple[str, ...]
    inside: object
    bracket: Bracket


def test_a_result_fits_on_three_lines_however_much_it_holds():
    many = tuple(f"view-{i:03d}" for i in range(100))
    much = Much(
        torch.zeros(1000, 7), many, Much(torch.zeros(2), ("a",), None, Bracket(1.0, 0.5, 2.0)), Bracket(2.0, 1.0, 3.0)
    )
    assert repr(much) == "Much(tensor=float32 1000 x 7, names=tuple of 100, inside=Much, bracket=2 in [1, 3])"
    assert "names=('a',), inside=None" in repr(much.inside)
    wide = make_dataclass("Wide", [(f"field_number_{i}", int) for i in range(99)], bases=(ShortRepr,), repr=False)
    said = repr(wide(*range(99)))
    assert said.count("\n") == 2 and said.endswith(" ...") and max(map(len, said.splitlines())) <= 100


def test_no_public_record_prints_its_tensors():
    records = [getattr(package, name) for package in (landscape, splat) for name in package.__all__]
    records = [each for each in records if isinstance(each, type) and is_dataclass(each)]
    holding = [each for each in records if any("Tensor" in str(field.type) for field in fields(each))]
    generated = [each.__name__ for each in holding if hasattr(each.__repr__, "__wrapped__")]  # by `dataclass`
    assert len(holding) > 10 and generated == ["ActiveSpace"]  # a function and a number
