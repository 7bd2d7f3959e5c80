"""`landscape next-view`: candidates are judged and picked."""

from pathlib import Path

import pandas as pd
import pytest
import torch

from analysis.commands.cli import main
from analysis.commands.uses.next_view import gains_over, picked
from splat.curvature.scores.information import informations
from splat.model.files.splat_ply import splat_ply
from splat.model.settings import RenderSettings
from splat.scenes.synthetic import SyntheticSettings, synthetic_scene
from splat.scenes.write import write_transforms_scene

MADE = synthetic_scene(SyntheticSettings(gaussians=50, views=9, width=24, height=16))


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("next")
    write_transforms_scene(MADE.scene, folder / "scene")
    (folder / "in.ply").write_bytes(splat_ply(MADE.truth, tool="splat-landscape"))
    return folder


def run(folder: Path, *words: str) -> int:
    return main(["next-view", str(folder / "in.ply"), "--scene", str(folder / "scene"), "--views", "3", *words])


def test_candidates_are_judged_and_picked_one_after_the_other(folder, capsys):
    assert run(folder, "--take", "2") == 0 and "trained by splat-landscape" in capsys.readouterr().err
    table = pd.read_csv(folder / "next-view" / "gains.csv", index_col="view")
    names = [frame.name for frame in MADE.scene.frames]
    assert {*table.index} == {names[i] for i in (2, 3, 5, 6)}
    known = informations(MADE.truth, {f.name: f.camera for f in MADE.scene.frames}, torch.zeros(3), RenderSettings())
    seen = [known[names[i]] for i in (1, 4, 7)]
    for name, gain in table["d"].to_dict().items():
        assert gain == pytest.approx(gains_over(seen, [], known[str(name)])["d"], rel=1e-4)
    chosen = picked(seen, known, list(table.index), 2, "d")
    assert table.pick.dropna().sort_values().index.tolist() == chosen
    assert chosen[0] == table.d.idxmax()
    assert (folder / "next-view" / "gains.png").stat().st_size > 10_000


@pytest.mark.parametrize("words", [("--by", "best"), ("--take", "9"), ("--candidates", "images/view_001.png")])
def test_what_cannot_be_judged_is_refused(folder, words, capsys):
    assert run(folder, *words) == 2
    assert "expected --" in capsys.readouterr().err
