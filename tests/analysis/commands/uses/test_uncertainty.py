"""`landscape uncertainty`: its table follows from its maps, and it needs held-out views."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.stats import spearmanr

from analysis.commands.cli import main
from analysis.commands.uses.uncertainty import agreement
from splat.model.files.splat_ply import splat_ply
from splat.render.render import render
from splat.scenes.synthetic import SyntheticSettings, synthetic_scene
from splat.scenes.write import write_transforms_scene


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    made = synthetic_scene(SyntheticSettings(gaussians=50, views=5, width=24, height=16))
    folder = tmp_path_factory.mktemp("uncertain")
    write_transforms_scene(made.scene, folder / "scene")
    made.truth.sh[:] += 0.2
    (folder / "in.ply").write_bytes(splat_ply(made.truth, tool="splat-landscape"))
    image = render(made.truth, made.scene.frames[0].camera).image.clamp(0, 1)
    np.save(folder / "error.npy", (image - made.scene.load()[0].image).abs().mean(dim=0).numpy())
    return folder


def run(folder: Path, *words: str) -> int:
    return main(["uncertainty", str(folder / "in.ply"), "--scene", str(folder / "scene"), "--guess-views", *words])


def test_the_table_follows_from_the_maps(folder, capsys):
    assert run(folder, "--samples", "8", "--views", "3") == 0 and "trained by splat" in capsys.readouterr().out
    out, table = folder / "uncertainty", pd.read_csv(folder / "uncertainty" / "agreement.csv")
    assert len(table) == 2 and {*table.precision} == {"block", "diagonal"}
    maps = np.load(out / "view-000.npz")
    assert np.abs(maps["error"] - np.load(folder / "error.npy")).max() < 0.005  # pictures are rounded to 8 bits
    for row in table.to_dict("records"):
        found = maps[row["precision"]]
        rank = spearmanr(found.ravel(), maps["error"].ravel())[0]
        assert row["rank_correlation"] == pytest.approx(rank, abs=1e-3)
        assert row["ause"] == pytest.approx(agreement(found, maps["error"])["ause"], abs=1e-3)
    assert maps["block"].mean() > maps["diagonal"].mean()  # what the diagonal leaves out makes parameters uncertain
    assert (out / "view-000.png").stat().st_size > 10_000


def test_orders_that_are_wrong_or_know_nothing_have_the_area_of_it():
    error = np.random.default_rng(0).exponential(size=(100, 100))
    random = agreement(np.random.default_rng(1).random((100, 100)), error)
    assert random["ause"] == pytest.approx(random["ause_random"], abs=0.02) and abs(random["rank_correlation"]) < 0.05
    assert agreement(-error, error)["ause"] > 1.5 * random["ause"]


def test_too_few_samples_are_refused(folder, capsys):
    assert run(folder, "--samples", "1") == 2 and "expected --samples" in capsys.readouterr().err
