"""The figures of a stored study: all are there, as PNG and PDF, and their captions say what the numbers say."""

import numpy as np
import pandas as pd
import pytest

from figures import uses
from notebooks.paper.__main__ import main
from notebooks.paper.figures import AXES, captions, draw_axes, draw_budget, draw_index, method_words
from notebooks.paper.predictors import predictors
from notebooks.paper.statements import judgements
from tests.notebooks.test_claims import NAMES, OTHERWISE, PAPER, made_up
from tests.refusals import refused


def test_captions_change_with_the_numbers():
    ours, other = (
        captions(rows, judgements(rows), predictors(rows), NAMES) for rows in (made_up(PAPER), made_up(OTHERWISE))
    )
    assert ours.count("**holds.**") == 10 and other.count("**does not hold.**") == 10
    assert "**index.**" not in ours  # not drawn
    missing = (
        "all probes, one viewpoint",
        *(f"attributes + {way}" for way in ("occlusion", "interpolation", "parallax")),
    )
    assert f"Not run: {', '.join(missing)}" in ours


def test_an_axis_that_was_not_run_says_so_where_its_number_would_be():
    rows = made_up(PAPER)
    axes = draw_axes(rows).axes[0]
    words = [text.get_text() for text in axes.texts]
    assert words == ["not run"] * 4  # one viewpoint, and those of Table 4
    gains = [float(np.ravel(line.get_xdata())[0]) for line in axes.lines if line.get_marker() == "o"]
    assert len(gains) == len(AXES) - 4 and gains[0] == pytest.approx(PAPER["psnr"], abs=0.1)


def test_the_budget_shows_each_seed_and_the_mean_of_each_method():
    rows = made_up(PAPER)
    scores, times = draw_budget(rows).axes
    methods = list(dict.fromkeys(rows["method"]))
    assert {text.get_text() for text in scores.get_yticklabels()} == set(map(method_words, methods))
    means = [float(np.ravel(line.get_xdata())[0]) for line in scores.lines if line.get_marker() == "o"]
    assert len(means) == len(methods) and means == sorted(means)
    for axes in (scores, times):
        dots = [line for line in axes.lines if line.get_marker() == "."]
        assert len(dots) == len(methods) and all(len(np.ravel(line.get_xdata())) == 3 for line in dots)


def test_the_index_over_the_steps_has_the_band_of_all_seeds():
    steps = [0, 100, 200]
    along = pd.DataFrame(
        {"run": f"{method}/{seed}", "step": step, "eigenvalue_ratio": -(2.0 + seed) * (step + 1)}
        for method in ("3dgs", "stablegs")
        for seed in (0, 1)
        for step in steps
    )
    axes = draw_index(along).axes[0]
    assert [list(np.ravel(line.get_ydata())) for line in axes.lines] == [[2.5, 252.5, 502.5]] * 2
    heights = np.asarray(axes.collections[0].get_paths()[0].vertices)[:, 1]
    assert heights.min() == 2.0 and heights.max() == 3.0 * 201


def test_a_folder_without_a_study_is_refused_in_a_sentence(tmp_path, capsys):
    assert main([str(tmp_path)]) == 2
    assert "expected a run that has ended, a folder of such or the table study.csv" in capsys.readouterr().err


@pytest.mark.parametrize("content", ["", 'a,"b\n1', "x,y\n1,2\n"], ids=["empty", "damaged", "another table"])
def test_a_table_that_is_none_of_a_study_is_refused_in_a_sentence(tmp_path, capsys, content):
    (tmp_path / "study.csv").write_text(content)
    assert main([str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert f"expected the table of a study in {tmp_path / 'study.csv'}" in said and said.count("\n") == 1


def test_a_folder_without_results_of_the_uses_is_refused(tmp_path):
    refused("expected what landscape prune --curve, next-view or uncertainty writes", uses.draw, tmp_path)
