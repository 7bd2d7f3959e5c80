"""Views spread over two processes give the numbers of one."""

from pathlib import Path

import pytest
import torch

from analysis.measures.depth import depth_rises, depth_split
from landscape.eigen.eigen import EigenSettings, extreme_eigenpairs
from landscape.operators.distributed import Ranks
from landscape.traces.trace import TraceSettings
from splat.curvature.hessian import SceneHessian
from splat.curvature.objective import SceneObjective
from splat.curvature.traces import exact_traces
from splat.losses.reference import LossSettings
from tests.landscape.ranks import Findings, on_ranks
from tests.splat.tiny import tiny_gaussians, tiny_views

LOSS = LossSettings()


def gaussians():
    apart = tiny_gaussians(16, seed=3, sh_degree=2, dtype=torch.float64)
    apart.means[:8] *= torch.tensor([2.5, 2.0, 1.0], dtype=torch.float64)  # so that views see different ones
    return apart


def measured(objective: SceneObjective, hessians: list[SceneHessian]) -> Findings:
    p = objective.active.flat.numel()
    V = torch.randn(p, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    traces = exact_traces(objective, torch.Generator().manual_seed(1), TraceSettings.fixed(8))
    ends = extreme_eigenpairs(hessians[0], torch.Generator().manual_seed(2), EigenSettings(1, 1, rtol=1e-6))
    blocks = objective.block_diagonal()
    split = depth_split(objective, torch.Generator().manual_seed(3), TraceSettings.fixed(8))
    rises = depth_rises(objective, torch.Generator().manual_seed(4), (0.1, 10.0))
    return {
        "mask": objective.mask.double(),
        "loss": torch.tensor(objective.loss(objective.active.flat)),
        "gradient": objective.gradient,
        "geometry": blocks.geometry,
        "sh": blocks.sh,
        "pairs": split.components,
        "depth": torch.stack([split.depth.samples, split.lateral.samples]),
        "rises": torch.stack([rises.values, rises.errors]),
        "discontinuous": rises.discontinuous,
        "traces": torch.stack([trace.samples for trace in traces.values()]),
        "ends": torch.cat([ends.largest.values, ends.smallest.values]),
        **{f"product {i}": hessian.apply(V) for i, hessian in enumerate(hessians)},
        **{f"rank {i}": torch.tensor(hessian.rank) for i, hessian in enumerate(hessians)},
        "views": torch.tensor(objective.counts.views),
    }


def work(ranks: Ranks) -> Findings:
    views = ranks.share(tiny_views(torch.float64))
    objective = SceneObjective(gaussians(), views, LOSS, ranks=ranks)
    hessians = [SceneHessian(objective, gauss_newton=gn) for gn in (False, True)]
    here, again = (objective.evaluate(objective.active.flat.clone())[1] for _ in range(2))
    away = objective.evaluate(objective.active.flat + 0.3)[1]
    own = int(SceneObjective(gaussians(), views, LOSS).mask.sum())
    found = measured(objective, hessians)
    return {
        **found,
        "own": torch.tensor(own),
        "steady": torch.tensor(here == again),
        "moved": torch.tensor(here != away),
    }


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> list[Findings]:
    folder: Path = tmp_path_factory.mktemp("ranks")
    return on_ranks(2, folder, work)


def test_every_quantity_is_that_of_one_process(found: list[Findings]) -> None:
    objective = SceneObjective(gaussians(), tiny_views(torch.float64), LOSS)
    alone = measured(objective, [SceneHessian(objective, gauss_newton=gn) for gn in (False, True)])
    for rank in found:
        for name, value in alone.items():
            got = rank[name]
            assert isinstance(got, torch.Tensor) and isinstance(value, torch.Tensor)
            # three terms in another order, and what a thousand pixels' sums amplify it by
            assert torch.allclose(got, value, rtol=0, atol=1e-11 * float(value.abs().max())), name


def test_a_rank_holds_gaussians_that_only_others_see(found: list[Findings]) -> None:
    everyone = int(SceneObjective(gaussians(), tiny_views(torch.float64), LOSS).mask.sum())
    assert any(int(rank["own"]) < everyone for rank in found)


def test_the_smooth_piece_is_that_of_the_views_of_all_ranks(found: list[Findings]) -> None:
    assert all(rank["steady"] and rank["moved"] for rank in found)
