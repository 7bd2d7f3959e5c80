"""Every field of each Gaussian against the dense Hessian in float64, and on scenes that are made to show one of them."""

import numpy as np
import pytest
import torch
from scipy.linalg import null_space

from splat.curvature.fields import FIELDS, scene_fields
from splat.curvature.hessian import SceneHessian
from splat.curvature.objective import SceneObjective
from splat.curvature.traces import exact_traces
from splat.losses.reference import LossSettings
from splat.model.camera import Camera, look_at
from splat.model.gaussians import Gaussians
from splat.render.render import render
from splat.scenes.view import View
from tests.splat.held_scenes import BACKGROUND, two_views
from tests.splat.random_scenes import random_gaussians

BLOCKS = {"means": 3, "log_scales": 3, "quats": 4, "opacity_logits": 1, "sh": 12}
LOSSES = [LossSettings("l2", ssim_weight=0), LossSettings("charbonnier", ssim_weight=0.4)]


@pytest.fixture(scope="module", params=LOSSES, ids=["a sum over pixels", "with SSIM"])
def toy(request) -> SceneObjective:
    gaussians = random_gaussians(14, sh_degree=1, seed=4, logit=1.0, spread=0.5)
    gaussians.means[3] = torch.tensor([2.5, 0.4, 4.0])  # one view sees it
    return SceneObjective(gaussians, two_views(), request.param, BACKGROUND)


def dense(objective: SceneObjective, gauss_newton: bool) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """The operator as a matrix, and the rows of each attribute, (n, d)."""
    operator = SceneHessian(objective, gauss_newton=gauss_newton, keep_null=True)
    matrix = operator.apply(torch.eye(operator.dim, dtype=torch.float64)).numpy()
    n = len(objective.active)
    return matrix, {name: np.arange(rows.stop)[rows].reshape(n, -1) for name, rows in objective.blocks.items()}


def expected_fields(objective: SceneObjective) -> dict[str, np.ndarray]:
    found: dict[str, list[float]] = {}
    quats, views, own = objective.active.quats.numpy(), objective.views, {}
    for prefix, gauss_newton in (("", False), ("gn_", True)):
        H, rows = dense(objective, gauss_newton)
        for i in range(len(quats)):
            E = np.zeros((11, 10))
            E[:6, :6], E[6:10, 6:9], E[10, 9] = np.eye(6), null_space(quats[i : i + 1]), 1
            index = np.concatenate([rows[name][i] for name in BLOCKS if name != "sh"])
            B = own[prefix, i] = E.T @ H[np.ix_(index, index)] @ E
            position, values = H[np.ix_(rows["means"][i], rows["means"][i])], np.linalg.eigvalsh(B)
            kept = values[np.abs(values) > 10 * np.finfo(np.float64).eps * np.abs(values).max()]
            rays = [objective.active.means[i].numpy() - view.camera.centre.numpy() for view in views]
            v = sum(r / np.linalg.norm(r) for r, m in zip(rays, _seen(objective, i)) if m)
            v = v / np.linalg.norm(v)
            numbers = {
                "trace_means": np.trace(B[:3, :3]), "trace_log_scales": np.trace(B[3:6, 3:6]),
                "trace_quats": np.trace(B[6:9, 6:9]), "trace_opacity_logits": B[9, 9],
                "trace_sh": H.diagonal()[rows["sh"][i]].sum(), "largest": values.max(),
                "log_det": np.log(np.abs(kept)).sum(), "rank": len(kept), "negative": (kept < 0).sum(),
                "depth": v @ position @ v, "lateral": (np.trace(position) - v @ position @ v) / 2,
            }  # fmt: skip
            for name, number in numbers.items():
                found.setdefault(prefix + name, []).append(float(number))
    found["split"] = [float(np.linalg.eigvalsh(own["", i] - own["gn_", i]).min()) for i in range(len(quats))]
    return {name: np.array(numbers) for name, numbers in found.items()}


def _seen(objective: SceneObjective, gaussian: int) -> list[bool]:
    """Whether the render of each view depends on a Gaussian."""
    gains = torch.ones(len(objective.active), dtype=torch.float64)
    gains[gaussian] = 0
    pairs = [
        [render(objective.active, view.camera, BACKGROUND, opacity_scale=gain).image for gain in (None, gains)]
        for view in objective.views
    ]
    return [bool((a != b).any()) for a, b in pairs]


def test_fields_are_those_of_the_dense_hessian(toy):
    fields, _ = scene_fields(toy)
    expected = expected_fields(toy)
    assert fields["views"].min() == 1
    assert {*expected} < {*FIELDS} and [*fields] == [*FIELDS]
    for name, numbers in expected.items():
        # ln |lambda| has the relative error of the least eigenvalue that counts
        size = 1e5 if name.endswith("log_det") else np.abs(numbers).max()
        assert np.abs(fields[name].numpy() - numbers).max() <= 1e-10 * max(size, 1e-300), name


def test_traces_sum_to_those_of_a_probe(toy):
    fields, _ = scene_fields(toy)
    for prefix, gauss_newton in (("", False), ("gn_", True)):
        traces = exact_traces(toy, torch.Generator().manual_seed(0), gauss_newton=gauss_newton)
        for name, trace in traces.items():
            total, slack = float(fields[f"{prefix}trace_{name}"].sum()), 1e-10 * abs(trace.value)
            assert trace.low - slack <= total <= trace.high + slack, name


def scene_of(rows: list[dict], centres: list[list[float]]) -> SceneObjective:
    """Gaussians of equal kind but for what rows say, seen from cameras at centres that look at (0, 0, 4)."""
    usual = {"means": [0.0, 0.0, 4.0], "log_scales": [-2.5] * 3, "quats": [1.0, 0.0, 0.0, 0.0], "opacity_logits": 1.0}
    usual["sh"] = [[0.5, 0.2, -0.1]]
    columns = {name: torch.tensor([(usual | row)[name] for row in rows], dtype=torch.float64) for name in usual}
    gaussians, down = Gaussians.pack(columns), torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    views = []
    for centre in torch.tensor(centres, dtype=torch.float64):
        rotation = look_at(centre, torch.tensor([0.0, 0.0, 4.0], dtype=torch.float64), down)
        camera = Camera(rotation, centre, 60.0, 60.0, 20.0, 16.0, 40, 32)
        views.append(View(str(len(views)), camera, render(gaussians, camera).image.float() + 0.05))
    return SceneObjective(gaussians, views, LossSettings("l2", ssim_weight=0))


def test_a_needle_is_the_one_of_largest_condition():
    needle = {"means": [0.6, 0.3, 4.0], "log_scales": [-1.5, -5.5, -5.5]}
    centres = [[0.0, 0.0, 0.0], [-4.0, 0.0, 4.0]]  # beside it, and behind its end
    found, _ = scene_fields(scene_of([{}, needle, {"means": [-0.6, 0.0, 4.0]}], centres))
    focal, (long, thin) = 60.0 / 4, np.exp([-1.5, -5.5])
    slant = (0.6 / 4) * thin  # what the depth of its thin axis adds along the image
    kappa = ((focal * long) ** 2 + (focal * slant) ** 2 + 0.3) / ((focal * thin) ** 2 + 0.3)
    assert found["condition"].argmax() == 1 and found["condition"][1].item() == pytest.approx(kappa, rel=1e-3)
    assert found["condition"][[0, 2]].max() < 1.2


def test_a_blocker_that_one_view_sees_has_all_its_weight_there():
    # before the second camera alone
    near = {"means": [1.15, 0.0, 1.2], "log_scales": [-2.0] * 3, "opacity_logits": 5.0}
    found, sights = scene_fields(scene_of([{}, near, {"means": [-0.5, 0.2, 4.0]}], [[-1.5, 0.0, 0.0], [1.5, 0.0, 0.0]]))
    assert found["views"].tolist() == [2, 1, 2] and found["one_view"][1].item() == 1
    assert not sights[0].seen[1] and sights[1].seen[1]
    assert found["one_view"][2].item() < 0.6


def test_layers_change_places_at_their_distance():
    layers = [{"means": [0.0, 0.0, z], "log_scales": [-2.0, -2.0, -4.0]} for z in (4.0, 4.2)]
    aside = {"means": [1.1, 0.8, 4.1]}  # between them in depth, and nowhere in the image
    found, _ = scene_fields(scene_of([*layers, aside], [[0.0, 0.0, 0.0], [0.0, 0.0, -1.0]]))
    assert found["order_gap"][1].item() == pytest.approx(min(60 * 0.2 / 4.2, 60 * 0.2 / 5.2))
    assert found["order_gap"][0].isinf() and found["order_gap"][2].isinf()
