"""The table of the published trainings: its defaults are those of the code, and its presets are settings that there are."""

from dataclasses import asdict, fields

import pytest

from analysis.console.overrides import overridden
from analysis.train.command import OPTIONS
from analysis.train.options import TrainOptions
from splat.model.typed import leaves
from splat.training.methods.methods import METHODS, presets, table
from splat.training.state import TrainConfig
from tests.refusals import refused

RELEASED = ("dropgaussian", "dropoutgs", "cor-gs", "fsgs", "dngaussian")  # with code
SETTINGS = [row for row in table() if row["setting"] not in ("", "start")]


def settings(method: str, changes: dict[str, str]) -> dict[str, object]:
    """All settings of a training by the names that --set knows."""
    config = overridden(TrainConfig(method=METHODS[method]()), changes)
    return {name.removeprefix("method."): value for name, value in leaves(asdict(config)).items()}


@pytest.mark.parametrize("row", SETTINGS, ids=lambda row: f"{row['method']}-{row['setting']}")
def test_the_table_has_the_defaults_of_the_code(row):
    name, now = row["setting"], settings(row["method"], {})
    assert settings(row["method"], {name: row["default"]})[name] == now[name]
    if row["llff"]:
        assert settings(row["method"], {"densify.reset_opacity": "none", name: row["llff"]})[name] != now[name]


def test_a_setting_whose_default_is_not_the_published_one_is_preset_or_explained():
    for row in SETTINGS:
        assert row["published"] in (row["llff"] or row["default"],) or row["note"], row


def test_every_setting_of_a_method_with_released_code_is_in_the_table_once():
    for name in RELEASED:
        listed = [row["setting"] for row in SETTINGS if row["method"] == name]
        assert len(listed) == len(set(listed))
        assert {field.name for field in fields(METHODS[name])} - {"name"} <= set(listed)
        assert presets(name, "llff")


def test_rows_say_where_their_values_come_from():
    for row in table():
        assert row["method"] in METHODS and row["published"]
        file, _, line = row["source"].rpartition(":")
        assert row["source"].startswith("paper Sec. ") or (len(file.split()) == 2 and int(line) > 0), row
        assert row["setting"] or row["note"].startswith("not here")


def test_no_preset_goes_before_an_option():
    """One whose option was left out cannot be told from one whose option was given its default."""
    for row in SETTINGS:
        assert not row["llff"] or getattr(TrainOptions, OPTIONS.get(row["setting"], ""), None) is None, row


@pytest.mark.parametrize("name", ["3dgs", "sam", "gn-cg"])
def test_methods_without_a_published_training_are_refused(name):
    assert presets(name, "common") == {}
    refused("expected a method with a published training for llff", presets, name, "llff")
