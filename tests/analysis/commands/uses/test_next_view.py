"""`landscape next-view`: candidates are judged and picked, and a study of rules goes on where it was stopped."""

from pathlib import Path

import pandas as pd
import pytest
import torch

from analysis.commands.cli import main
from analysis.commands.uses import study
from analysis.commands.uses.next_view import gains_over, informations, picked
from splat.model.files.splat_ply import splat_ply
from splat.model.settings import RenderSettings
from splat.scenes.synthetic import SyntheticSettings, synthetic_scene
from splat.scenes.write import write_transforms_scene

MADE = synthetic_scene(SyntheticSettings(gaussians=50, views=9, width=24, height=16))
STUDY = """out = "out"
rules = ["d", "random", "uniform"]
seeds = [0]
start = 2
rounds = 2
first_steps = 3
steps = 2
[scenes.still]
path = "scene"
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("next")
    write_transforms_scene(MADE.scene, folder / "scene")
    (folder / "in.ply").write_bytes(splat_ply(MADE.truth, tool="splat-landscape"))
    (folder / "study.toml").write_text(STUDY)
    return folder


def run(folder: Path, *words: str) -> int:
    return main(["next-view", str(folder / "in.ply"), "--scene", str(folder / "scene"), "--views", "3", *words])


def test_candidates_are_judged_and_picked_one_after_the_other(folder):
    assert run(folder, "--take", "2") == 0
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


def test_a_study_goes_on_where_it_was_stopped(folder, monkeypatch):
    whole, begun = study.cell, []

    def cell(*arguments):
        begun.append(arguments)
        if len(begun) == 2:
            raise KeyboardInterrupt
        return whole(*arguments)

    monkeypatch.setattr(study, "cell", cell)
    assert main(["next-view", str(folder / "study.toml")]) == 130
    assert main(["next-view", str(folder / "study.toml")]) == 0
    assert len(begun) == 4  # three, and the one that was under way
    table = pd.read_csv(folder / "out" / "study.csv")
    assert table.groupby("rule").views.apply(list).to_dict() == {rule: [2, 3, 4] for rule in ("d", "random", "uniform")}
    assert table[table["round"] == 0].psnr.nunique() == 1  # all rules begin alike
    for _, rows in table.groupby("rule"):
        assert rows.added.dropna().nunique() == 2
    centres = {frame.name: frame.camera.centre for frame in MADE.scene.frames}
    names = list(centres)
    apart = {n: min(float((centres[n] - centres[names[i]]).norm()) for i in (1, 7)) for n in names[2:7]}
    first = table[(table.rule == "uniform") & (table["round"] == 1)].added.item()
    assert first == max(apart, key=lambda name: apart[name])
    assert (folder / "out" / "study.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ('rules = ["best"]', "got 'best'"),
        ("start = 1", "expected start"),
        ("strat = 2", "strat"),
        ("seeds = 3", "seeds"),
    ],
)
def test_a_study_that_cannot_be_is_refused(folder, line, words, capsys):
    name = line.split(" = ")[0]
    kept = [each for each in STUDY.splitlines() if not each.startswith(name)]
    (folder / "wrong.toml").write_text("\n".join([line, *kept]))
    assert main(["next-view", str(folder / "wrong.toml")]) == 2
    assert words in capsys.readouterr().err


@pytest.mark.parametrize("words", [("--by", "best"), ("--take", "9"), ("--candidates", "images/view_001.png")])
def test_what_cannot_be_judged_is_refused(folder, words, capsys):
    assert run(folder, *words) == 2
    assert "expected --" in capsys.readouterr().err
