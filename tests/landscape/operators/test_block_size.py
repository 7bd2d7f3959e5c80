import pytest
import torch

from landscape.eigen.eigen import EigenSettings, extreme_eigenpairs
from landscape.operators.block_size import PRODUCTS, fastest_block
from landscape.operators.operator import CountingOperator, DenseOperator
from tests.landscape.spectra import eigenvalues, generator, operator


class Timed(DenseOperator):
    """Takes fixed + each * k seconds for k vectors, on a clock of its own; ten times that at first."""

    def __init__(self, fixed, each):
        super().__init__(operator("indefinite").matrix)
        self.fixed, self.each, self.now, self.calls = fixed, each, 0.0, 0

    def apply(self, V):
        self.calls += 1
        self.now += (self.fixed + self.each * V.shape[1]) * (10 if self.calls == 1 else 1)
        return super().apply(V)


@pytest.mark.parametrize(
    ("fixed", "each", "block"),
    [
        (0.0, 1.0, 1),  # nothing is shared
        (1.0, 1.0, 1),  # (1 + 4) / 4 * 2.4 = 3 > 2
        (8.0, 1.0, 4),  # (8 + 4) / 4 * 2.4 = 7.2 < 9, and (8 + 2) / 2 * 1.6 = 8
        (1.0, 0.0, 4),  # all is shared
        (4.0, 1.0, 1),  # 4.8 of 5: not clearly
    ],
)
def test_the_block_is_the_one_whose_whole_run_is_clearly_the_fastest(fixed, each, block):
    H = Timed(fixed, each)
    assert fastest_block(H, generator(), clock=lambda: H.now) == block


def test_a_block_is_timed_until_a_gpu_has_it(monkeypatch):
    H, pending = Timed(8.0, 1.0), []

    class Launching(DenseOperator):
        def apply(self, V):
            pending.append(V)
            return V

    monkeypatch.setattr(torch.Tensor, "is_cuda", True)
    monkeypatch.setattr(torch.cuda, "synchronize", lambda _device: [H.apply(pending.pop()) for _ in pending[:]])
    assert fastest_block(Launching(H.matrix), generator(), clock=lambda: H.now) == 4  # else every block takes no time


def test_it_costs_eight_products():
    H = CountingOperator(operator("indefinite"))
    assert fastest_block(H, generator()) in PRODUCTS
    assert H.matvecs == 8


@pytest.mark.parametrize("block", [2, 4])
def test_blocks_cost_about_the_products_stated_and_find_the_same_ends(block):
    H, ratios = operator("indefinite"), []
    true = eigenvalues(H)
    for seed in range(5):
        runs = [extreme_eigenpairs(H, generator(seed), EigenSettings(rtol=1e-3, block=b)) for b in (1, block)]
        ratios.append(runs[1].matvecs / runs[0].matvecs)
        assert float(runs[1].largest.values[0]) == pytest.approx(float(true[-1]), rel=1e-3)
    assert 1 < torch.tensor(ratios).median() < 1.5 * PRODUCTS[block]
