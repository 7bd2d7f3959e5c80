"""`landscape bench accuracy RUN`: every estimator on one's own scene, against a long run."""

import numpy as np
import pandas as pd

from analysis.bench.accuracy import cases, command
from analysis.commands.cli import main
from splat.scenes.synthetic import SyntheticSettings, synthetic_scene
from splat.scenes.write import write_transforms_scene


def test_estimators_are_compared_with_a_long_run_on_ones_own_scene(tmp_path, monkeypatch, capsys):
    made = synthetic_scene(SyntheticSettings(gaussians=50, views=4, width=16, height=12, sh_degree=0))
    write_transforms_scene(made.scene, tmp_path / "scene")
    words = ["--views", "2", "--iterations", "2", "--sh-degree", "0", "--out", str(tmp_path / "run")]
    assert main(["train", str(tmp_path / "scene"), *words]) == 0
    kept = [each for each in command.scene_methods((12,)) if each.name not in ("StableGS", "XTrace")]
    monkeypatch.setattr(command, "scene_methods", lambda: kept)
    bench = ["bench", "accuracy", str(tmp_path / "run"), "--repetitions", "2", "--out", str(tmp_path / "out")]
    assert main(bench) == 0
    table = pd.read_csv(tmp_path / "out" / "accuracy.csv")
    assert set(table["quantity"]) == {"traces", "ends", "sum of |lambda|", "participation ratio"}
    default = table[(table["quantity"] == "traces") & (table["origin"] == "default")].iloc[0]
    assert default["true_error"] < 0.05 and default["matvecs"] > 0
    fixed = table[table["method"] == "Hutchinson, Rademacher"].iloc[0]
    assert fixed["matvecs"] == 12 * 5 and fixed["true_error"] > default["true_error"]
    assert np.isfinite(table["true_error"]).all()
    shown = capsys.readouterr().out
    assert "led by own blocks" in shown and (tmp_path / "out" / "accuracy_traces.png").stat().st_size > 10_000

    monkeypatch.setattr(cases, "_truth", lambda *_: 1 / 0)  # it is kept
    monkeypatch.setattr(command, "scene_methods", lambda: kept[:1])
    assert main(bench) == 0
