"""What a spectral density makes of eigenpairs and a trace that are known before it, and how it divides its products."""

from dataclasses import replace

import pytest
import torch

from landscape.eigen.eigen import EigenSettings, extreme_eigenpairs
from landscape.eigen.lanczos import lanczos
from landscape.linalg import norm
from landscape.operators.operator import DenseOperator, ProjectedOperator
from landscape.spectrum.absolute_sum import absolute_integral, absolute_sum
from landscape.spectrum.density import FIRST_LOOK, Lengths, spectral_density, without
from landscape.traces.estimate import TraceEstimate
from landscape.traces.trace import total_trace
from tests.landscape.spectra import N, eigenvalues, generator, operator

RUNS = 16


def legendre(size):
    """T of the uniform measure on [-1, 1]."""
    j = torch.arange(1, size, dtype=torch.float64)
    off = j / (4 * j**2 - 1).sqrt()
    return torch.diag(off, 1) + torch.diag(off, -1)


def ends_of(H, rtol=1e-6):
    return extreme_eigenpairs(H, generator(9), EigenSettings(3, 2, rtol=rtol))


def errors(H, f, **given):
    """Root mean square error of sum f(lambda), as a share of it, and the mean of the errors."""
    truth = float(f(eigenvalues(H)).sum())
    found = [spectral_density(H, generator(seed), 48, 4, **given).integral(f).value for seed in range(RUNS)]
    off = torch.tensor(found, dtype=torch.float64) / truth - 1
    return float(off.square().mean().sqrt()), float(off.mean())


@pytest.mark.parametrize("steps", [5, 12, 40])
@pytest.mark.parametrize("name", ["power law", "both tails", "indefinite"])
def test_eigenvectors_taken_out_of_a_run_leave_that_of_the_others(name, steps):
    H = operator(name)
    values, vectors = torch.linalg.eigh(H.matrix)
    known, size = torch.tensor([0, N - 2, N - 1]), float(values.abs().max())
    V, z = vectors[:, known], torch.randn(N, 1, generator=generator(), dtype=torch.float64)
    projected = ProjectedOperator(H, lambda X: X - V @ (V.T @ X))
    (whole,), (direct,) = lanczos(H, z, steps), lanczos(projected, z - V @ (V.T @ z), steps, scale=size)
    found = without(whole, V, values[known], 0.0)
    assert steps - 3 <= len(found.T) and float((V.T @ found.Q).norm()) < 1e-6
    if len(found.T) == steps:  # a Lanczos run of H
        R = H.matrix @ found.Q - found.Q @ found.T
        assert float(R[:, :-1].norm()) < 1e-7 * size and float((R[:, -1] - found.r).norm()) < 1e-7 * size
    for degree in range(2 * steps - 8):  # the moments of the start vector's measure of the others
        moments = [float(torch.linalg.matrix_power(run.T / size, degree)[0, 0]) for run in (found, direct)]
        assert moments[0] == pytest.approx(moments[1], abs=1e-7), degree


def test_whoever_watches_sees_runs_with_the_ends_in_them_and_the_density_is_that_without():
    H, seen = operator("both tails"), []
    density = spectral_density(H, generator(), 48, 4, ends=ends_of(H, 1e-9), watch=seen.extend)
    unseen = spectral_density(H, generator(), 48, 4, ends=ends_of(H, 1e-9))
    values = eigenvalues(H)
    assert float(torch.stack([torch.linalg.eigvalsh(run.T)[-1] for run in seen]).min()) > float(values[-4])
    assert torch.allclose(density.known, unseen.known) and density.matvecs == unseen.matvecs == 48
    assert density.integral(torch.square).value == pytest.approx(unseen.integral(torch.square).value, rel=1e-9)
    total, other = density.integral(torch.abs), unseen.integral(torch.abs).value
    assert total.low is not None and total.high is not None and other is not None
    assert total.low < other < total.high


@pytest.mark.parametrize("f", [torch.abs, torch.square])
@pytest.mark.parametrize("name", ["power law", "both tails"])
def test_a_known_trace_takes_the_spread_away_that_it_shares_and_adds_no_bias(name, f):
    H, x = operator(name), eigenvalues(operator(name))
    shared = float((f(x) * x).sum() ** 2 / (f(x).square().sum() * x.square().sum()))
    plain, _ = errors(H, f, batch=1)
    controlled, bias = errors(H, f, batch=1, trace=(float(x.sum()), 0.0))
    assert controlled < 1.5 * plain * max(1 - shared, 1e-6) ** 0.5 < plain
    assert abs(bias) < 4 * controlled / RUNS**0.5 + 1e-12


def test_a_trace_that_is_known_badly_is_used_as_far_as_it_helps():
    H = operator("both tails")
    truth, trace = float(eigenvalues(H).abs().sum()), float(H.matrix.trace())
    noise = torch.randn(RUNS, generator=generator(1), dtype=torch.float64).tolist()
    widths, covered = [], 0
    for error in (0.0, 0.1 * trace, 100 * trace, None):
        found = [
            absolute_sum(
                spectral_density(H, generator(seed), 48, 4, trace=None if error is None else (trace + z * error, error))
            )
            for seed, z in enumerate(noise)
        ]
        covered += sum(x.low <= truth <= x.high for x in found)
        widths.append(sum(x.high - x.low for x in found) / RUNS)
    assert widths[0] < widths[1] < widths[2] == pytest.approx(widths[3], rel=0.05)
    assert covered / (4 * RUNS) >= 0.95 - 4 * (0.95 * 0.05 / (4 * RUNS)) ** 0.5


def test_the_error_of_the_trace_is_in_the_interval_as_far_as_the_trace_is_in_the_sum():
    """Where all eigenvalues are positive the sum of magnitudes is the trace."""
    H = operator("power law")
    trace = float(H.matrix.trace())
    density = spectral_density(H, generator(), 48, 4, batch=1, trace=(trace, 0.1 * trace))
    shift, off = density.by_trace(torch.abs, 0.95)
    share = shift / (trace - density.rest * (density.weights * density.nodes).sum(dim=1))
    assert torch.allclose(share, share[0]) and 0.5 < float(share[0]) < 1
    assert off == pytest.approx(1.959964 * 0.1 * trace * float(share[0]), rel=1e-6)


@pytest.mark.parametrize("name", ["indefinite", "both tails"])
def test_eigenpairs_that_were_found_before_are_known_and_counted_once(name):
    H = operator(name)
    true, ends = eigenvalues(H), ends_of(H)
    density = spectral_density(H, generator(), 60, 4, batch=1, ends=ends)
    assert torch.allclose(density.known, torch.cat([true[:2], true[-3:]]), rtol=0, atol=1e-9)
    assert density.rest == N - 5
    inner = density.nodes[density.weights > 0]
    assert float(inner.min()) > float(true[2]) - 1e-9 and float(inner.max()) < float(true[-4]) + 1e-9
    # those that the runs find are others
    more = spectral_density(H, generator(), 120, 4, ends=ends).known
    assert len(more) > 5 and float(torch.diff(more).min()) > 1e-6
    plain, _ = errors(H, torch.square, batch=1)
    known, bias = errors(H, torch.square, batch=1, ends=ends)
    left = float(true[2:-3].pow(4).sum() / true.pow(4).sum())
    assert known < 1.25 * plain * left**0.5 < plain and abs(bias) < 4 * known / RUNS**0.5


def test_pairs_with_bad_vectors_are_not_known_and_one_end_is_not_counted_twice():
    H = operator("indefinite")
    ends = ends_of(H)
    bad = replace(ends.largest, vector_errors=torch.tensor([1e-6, 0.5, torch.inf], dtype=torch.float64))
    density = spectral_density(H, generator(), 16, 4, batch=1, ends=replace(ends, largest=bad))
    assert torch.allclose(density.known, torch.cat([ends.smallest.values, ends.largest.values[:1]]))
    same = spectral_density(H, generator(), 16, 4, batch=1, ends=replace(ends, smallest=ends.largest))
    assert len(same.known) == 3


@pytest.mark.parametrize("f", [torch.abs, torch.square])
def test_what_residuals_of_known_pairs_miss_is_in_the_interval(f):
    """Ends that are no eigenvectors: what the rest of the spectrum takes from them is no term of the sum."""
    values = torch.cat([torch.tensor([-3.0]), torch.linspace(1, 2, 5), torch.tensor([9.0])]).double()
    Q = torch.linalg.qr(torch.randn(7, 7, generator=generator(), dtype=torch.float64)).Q
    H = DenseOperator((Q * values) @ Q.T)
    for seed in range(8):
        ends = extreme_eigenpairs(H, generator(seed), EigenSettings(rtol=0.05, noise=1.0))
        V = torch.cat([ends.largest.vectors, ends.smallest.vectors], dim=1)
        V = torch.linalg.qr(V + 0.003 * torch.randn(7, 2, generator=generator(seed), dtype=torch.float64)).Q
        theta, U = torch.linalg.eigh(V.T @ H.matrix @ V)
        V = V @ U
        off = (H.matrix @ V - V * theta).norm(dim=0)
        low, high = (
            replace(
                end,
                values=theta[i : i + 1],
                vectors=V[:, i : i + 1],
                residuals=off[i : i + 1],
                vector_errors=off[i : i + 1] / 9,
            )
            for i, end in ((0, ends.smallest), (1, ends.largest))
        )
        found = spectral_density(H, generator(seed), 60, 4, ends=replace(ends, largest=high, smallest=low)).integral(f)
        truth = float(f(values).sum())
        assert found.low <= truth <= found.high and found.high - found.low < 0.1 * truth
        assert found.value is not None and abs(found.value - truth) > 1e-10 * truth


def test_where_the_ends_are_all_there_is_no_product_is_spent():
    H = DenseOperator(torch.diag(torch.tensor([-1.0, 2.0, 5.0], dtype=torch.float64)))
    ends = extreme_eigenpairs(H, generator(), EigenSettings(2, 1))
    density = spectral_density(H, generator(), ends=ends)
    assert density.matvecs == 0 and density.integral(torch.abs).value == pytest.approx(8.0)


def test_runs_are_many_where_start_vectors_differ():
    flat = torch.linspace(1, 2, N, dtype=torch.float64)
    Q = torch.linalg.qr(torch.randn(N, N, generator=generator(), dtype=torch.float64)).Q
    density = spectral_density(DenseOperator((Q * flat) @ Q.T), generator(), 192)
    assert len(density.nodes) >= 10 and 192 - density.nodes.shape[1] < density.matvecs <= 192


@pytest.mark.parametrize(("rest", "best"), [(10, FIRST_LOOK), (10**9, 48)])
def test_runs_are_long_where_their_bounds_are_wider_than_start_vectors_differ(rest, best):
    """Of eigenvalues that are uniform on [-1, 1] start vectors differ by the root of their number."""
    lengths, T = Lengths(192, 48, rest, traced=False), legendre(49)
    steps = next((m for m in range(1, 49) if lengths([(T[:m, :m], float(T[m, m - 1]))] * 4)), 48)
    assert lengths.best == best <= steps


def test_a_run_is_no_longer_than_asked_for_and_then_there_are_more():
    density = spectral_density(operator("indefinite"), generator(), 60, longest=5)
    assert density.nodes.shape == (12, 5) and density.matvecs == 60


def test_a_recurrence_ends_where_it_is_long_enough():
    seen = []

    def enough(runs):
        seen.append([(len(T), length) for T, length in runs])
        return len(seen) == 7

    starts = torch.randn(N, 2, generator=generator(), dtype=torch.float64)
    runs = lanczos(operator("indefinite"), starts, 30, enough=enough)
    plain = lanczos(operator("indefinite"), starts, 7)
    for run, same, (steps, length) in zip(runs, plain, seen[-1], strict=True):
        assert steps == len(run.T) == 7
        assert torch.equal(run.T, same.T) and torch.equal(run.r, same.r) and torch.equal(run.Q, same.Q)
        assert norm(run.r) == pytest.approx(length, rel=1e-14)


@pytest.mark.parametrize("steps", [5, 8, 13, 20])
def test_averaged_rules_are_closer_than_gauss_rules_where_the_kink_is_anywhere(steps):
    """|x - c| over the uniform measure on [-1, 1]: (1 + c^2) / 2."""
    nodes, S = torch.linalg.eigh(legendre(steps))
    weights, gauss, averaged = S[0].square(), [], []
    for c in torch.linspace(-0.3, 0.3, 41, dtype=torch.float64):
        low, value, high = absolute_integral(nodes - c, weights)
        truth = float(1 + c**2) / 2
        assert low <= value <= high and low <= truth <= high
        averaged.append(value - truth)
        gauss.append(float((weights * (nodes - c).abs()).sum()) - truth)
    assert torch.tensor(averaged).norm() < torch.tensor(gauss).norm() / 2


def test_the_trace_of_all_blocks_has_the_errors_of_all():
    def block(value, half):
        samples = torch.zeros(0, dtype=torch.float64)
        return TraceEstimate(
            "a", 3, value, half / 2, value - half, value + half, 0.95, 8, 8, "tolerance", samples, "hutchinson"
        )

    value, error = total_trace({"a": block(3.0, 0.1), "b": block(-1.0, 0.3)})
    assert value == 2.0 and error == pytest.approx(0.4 / 1.959964, rel=1e-6)


def test_a_trace_of_which_nothing_is_known_changes_nothing():
    H = operator("both tails")
    plain, told = (spectral_density(H, generator(), 48, 4, trace=trace) for trace in (None, (3.0, float("inf"))))
    for integral in (absolute_sum, lambda density: density.integral(torch.square)):
        assert integral(told) == integral(plain)
