"""What is said of views that have changed, and which Gaussians and questions are the same."""

from dataclasses import replace

import pytest
import torch

from splat.losses.reference import LossSettings
from splat.model.settings import RenderSettings
from splat.training.checkpoint import load_checkpoint, save_checkpoint
from splat.training.origin.fingerprint import FORMULAS, SAME, ViewData, changes, in_short, state_of
from splat.training.origin.subject import Checkpoint
from splat.training.state import Training
from tests.splat.tiny import EXTENT, LENS, LEVEL, REFERENCE, SEEN, SIZE, tiny_config, tiny_gaussians

VIEW = ViewData(LEVEL, (3.0, 4.0, 0.0), LENS, SIZE, photograph="a", mask="b")
QUARTER = ((0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"centre": (3.0, 4.0, 0.25)}, "centre moved by 0.25 world units"),
        ({"rotation": QUARTER}, "turned by 90°"),
        ({"lens": (20.0, 20.6, *LENS[2:])}, "focal length by +3%"),
        ({"lens": (19.0, 20.0, *LENS[2:])}, "focal length by -5%"),
        ({"lens": (20.0, 20.0, LENS[2] + 0.3, LENS[3] - 0.4)}, "principal point by 0.5 px"),
        ({"size": (40, 28), "lens": (40.0, 40.0, 20.0, 14.0)}, "40 x 28 px instead of 20 x 14 px"),
        ({"distortion": "RADIAL 0.1"}, "lens RADIAL 0.1 instead of a pinhole"),
        ({"photograph": "c"}, "another photograph"),
        ({"mask": "c"}, "another mask"),
        ({"mask": None}, "no mask where there was one"),
        ({"photograph": "c", "centre": (0.0, 0.0, 0.0)}, "centre moved by 5 world units, another photograph"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_changed_in_a_view_is_said_with_how_much(change, words):
    assert changes({"a": VIEW, "b": VIEW}, {"a": VIEW, "b": replace(VIEW, **change)}) == [f"'b': {words}"]


def test_round_off_is_no_change_and_depth_maps_matter_where_both_have_one():
    hardly = replace(VIEW, centre=(3.0 + SAME, 4.0, 0.0), lens=(20.0 * (1 + SAME / 2), *LENS[1:]), depth="d")
    assert changes({"a": VIEW}, {"a": hardly}) == []
    assert changes({"a": hardly}, {"a": replace(hardly, depth="e")}) == ["'a': another depth map"]


def test_views_that_only_one_side_has_are_named_and_many_are_counted():
    found = changes({"a": VIEW, "b": VIEW}, {"b": VIEW, "c": VIEW})
    assert found == ["'a': not there any more", "'c': not there before"]
    assert in_short([*"abcde"]) == "a; b; c; and 2 more"


@pytest.fixture
def checkpoint() -> Checkpoint:
    return Checkpoint(Training.start(tiny_gaussians(), EXTENT, tiny_config()), REFERENCE)


def test_the_state_is_that_of_the_gaussians_and_steps_wherever_the_file_lies(checkpoint, tmp_path):
    save_checkpoint(tmp_path / "a.pt", checkpoint.training, replace(REFERENCE, relative="elsewhere"))
    assert load_checkpoint(tmp_path / "a.pt").state == checkpoint.state
    gaussians = checkpoint.training.gaussians
    moved = gaussians.with_flat(gaussians.flat + 0)
    moved.flat[3] = torch.nextafter(moved.flat[3], torch.tensor(torch.inf))
    others = [moved, gaussians.to(torch.float64), gaussians.with_filter(torch.ones(len(gaussians)))]
    states = [state_of(gaussians, 0), state_of(gaussians, 1), *(state_of(each, 0) for each in others)]
    assert len({*states}) == len(states) and states[0] == checkpoint.state


def test_records_are_of_one_function_whatever_their_other_settings(checkpoint):
    one = checkpoint.fingerprint({"rtol": 0.1}, 0)
    other = replace(checkpoint.fingerprint({"rtol": 0.2}, 1), formulas=FORMULAS + 1)
    assert one.apart_from(other) == "" and one.digest != other.digest and not one.answers(other)
    assert one.answers(checkpoint.fingerprint({}, 0)) and not checkpoint.fingerprint({}, 0).answers(one)
    config = checkpoint.training.config
    checkpoint.training.config = replace(config, render=RenderSettings(blur=0.1))
    assert one.apart_from(checkpoint.fingerprint({"rtol": 0.1}, 0)) == "loss"
    checkpoint.training.config = config
    assert one.apart_from(checkpoint.fingerprint({"rtol": 0.1}, 0, LossSettings("l2"))) == "loss"
    moved = SEEN | {"view1": replace(SEEN["view1"], mask="b")}
    seen = replace(checkpoint, scene=replace(REFERENCE, views=moved))
    assert one.apart_from(seen.fingerprint({"rtol": 0.1}, 0)) == "data"
    checkpoint.training.step = 1
    assert one.apart_from(checkpoint.fingerprint({"rtol": 0.1}, 0)) == "checkpoint"
