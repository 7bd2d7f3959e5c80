"""Per attribute: what is exactly flat is left out and counted, and the indices are those of the dense blocks."""

from collections import Counter

import pytest
import torch

from analysis.measures.units import optimiser_units
from landscape import RestrictedOperator, ScaledOperator, block_anisotropy
from landscape.probes import spawn
from landscape.spectrum.block_anisotropy import WHOLE
from splat.curvature.hessian import SceneHessian
from splat.curvature.null.active_spaces import active_spaces
from splat.curvature.objective import SceneObjective
from splat.losses.reference import LossSettings
from splat.training.state import LearningRates
from tests.splat.tiny import tiny_gaussians, tiny_views


@pytest.fixture(scope="module")
def objective() -> SceneObjective:
    return SceneObjective(
        tiny_gaussians(6, sh_degree=2, dtype=torch.float64), tiny_views(torch.float64), LossSettings("l2")
    )


@pytest.mark.parametrize("metric", ["parameters", "optimiser"])
@pytest.mark.parametrize("gauss_newton", [False, True])
def test_projectors_have_their_ranks_and_leave_nothing_out_that_is_curved(objective, gauss_newton, metric):
    hessian = SceneHessian(objective, gauss_newton=gauss_newton)
    scale = None if metric == "parameters" else optimiser_units(objective, LearningRates(), extent=3.0)
    operator = hessian if scale is None else ScaledOperator(hessian, scale)
    H = operator.apply(torch.eye(hessian.dim, dtype=torch.float64))
    spaces = active_spaces(objective, hessian.projector, scale)
    assert list(spaces) == ["all", *hessian.blocks]
    for name, space in spaces.items():
        rows = hessian.blocks.get(name, slice(0, hessian.dim))
        P = space.project(torch.eye(rows.stop - rows.start, dtype=torch.float64))
        block = H[rows, rows]
        assert float(P.diagonal().sum()) == pytest.approx(space.rank, abs=1e-6)
        assert float((P - P.T).norm()) <= 1e-10 and float((P @ P - P).norm()) <= 1e-10
        assert float((P @ block - block).norm()) <= 1e-10 * float(block.norm())
    n = len(objective.active)
    assert [spaces[name].rank for name in ("means", "log_scales", "quats", "opacity_logits")] == [3 * n] * 3 + [n]
    colours = torch.linalg.eigvalsh(H[hessian.blocks["sh"], hessian.blocks["sh"]]).abs()
    assert spaces["sh"].rank == int((colours > 1e-15 * colours.max()).sum())


@pytest.mark.parametrize("gauss_newton", [False, True])
def test_the_indices_of_every_attribute_are_those_of_its_dense_block(objective: SceneObjective, gauss_newton: bool):
    hessian = SceneHessian(objective, gauss_newton=gauss_newton)
    H = hessian.apply(torch.eye(hessian.dim, dtype=torch.float64))
    runs, misses, spaces = 4, Counter(), active_spaces(objective, hessian.projector)
    for seed in range(runs):
        stream = torch.Generator().manual_seed(seed)
        for name, space in spaces.items():
            of = hessian if name == WHOLE else RestrictedOperator(hessian, name)
            part = block_anisotropy(of, spawn(stream), active=space)
            rows = hessian.blocks.get(name, slice(0, hessian.dim))
            true = torch.linalg.eigvalsh((H[rows, rows] + H[rows, rows].T) / 2)
            total = float(true.abs().sum())
            share, rank = part.indices.top_mass, part.indices.participation_ratio
            assert share is not None and rank is not None and rank.high <= part.rank
            largest, spread = float(true[-1]) / total, total**2 / float(true.square().sum())
            misses[name, "top_mass"] += not share.low <= largest * (1 + 1e-9) <= share.high * (1 + 2e-9)
            misses[name, "rank"] += not rank.low <= spread * (1 + 1e-9) <= rank.high * (1 + 2e-9)
    # 95% brackets: three misses of four have a probability of 5e-4
    assert max(misses.values()) < 3, misses
