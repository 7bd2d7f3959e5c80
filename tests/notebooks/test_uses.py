"""The study of rules that pick next views goes on where it was stopped."""

from pathlib import Path

import pandas as pd
import pytest

from notebooks.uses import study
from notebooks.uses.__main__ import main
from splat.scenes.synthetic import SyntheticSettings, synthetic_scene
from splat.scenes.write import write_transforms_scene
from tests.refusals import refused

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
    (folder / "study.toml").write_text(STUDY)
    return folder


def test_a_study_goes_on_where_it_was_stopped(folder, monkeypatch):
    whole, begun = study.cell, []

    def cell(*arguments):
        begun.append(arguments)
        if len(begun) == 2:
            raise KeyboardInterrupt
        return whole(*arguments)

    monkeypatch.setattr(study, "cell", cell)
    with pytest.raises(KeyboardInterrupt):
        main([str(folder / "study.toml")])
    assert main([str(folder / "study.toml")]) == 0
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
def test_a_study_that_cannot_be_is_refused(folder, line, words):
    name = line.split(" = ")[0]
    kept = [each for each in STUDY.splitlines() if not each.startswith(name)]
    (folder / "wrong.toml").write_text("\n".join([line, *kept]))
    refused(words, main, [str(folder / "wrong.toml")])


@pytest.mark.parametrize(
    "change",
    [
        'seeds = [0, 0]', 'rules = ["d", "d"]', "rules = []", "seeds = []", '[scenes."../esc"]\npath = "x"',
        '[scenes."/abs"]\npath = "x"', '[scenes."a\\u0000"]\npath = "x"', "rounds = " + "9" * 6000, "a = " + "[" * 5000,
    ],
)  # fmt: skip
def test_a_study_that_repeats_itself_or_leads_out_is_refused_before_it_begins(tmp_path, change):
    file = tmp_path / "study.toml"
    file.write_text(f'out = "out"\n{change}\n[scenes.fern]\npath = "fern"\n')
    refused(r"study\.toml", study.run_study, file)
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.parametrize("content", ["", "{}", "[1]", '{"told": "this", "rows": []}', '{"told": "this", "rows": [{}]}'])
def test_a_damaged_cell_is_refused_with_the_remedy(tmp_path, content):
    (tmp_path / "cell.json").write_text(content)
    refused("remove it, and it is measured again", study._kept, tmp_path / "cell.json", "this")
