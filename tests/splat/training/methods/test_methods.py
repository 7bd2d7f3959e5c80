"""What holds for every method of training: its name, and that it resumes to the same bits."""

import re
from dataclasses import replace
from math import nan
from pathlib import Path

import pytest
import torch

from splat.scenes.view import View
from splat.training.checkpoint import load_checkpoint, save_checkpoint
from splat.training.loop import train
from splat.training.methods.corgs import CoRGS
from splat.training.methods.depth import FSGS, DNGaussian
from splat.training.methods.dropout import DropGaussian, DropoutGS
from splat.training.methods.methods import METHODS, ThreeDGS
from splat.training.methods.sam import SAM
from splat.training.methods.second_order.solvers import GaussNewtonCG, NewtonBlocks
from splat.training.methods.stablegs.stablegs import StableGS
from splat.training.state import MethodSettings, Training
from tests.splat.tiny import EXTENT, REFERENCE, ended, tiny_config, tiny_gaussians, tiny_views, trained

SHORT: dict[str, MethodSettings] = {
    "3dgs": ThreeDGS(),
    "stablegs": StableGS(warm_up=3, every=2, sampled_every=2, vsp_share=0.5),
    "sam": SAM(),
    "dropgaussian": DropGaussian(),
    "dropoutgs": DropoutGS(),
    "fsgs": FSGS(threshold=0.1, large=0.01),
    "dngaussian": DNGaussian(soft_start=3),
    "cor-gs": CoRGS(prune_every=4, prune_start=3, distance=0.3, pseudo_start=5),
    "newton-blocks": NewtonBlocks(curvature="hessian"),
    "gn-cg": GaussNewtonCG(products=3),
}  # schedules that fit into a dozen steps


def views() -> list[View]:
    """The tiny views with depth maps: a bowl."""
    rows, columns = torch.meshgrid(torch.arange(14.0), torch.arange(20.0), indexing="ij")
    return [replace(view, depth=(rows - 7) ** 2 + (columns - 10) ** 2) for view in tiny_views()]


def checkpoint_of(training: Training, path: Path) -> bytes:
    save_checkpoint(path, training, REFERENCE)
    return path.read_bytes()


def test_every_method_is_known_by_its_name():
    assert list(SHORT) == list(METHODS)
    for name, settings in METHODS.items():
        assert settings().name == name


@pytest.fixture(scope="module")
def plain() -> Training:
    return trained(tiny_config(), views=views())


@pytest.mark.parametrize("name", METHODS)
def test_any_method_changes_3dgs_and_continues_from_a_checkpoint_to_the_same_bits(tmp_path, name, plain):
    path, config = tmp_path / "checkpoint.pt", replace(tiny_config(), method=SHORT[name])
    whole = Training.start(tiny_gaussians(), EXTENT, config)
    kept = {}
    for done in train(whole, views()):
        kept[done.step] = checkpoint_of(whole, path)
    assert torch.equal(whole.gaussians.flat, plain.gaussians.flat) == (name == "3dgs")
    for stop in (1, 6, 9):
        path.write_bytes(kept[stop])
        resumed = load_checkpoint(path).training
        assert resumed.config == config
        assert checkpoint_of(ended(resumed, views()), path) == kept[12]


@pytest.fixture(scope="module")
def saved(tmp_path_factory) -> dict[str, bytes]:
    """Checkpoints under way, each with rows in its history."""
    path, found = tmp_path_factory.mktemp("saved") / "checkpoint.pt", {}
    for name in ("stablegs", "cor-gs", "newton-blocks"):
        training = Training.start(tiny_gaussians(), EXTENT, replace(tiny_config(), method=SHORT[name]))
        while training.step < 6:
            next(train(training, views()))
        found[name] = checkpoint_of(training, path)
    return found


NO_WHOLE_NUMBERS = ["many", -1, 2.5, None, 10**400, torch.zeros(3)]


@pytest.mark.parametrize(
    ("name", "place", "values", "words"),
    [
        ("stablegs", ("history", 0, "step"), NO_WHOLE_NUMBERS, "'history"),
        ("stablegs", ("history", 0, "count"), NO_WHOLE_NUMBERS, "'history"),
        ("cor-gs", ("history", 0, "pruned"), [-1, 10**400, None], "'history.* expected"),
        ("cor-gs", ("history", 0), [{}, [], "row"], "expected a step|expected object"),
        ("cor-gs", ("history",), [{}, 3, "rows"], "'history': expected array"),
        ("cor-gs", ("partner", "step"), NO_WHOLE_NUMBERS, "step"),
        ("cor-gs", ("partner", "adam", "updates"), NO_WHOLE_NUMBERS, "updates"),
        ("cor-gs", ("partner", "config", "iterations"), NO_WHOLE_NUMBERS, "iteration"),
        ("stablegs", ("magnitudes", "means"), [{}, 3, {"rho": 1.0}], "magnitude|argument"),
        ("stablegs", ("magnitudes", "means", "rho"), ["much", -1, None, 10**400, nan], "magnitude|finite tau and"),
        ("newton-blocks", ("damping",), ["much", -1.0, 0.0, None, nan], "'damping'"),
        ("newton-blocks", ("last",), [3, [2.0], torch.zeros(2, 2), torch.full((3,), nan)], "'last'"),
        ("stablegs", ("normals",), [{}, 3, [2], [torch.zeros(3)]], "'normals.* expected"),
        ("stablegs", ("coupling", "sh"), [3, (1.0,), (nan, 1.0), (1.0, -1.0), ("much", 1.0)], "'coupling"),
        ("stablegs", ("pair",), [3, ([1, 2], 5), ([1, 2, -3], 5), ([1, 2, 3], -5), ([1, 2, 2.5], 5)], "'pair"),
    ],
)
def test_what_no_method_can_have_saved_is_refused_in_a_sentence(tmp_path, saved, name, place, values, words):
    path = tmp_path / "checkpoint.pt"
    for value in values:
        path.write_bytes(saved[name])
        content = torch.load(path, weights_only=True)
        at = content["regularizer"]
        for key in place[:-1]:
            at = at[key]
        at[place[-1]] = value
        torch.save(content, path)
        with pytest.raises(ValueError, match=words) as caught:
            load_checkpoint(path)
        said = "expected a checkpoint[^\n]*'regularizer' is not the state[^\n]*take another copy of the file, or train anew"
        assert re.match(said, str(caught.value))


def test_normals_of_other_views_are_refused_before_the_first_step(tmp_path, saved):
    path = tmp_path / "checkpoint.pt"
    path.write_bytes(saved["stablegs"])
    training = load_checkpoint(path).training
    training.method.restore(training.method.state() | {"normals": [torch.zeros(2)]})
    with pytest.raises(ValueError, match="normal for each of 3 training views, found 1"):
        next(train(training, views()))


NOTHING = [StableGS(warm_up=3, asp_weight=0.0, vsp_weight=0.0), CoRGS(prune_every=0, weight=0.0)]


def test_stablegs_without_its_probes_can_drop_gaussians_as_dropgaussian_does():
    dropped, other = (
        trained(replace(tiny_config(), method=method), views=views())
        for method in (StableGS(warm_up=3, asp_weight=0.0, vsp_weight=0.0, drop_share=0.4), DropGaussian(p_max=0.4))
    )
    assert torch.equal(dropped.gaussians.flat, other.gaussians.flat)


@pytest.mark.parametrize("off", [*NOTHING, FSGS(unpool_until=0, depth_weight=0.0)])
def test_a_method_of_which_all_is_switched_off_is_3dgs_bit_for_bit(off, plain):
    other = trained(replace(tiny_config(), method=off), views=views())
    assert plain.step == other.step == 12
    assert torch.equal(plain.gaussians.flat, other.gaussians.flat)
    assert torch.equal(plain.adam.second.flat, other.adam.second.flat)
