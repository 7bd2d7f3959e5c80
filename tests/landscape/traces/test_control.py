from math import sqrt

import numpy as np
import pytest
import torch

from landscape.operators.operator import CountingOperator, DenseOperator
from landscape.traces.control import controlled, restrict
from landscape.traces.diagonal import estimate_diagonal
from landscape.traces.trace import TraceSettings, estimate_traces
from tests.landscape.spectra import generator
from tests.landscape.traces.test_trace_cover import SEEDS, Copies, cover
from tests.oracles import symmetric_matrix

N = 40
BLOCKS = {"a": slice(0, 25), "b": slice(25, N)}
PART = torch.from_numpy(symmetric_matrix(1 / np.arange(1.0, N + 1), seed=0))
REST = torch.from_numpy(symmetric_matrix(0.02 * np.linspace(-1, 1, N), seed=1))
# K is like H to different degrees in different rows
UNEVEN = torch.diag(torch.linspace(0.5, 1.5, N, dtype=torch.float64))
H = UNEVEN @ PART @ UNEVEN + REST


class Partly(DenseOperator):
    """H, of which the diagonal of PART is known."""

    def __init__(self, matrix=H, part=PART, blocks=BLOCKS):
        super().__init__(matrix, blocks)
        self.known = DenseOperator(part, blocks)

    def known_diagonal(self):
        return self.known.matrix.diagonal()


class PartlyCopies(Copies):
    known = Copies(PART)

    def known_diagonal(self):
        return PART.diagonal().repeat(SEEDS)


class Wholly(DenseOperator):
    @property
    def known(self):
        return self

    def known_diagonal(self):
        return self.matrix.diagonal()


@pytest.mark.parametrize("reading", ["block", "full"])
@pytest.mark.parametrize("distribution", ["gaussian", "rademacher"])
def test_a_known_part_leaves_the_mean_and_takes_most_of_the_error(distribution, reading):
    seeds, settings = 100, TraceSettings.fixed(12, distribution, reading)
    plain, controlled_runs = (
        [estimate_traces(operator, generator(seed), settings) for seed in range(seeds)]
        for operator in (DenseOperator(H, BLOCKS), Partly())
    )
    for name, rows in BLOCKS.items():
        values = torch.tensor([run[name].value for run in controlled_runs], dtype=torch.float64)
        truth = float(H[rows, rows].trace())
        assert abs(float(values.mean()) - truth) < 4 * float(values.std()) / sqrt(seeds)
        without = torch.tensor([run[name].value for run in plain], dtype=torch.float64)
        assert float(values.std()) < float(without.std()) / 2, name


@pytest.mark.parametrize("distribution", ["gaussian", "rademacher"])
def test_intervals_with_a_fitted_control_cover_at_the_nominal_rate(distribution):
    estimates = estimate_traces(PartlyCopies(H), generator(), TraceSettings.fixed(10, distribution, "full"))
    assert all(e.standard_error < sqrt(2 / 10) * float(H.norm()) for e in estimates.values())  # the control is in use
    assert 0.93 <= cover(estimates.values(), float(H.trace())) <= 0.97


def test_a_part_that_is_all_of_the_operator_leaves_no_error_but_round_off():
    for estimate in estimate_traces(Partly(H, H), generator(), TraceSettings.fixed(8, "gaussian")).values():
        assert estimate.standard_error < 1e-13
        assert estimate.value == pytest.approx(
            float(H[BLOCKS[estimate.block], BLOCKS[estimate.block]].trace()), abs=1e-12
        )


def test_an_operator_that_knows_its_diagonal_is_not_probed():
    operator = CountingOperator(DenseOperator(H))
    whole = Wholly(H, BLOCKS)
    whole.apply = operator.apply
    for name, estimate in estimate_traces(whole, generator()).items():
        assert estimate.value == pytest.approx(float(H[BLOCKS[name], BLOCKS[name]].trace()), abs=1e-13)
        assert (estimate.reason, estimate.method, estimate.standard_error) == ("exact", "exact", 0.0)
    diagonal = estimate_diagonal(whole, generator())
    assert torch.equal(diagonal.values, H.diagonal()) and not diagonal.standard_errors.any()
    assert diagonal.matvecs == operator.matvecs == 0


def test_a_restriction_keeps_what_is_known():
    block = restrict(Partly(), "b")
    assert torch.equal(block.known_diagonal(), PART.diagonal()[25:])  # pyright: ignore[reportAttributeAccessIssue]
    V = torch.randn(15, 2, dtype=torch.float64, generator=generator())
    assert torch.allclose(block.known.apply(V), PART[25:, 25:] @ V)  # pyright: ignore[reportAttributeAccessIssue]
    whole = restrict(Wholly(H, BLOCKS), "a")
    assert whole.known is whole  # pyright: ignore[reportAttributeAccessIssue]


@pytest.mark.parametrize("trace", [0.0, 2.0**24, 2.0**30])
def test_no_sample_has_a_part_in_its_own_slope(trace):
    x, y = torch.randn(2, 9, dtype=torch.float64, generator=generator())
    found = controlled(x + trace, y + trace, 0.3 + trace) - trace  # a large trace hides no slope
    for i in range(9):
        rest = torch.arange(9) != i
        slope = np.polyfit(y[rest].numpy(), x[rest].numpy(), 1)[0]
        assert float(found[i]) == pytest.approx(float(x[i] - slope * (y[i] - 0.3)), abs=1e-12 + 1e-15 * trace)


@pytest.mark.parametrize("step", [0.3, 0.7, 1e3 / 3])
@pytest.mark.parametrize("count", [8, 10, 12, 13, 32])
def test_a_sample_whose_others_know_no_slope_is_left_as_it_is(count, step):
    """As random signs give them where the known part is sparse."""
    y = torch.full((count,), 0.37, dtype=torch.float64)
    y[2] += step
    x = torch.randn(count, dtype=torch.float64, generator=generator())
    assert float(controlled(x, y, 0.4)[2]) == float(x[2])


@pytest.mark.parametrize("size", [2.0**531, 2.0**-664])
def test_a_known_part_of_any_size_helps_as_much(size):
    settings = TraceSettings.fixed(12)
    one, other = (estimate_traces(Partly(scale * H, scale * PART), generator(), settings)["a"] for scale in (1.0, size))
    assert [other.value / size, other.low / size, other.high / size] == pytest.approx(
        [one.value, one.low, one.high], rel=1e-12
    )
