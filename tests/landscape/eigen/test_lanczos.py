import pytest
import torch

from landscape.eigen.lanczos import lanczos
from landscape.operators.operator import DenseOperator
from tests.landscape.spectra import SPECTRA, N, generator, operator
from tests.refusals import misused


def starts(count, dtype=torch.float64):
    return torch.randn(N, count, generator=generator(), dtype=torch.float64).to(dtype)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", SPECTRA)
def test_the_factorisation_holds_and_its_vectors_are_orthonormal(name, dtype):
    H = operator(name, dtype)
    (f,) = lanczos(H, starts(1, dtype), steps=30)
    m, unit = len(f.T), torch.finfo(dtype).eps
    Q, r = f.Q.double(), f.r.double()
    last = torch.eye(m, dtype=torch.float64)[:, -1:]
    scale = float(H.matrix.double().norm())
    assert (Q.T @ Q - torch.eye(m)).abs().max() < 10 * unit
    assert (H.matrix.double() @ Q - Q @ f.T - r[:, None] @ last.T).abs().max() <= 20 * unit * scale
    assert float((Q.T @ r).abs().max()) <= 20 * unit * scale


def test_it_ends_where_the_invariant_subspace_of_the_start_is_complete():
    H = DenseOperator(torch.diag(torch.tensor([1.0, 1.0, 3.0, 3.0, 3.0], dtype=torch.float64)))
    (f,) = lanczos(H, torch.ones(5, 1, dtype=torch.float64), steps=5)
    assert len(f.T) == 2 and not f.r.any()
    assert torch.allclose(torch.linalg.eigvalsh(f.T), torch.tensor([1.0, 3.0], dtype=torch.float64), rtol=0, atol=1e-14)


def test_all_rows_give_all_eigenvalues():
    H = operator("both tails")
    (f,) = lanczos(H, starts(1), steps=10 * N)
    assert len(f.T) == N
    assert torch.allclose(torch.linalg.eigvalsh(f.T), torch.linalg.eigvalsh(H.matrix), rtol=0, atol=1e-13)


def test_in_lock_step_each_start_gives_what_it_gives_alone():
    H, S = DenseOperator(torch.linspace(-1, 1.5, N, dtype=torch.float64).pow(3).diag()), starts(3)
    S[:, 1] = torch.eye(N)[:, 0]  # an eigenvector, without round-off: complete after a step; the others go on
    together = lanczos(H, S, steps=12)
    assert [len(f.T) for f in together] == [12, 1, 12]
    for i in (0, 2):
        (alone,) = lanczos(H, S[:, i : i + 1], steps=12)
        assert torch.allclose(together[i].T, alone.T, rtol=0, atol=1e-12)


def test_bad_starts_are_refused():
    misused("not zero", lanczos, operator("zero"), torch.zeros(N, 1, dtype=torch.float64), steps=3)
    with pytest.raises(ValueError, match="finite start vectors"):
        lanczos(operator("zero"), torch.full((N, 1), torch.nan, dtype=torch.float64), steps=3)
    misused("at least one Lanczos step", lanczos, operator("zero"), starts(1), steps=0)
