"""What is said of the time left."""

import re

import pytest

from analysis.console.stages import Stages, Work


def seconds_left(stages, *told):
    found = re.fullmatch(r", about (\d+) s left", stages.left(*told))
    return int(found[1]) if found else None


def planned():
    stages = Stages()
    stages.expect({"search": Work(10.0, units=20), "slice": Work(30.0, units=300), "depth": Work(5.0)}, "a guess")
    return stages


def test_a_stage_goes_on_at_its_rate_and_slows_down_those_to_come():
    stages = planned()
    assert seconds_left(stages) == 45
    assert seconds_left(stages, "search", 0.5, 0) == 44  # no rate is known yet
    assert seconds_left(stages, "search", 10.0, 10) == 10 + 2 * 35  # half as fast as planned
    stages.timing["search"] = 30.0  # it took more units than expected, which says nothing of the others
    assert seconds_left(stages) == 2 * 35
    assert seconds_left(stages, "slice", 20.0, 200) == 10 + 5  # as fast as planned again


@pytest.mark.parametrize(("name", "done"), [("search", 80), ("depth", 3)])
def test_a_stage_that_takes_longer_than_expected_is_not_always_at_its_end(name, done):
    stages = planned()
    stages.timing |= dict.fromkeys({"search", "slice", "depth"} - {name}, 1.0)
    assert seconds_left(stages, name, 40.0, done) == 10


def test_nothing_is_said_of_what_nobody_planned():
    stages = planned()
    assert stages.left("per_attribute", 3.0, 1) == ""
    stages.timing |= dict.fromkeys(stages.plan, 1.0)
    assert stages.left() == "" == Stages().left()
