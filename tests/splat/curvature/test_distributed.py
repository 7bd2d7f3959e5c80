"""Views of the Hessian's products, spread over two processes, give the products of one."""

import torch

from landscape.operators.distributed import DistributedOperator, Ranks
from splat.curvature.hessian import SceneHessian
from splat.curvature.objective import SceneObjective
from tests.landscape.ranks import Findings, on_ranks
from tests.splat.tiny import tiny_gaussians, tiny_views


def products(ranks: Ranks) -> Findings:
    """Of the Hessian and of Gauss-Newton, with how many views of its own a process used."""
    objective = SceneObjective(tiny_gaussians(16, seed=3, sh_degree=2, dtype=torch.float64), tiny_views(torch.float64))
    own = ranks.share(range(len(objective.views)))
    parts = [SceneHessian(objective, gauss_newton=gauss_newton, indices=own) for gauss_newton in (False, True)]
    V = torch.randn(parts[0].dim, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return {"own": len(own), "products": torch.stack([DistributedOperator(each, ranks).apply(V) for each in parts])}


def test_products_are_those_of_one_process(tmp_path) -> None:
    alone, (first, second) = products(Ranks(0, 1)), on_ranks(2, tmp_path, products)
    assert first["own"] + second["own"] == alone["own"] and torch.equal(first["products"], second["products"])
    # the terms of the views in another order, and what a thousand pixels' sums amplify it by
    scale = float(alone["products"].abs().max())
    assert torch.allclose(first["products"], alone["products"], rtol=0, atol=1e-11 * scale)
