"""The bridge on our own renderer: the smallest table is made and continued."""

import pandas as pd
import pytest

from notebooks.renderer import __main__ as command
from notebooks.renderer.measure import STEPS
from notebooks.renderer.scenes import demo

SMALLEST = ["--each", "1", "--seeds", "1", "--samples", "8", "--cover", "2"]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The table of a smaller scene, whose products are of an earlier call."""
    out = tmp_path_factory.mktemp("renderer") / "renderer.csv"
    patch = pytest.MonkeyPatch()
    patch.setattr(command, "demo", lambda: demo(gaussians=50, width=24, height=18, steps=10))
    assert command.main([*SMALLEST, "--out", str(out), "--part", "products"]) == 0
    first = pd.read_csv(out)
    assert command.main([*SMALLEST, "--out", str(out)]) == 0
    patch.undo()
    return first, pd.read_csv(out)


def test_every_way_is_measured_and_what_is_there_is_kept(made):
    first, table = made
    assert list(first["error"]) == list(table[table["part"] == "products"]["error"])
    for _, rows in table.groupby("type"):
        parts = rows["part"].value_counts().to_dict()
        assert parts == {"products": 7 * (2 + len(STEPS)), "ends": 3, "traces": 5, "cover": 5}
    assert table["commit"].notna().all() and table["machine"].notna().all()
    exact = table[(table["type"] == "float64") & table["way"].isin(["split", "gauss_newton"])]
    assert (exact["error"] < 1e-4).all()
