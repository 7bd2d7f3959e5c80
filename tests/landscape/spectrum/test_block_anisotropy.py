import pytest
import torch

from landscape.eigen.eigen import EigenSettings
from landscape.operators.operator import CountingOperator, DenseOperator, ProjectedOperator, RestrictedOperator
from landscape.probes import spawn
from landscape.spectrum.block_anisotropy import BlockAnisotropy, BlockAnisotropySettings, block_anisotropy
from landscape.spectrum.density import ActiveSpace
from tests.landscape.spectra import N, eigenvalues, generator, operator

BLOCKS = {"a": slice(0, 50), "b": slice(50, N)}


def families(H, settings: BlockAnisotropySettings | None = None) -> dict[str, BlockAnisotropy]:
    """Of the whole and of every block."""
    parts, stream = {"all": H} | {name: RestrictedOperator(H, name) for name in H.blocks if name != "all"}, generator()
    return {
        name: block_anisotropy(part, spawn(stream), settings or BlockAnisotropySettings())
        for name, part in parts.items()
    }


def blocked(name="both tails"):
    return DenseOperator(operator(name).matrix, BLOCKS)


@pytest.mark.parametrize("name", ["both tails", "power law", "rank-deficient"])
def test_every_parts_brackets_hold_the_indices_of_its_own_dense_block(name):
    H = blocked(name)
    found = families(H, BlockAnisotropySettings(starts=4))
    for part, rows in {"all": slice(0, N), "a": BLOCKS["a"], "b": BLOCKS["b"]}.items():
        true = eigenvalues(DenseOperator(H.matrix[rows, rows]))
        total, indices = float(true.abs().sum()), found[part].indices
        assert indices.top_mass is not None and indices.participation_ratio is not None
        assert indices.top_mass.low <= float(true[-1]) / total <= indices.top_mass.high
        assert indices.participation_ratio.low <= total**2 / true.square().sum() <= indices.participation_ratio.high
        assert found[part].rank == rows.stop - rows.start


def test_an_unresolved_small_end_is_a_bound_in_every_part():
    H = blocked("rank-deficient")
    for part in families(H).values():
        assert part.indices.negative_ratio.low == 0 and part.indices.negative_ratio.high < 1e-2
        assert part.indices.eigenvalue_ratio.low > 100 and part.indices.eigenvalue_ratio.high == float("inf")


def test_the_budget_is_kept_part_by_part():
    H = CountingOperator(blocked("indefinite"))
    settings = BlockAnisotropySettings(EigenSettings(rtol=1e-9, max_matvecs=20), starts=2, steps=5)
    families(H, settings)
    assert H.matvecs <= 3 * (20 + 10)


def test_a_known_null_space_is_not_counted():
    basis = torch.linalg.qr(torch.randn(N, 30, generator=generator(2), dtype=torch.float64)).Q
    H = ProjectedOperator(blocked("multiple"), lambda V: basis @ (basis.T @ V))
    found = block_anisotropy(H, generator(), active=ActiveSpace(H.project, 30))
    assert found.rank == found.density.dim == 30
    true = torch.linalg.eigvalsh(basis.T @ blocked("multiple").matrix @ basis)
    rank = float(true.abs().sum().square() / true.square().sum())
    assert found.indices.participation_ratio is not None
    assert found.indices.participation_ratio.low <= rank <= found.indices.participation_ratio.high <= 30


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("sign", [1, -1])
def test_the_ends_are_of_what_a_known_null_space_leaves(dtype, sign):
    """Semi-definite matrices of 72 rows and rank 54: an end of 0 would be that of the null space."""
    for seed in range(15):
        stream = generator(seed)
        basis = torch.linalg.qr(torch.randn(72, 54, generator=stream, dtype=torch.float64)).Q
        true = torch.linspace(0, 1 + seed % 5, 54, dtype=torch.float64).exp() * sign
        P, H = (basis @ basis.T).to(dtype), (basis * true @ basis.T).to(dtype)
        found = block_anisotropy(DenseOperator(H), stream, active=ActiveSpace(lambda V, P=P: P @ V, 54))
        ratio = float(true.max() / true.min())
        assert found.indices.eigenvalue_ratio.low <= ratio <= found.indices.eigenvalue_ratio.high < float("inf")
        for end, value in ((found.ends.largest, true.max()), (found.ends.smallest, true.min())):
            assert abs(float(end.values[0] - value)) <= 0.02 * abs(float(value))


def test_a_part_of_one_row_has_one_eigenvalue():
    H = DenseOperator(torch.diag(torch.tensor([3.0, 2.0, 1.0]).double()), {"one": slice(0, 1), "two": slice(1, 3)})
    found = families(H)
    assert found["one"].indices.eigenvalue_ratio.value == pytest.approx(1.0)
    assert found["two"].indices.eigenvalue_ratio.value == pytest.approx(2.0)


def test_a_part_is_led_to_its_ends():
    H = DenseOperator(torch.diag(torch.linspace(-1, 3, N, dtype=torch.float64)))
    lead = torch.eye(N, dtype=torch.float64)[:, [0, N - 1]]
    led, alone = (block_anisotropy(H, generator(), start=start) for start in (lead, None))
    assert led.ends.matvecs < alone.ends.matvecs
    assert float(led.ends.smallest.values[0]) == pytest.approx(-1, rel=1e-2)


@pytest.mark.parametrize("size", [2.0**531, 2.0**-664])
def test_indices_do_not_depend_on_the_size_of_the_numbers(size):
    """1e160 and 1e-200: powers of two, which round nothing off."""
    one, other = (block_anisotropy(DenseOperator(c * operator("both tails").matrix), generator()) for c in (1.0, size))
    assert other.ends.noise == pytest.approx(size * one.ends.noise, rel=1)
    for index, scaled in zip(vars(one.indices).values(), vars(other.indices).values(), strict=True):
        assert [scaled.value, scaled.low, scaled.high] == pytest.approx([index.value, index.low, index.high], rel=1e-9)
