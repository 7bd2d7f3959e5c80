import numpy as np
import pytest
import torch

from landscape.eigen.eigen import EigenSettings, extreme_eigenpairs
from landscape.eigen.lanczos import lanczos
from landscape.linalg import unit_columns
from landscape.operators.operator import DenseOperator, ProjectedOperator
from landscape.probes import draw_probes
from landscape.spectrum.absolute_sum import absolute_integral, absolute_sum
from landscape.spectrum.density import ActiveSpace, draw_starts, spectral_density
from landscape.spectrum.quantiles import _Tail, absolute_quantile, quantile
from landscape.spectrum.rules import SpectralDensity
from tests.landscape.spectra import ROUNDING, SPECTRA, N, eigenvalues, generator, operator

NOT_ZERO = [name for name in SPECTRA if name != "zero"]


def by_count(true, p):
    """The smallest eigenvalue with the share p of all at or below it."""
    return float(true[int(np.ceil(p * len(true) - 1e-9)) - 1])


def by_curvature(true, p):
    magnitudes = true.abs().sort().values
    return float(magnitudes[int(torch.searchsorted(magnitudes.cumsum(0), p * magnitudes.sum()))])


@pytest.mark.parametrize("steps", [3, 12, 25])
@pytest.mark.parametrize("name", NOT_ZERO)
def test_the_curvature_that_a_start_vector_sees_above_any_magnitude_is_within_its_bounds(name, steps):
    H = operator(name)
    density = spectral_density(H, generator(), matvecs=3 * steps, starts=3, batch=1)
    values, vectors = torch.linalg.eigh(H.matrix)
    seen = (vectors.T @ unit_columns(draw_starts(N, 3, generator(), torch.float64))).square()
    scale = float(values.abs().max())
    # off the eigenvalues, where the exact side of a jump is round-off's to choose
    levels = scale * torch.linspace(0, 1.1, 1000, dtype=torch.float64) ** 3 + 1e-5 * scale
    rounding = 1e-7 * scale  # bounds of sum |lambda| are good to the root of eps
    for i, rule in enumerate(density.rules()):
        low, _, high = absolute_integral(*rule)
        tail = _Tail(*rule, (low, high))
        for p in (0.05, 0.5):
            exact = ((values.abs() > levels[:, None]) * values.abs() * seen[:, i]).sum(dim=1)
            exact -= (1 - p) * (values.abs() * seen[:, i]).sum()
            least, most = tail.excess(levels, p)
            assert (least <= exact + rounding).all() and (exact <= most + rounding).all()


@pytest.mark.parametrize("name", ["power law", "indefinite", "clustered", "rank-deficient"])
def test_quantile_brackets_cover_at_least_at_the_nominal_rate(name):
    H = operator(name)
    true, runs = eigenvalues(H), 25
    rounding = 1e-10 * float(true.abs().max())
    covered = dict.fromkeys([(kind, p) for kind in (quantile, absolute_quantile) for p in (0.05, 0.5)], 0)
    for seed in range(runs):
        density = spectral_density(H, generator(seed), matvecs=48, starts=4, batch=4)
        for kind, p in covered:
            truth, bracket = (by_count if kind is quantile else by_curvature)(true, p), kind(density, p)
            assert bracket.value is not None and bracket.low <= bracket.value <= bracket.high
            covered[kind, p] += bracket.low - rounding <= truth <= bracket.high + rounding
    floor = 0.95 - 4 * np.sqrt(0.95 * 0.05 / runs)
    assert min(covered.values()) / runs >= floor


def test_brackets_close_in_on_a_large_spectrum():
    diagonal = torch.linspace(-1, 3, 4001, dtype=torch.float64)
    reflector = draw_probes(4001, 1, generator(5), torch.float64)
    reflector /= reflector.norm()

    class Reflected:
        dim, dtype, blocks = 4001, torch.float64, {"all": slice(0, 4001)}

        def apply(self, V):
            V = diagonal[:, None] * (V - 2 * reflector * (reflector.T @ V))
            return V - 2 * reflector * (reflector.T @ V)

    widths = []
    for steps in (15, 60):
        density = spectral_density(Reflected(), generator(), matvecs=4 * steps, starts=4, batch=4)
        for kind, truth in ((quantile, 2.0), (absolute_quantile, by_curvature(diagonal, 0.75))):
            bracket = kind(density, 0.75)
            assert bracket.low <= truth <= bracket.high
            widths.append(bracket.high - bracket.low)
    assert widths[2] < widths[0] / 2.5 and widths[3] < widths[1] / 2
    assert widths[2] < 0.4  # 4 / 60 a gap between nodes, of which a bracket has two, and the start vectors' spread


def test_a_known_null_space_is_left_out_and_the_counts_are_those_of_the_rest():
    rank = 40
    basis = torch.linalg.qr(draw_probes(N, rank, generator(7), torch.float64)).Q
    curvatures = torch.linspace(1, 2, rank, dtype=torch.float64)
    inner = DenseOperator(basis @ torch.diag(curvatures) @ basis.T + torch.eye(N) - basis @ basis.T)
    H = ProjectedOperator(inner, lambda V: basis @ (basis.T @ V))
    active = ActiveSpace(H.project, rank)
    medians, covered, runs = 0, 0, 40
    for seed in range(runs):
        density = spectral_density(H, generator(seed), matvecs=48, starts=4, active=active)
        assert density.dim == rank and float(density.nodes.min()) > 1 - 1e-9  # none of the 80 zeros
        median, total = quantile(density, 0.5), absolute_sum(density)
        medians += median.low <= by_count(curvatures, 0.5) <= median.high
        covered += total.low <= 60 <= total.high
    floor = 0.95 - 4 * np.sqrt(0.95 * 0.05 / runs)
    assert medians / runs >= floor and covered / runs >= floor
    whole = spectral_density(H, generator(), matvecs=164, starts=4)
    assert quantile(whole, 0.5).value == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", ["power law", "both tails", "indefinite"])
def test_brackets_about_known_eigenvalues_are_as_wide_as_their_residuals(name, dtype):
    """Ends that were found to 1%, and all that is left between them."""
    true = torch.from_numpy(SPECTRA[name][:: N // 12]).double()
    Q = torch.linalg.qr(torch.randn(len(true), len(true), generator=generator(4), dtype=torch.float64)).Q
    H = DenseOperator(((Q * true) @ Q.T).to(dtype))
    true, held, narrow, runs = eigenvalues(H), 0, 0, 12
    for seed in range(runs):
        ends = extreme_eigenpairs(H, generator(seed), EigenSettings(3, 2, rtol=1e-2))
        density = spectral_density(H, generator(seed), 60, 3, batch=3, ends=ends)
        for p in (0.05, 0.5, 0.9):
            truth, bracket = by_curvature(true, p), absolute_quantile(density, p)
            rank, median = by_count(true, p), quantile(density, p)
            slack = ROUNDING * float(true.abs().max())
            held += bracket.low - slack <= truth <= bracket.high + slack
            held += median.low - slack <= rank <= median.high + slack
            narrow += bracket.high - bracket.low < 0.02 * float(true.abs().max())
    assert held == 6 * runs and narrow > runs


def middles(values, steps, p=0.05):
    """Log of the value over the truth, of a start vector that sees all eigenvalues alike."""
    (run,) = lanczos(DenseOperator(torch.diag(values)), torch.ones(len(values), 1, dtype=torch.float64), steps)
    nodes, S = torch.linalg.eigh(run.T)
    density = SpectralDensity(nodes.repeat(2, 1), S[0].square().repeat(2, 1), len(values), 2 * steps)
    value = absolute_quantile(density, p).value
    assert value is not None
    return np.log(value / by_curvature(values, p))


@pytest.mark.parametrize("steps", [9, 12, 16])
@pytest.mark.parametrize("decades", [2, 4])
def test_the_middle_of_a_mass_quantile_is_near_where_eigenvalues_gather_about_zero(steps, decades):
    """As many in every octave; a node near 0 has eigenvalues of both signs in its place."""
    sizes, off = torch.logspace(-decades, 0, 400, dtype=torch.float64), []
    for seed in range(15):
        signs = torch.where(torch.rand(400, generator=generator(seed)) < 0.4, -1.0, 1.0)
        off.append(middles(signs * sizes, steps))
    assert np.sqrt(np.mean(np.square(off))) < 0.2 and np.max(np.abs(off)) < 0.4


@pytest.mark.parametrize("steps", [9, 14, 25])
def test_the_middle_of_a_mass_quantile_is_near_where_eigenvalues_are_uniform(steps):
    off = [middles(torch.linspace(c - 1, c + 1, 300, dtype=torch.float64), steps) for c in np.linspace(-0.3, 0.3, 21)]
    assert np.sqrt(np.mean(np.square(off))) < 0.2 and np.max(np.abs(off)) < 0.3


def test_the_zero_operator_has_no_curvature_to_share_and_its_eigenvalues_are_zero():
    density = spectral_density(operator("zero"), generator())
    assert absolute_quantile(density).value is None
    assert quantile(density, 0.5).value == 0


def test_what_no_node_bounds_is_infinite():
    rule = SpectralDensity(torch.tensor([[-1.0, 1.0]] * 2).double(), torch.full((2, 2), 0.5).double(), 10**6, 4)
    assert (quantile(rule, 0.3).low, quantile(rule, 0.7).high) == (-np.inf, np.inf)


@pytest.mark.parametrize("p", [0.0, 1.0, -0.1, float("nan")])
def test_shares_outside_0_to_1_are_refused(p):
    density = spectral_density(operator("indefinite"), generator(), 4, 2)
    for kind in (quantile, absolute_quantile):
        with pytest.raises(ValueError, match="share p between 0 and 1"):
            kind(density, p)
    with pytest.raises(ValueError, match="rank 1 or more"):
        ActiveSpace(lambda V: V, 0)
