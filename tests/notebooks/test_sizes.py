"""Time and memory by size: commands are measured, one that takes too long is kept as such; the page has the stored table."""

import pandas as pd

from notebooks.sizes import __main__ as command
from tests.notebooks.test_renderer import ROOT


def test_commands_are_measured_and_one_that_takes_too_long_is_stored_as_such(tmp_path, monkeypatch):
    monkeypatch.setattr(command, "WIDTH", 48)
    monkeypatch.setattr(command, "HEIGHT", 36)
    places = ["--work", str(tmp_path / "work"), "--out", str(tmp_path / "sizes.csv")]
    assert command.main(["--only", "100x2/step", *places]) == 0
    assert command.main(["--only", "100x2/quick", "--seconds", "1", *places]) == 0
    table = pd.read_csv(tmp_path / "sizes.csv", keep_default_na=False)
    assert table[["what", "ended"]].values.tolist() == [["quick", "more than 1 s"], ["step", ""]]
    quick, step = table.to_dict("records")
    assert quick["seconds"] >= 1 > step["seconds"] and step["memory"] > 0.2 and {*table["gaussians"]} == {100}


def test_the_page_has_the_stored_table():
    assert command.page(pd.read_csv(command.RESULTS)) in (ROOT / "docs" / "accuracy.md").read_text()
