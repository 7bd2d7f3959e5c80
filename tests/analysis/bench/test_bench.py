"""The benchmarks measure what they say, on sizes too small to say anything about speed."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from analysis.bench.command import run_bench
from analysis.bench.options import BenchOptions
from analysis.bench.timing import Meter, Timing, interleaved
from analysis.bench.workloads import Size, ViewBench, synthetic_workload
from analysis.commands.cli import main
from splat.curvature.objective import SceneObjective
from splat.render.formulas import SPLAT

TINY = Size(60, 40, 24)


@pytest.fixture(scope="module")
def bench() -> ViewBench:
    return ViewBench(synthetic_workload(TINY))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("bench")
    assert run_bench(BenchOptions(out=out, sizes=(str(TINY),), repetitions=1)) == 0
    return out


def test_a_size_is_read_and_written_alike():
    assert Size.parse("10k@504x378") == Size(10_000, 504, 378)
    for text in ("10k@504x378", "60@40x24"):
        assert str(Size.parse(text)) == text


@pytest.mark.parametrize("text", ["10k", "10k@504", "0@5x5", "10@0x5", "-1@5x5", "a@1x1"])
def test_what_is_no_size_is_refused(text):
    with pytest.raises(ValueError, match="GAUSSIANS@WIDTHxHEIGHT"):
        Size.parse(text)


def test_calls_are_timed_in_turns_after_one_that_is_not():
    order = []
    times = interleaved({name: lambda name=name: order.append(name) for name in "ab"}, 2)
    assert "".join(order) == "ab" + "ab" + "ba"
    assert all(len(time.seconds) == 2 and 0 <= time.minimum <= time.median for time in times.values())


def test_times_have_a_minimum_and_a_median_and_equal_parts():
    time = Timing((6.0, 5.0, 4.0))
    assert (time.minimum, time.median) == (4.0, 5.0) and (time / 2).seconds == (3.0, 2.5, 2.0)


def test_the_timed_gradients_are_the_gradient_of_the_view(bench):
    expected = bench.linearized.gradient
    assert expected.norm() > 0
    for gradient in (bench.gradient(), bench.gradient_by_autograd()):
        # both sum in the kernels' order; what differs is a rounding or two of the projection's adjoint
        assert (gradient - expected).norm() < 16 * torch.finfo(torch.float32).eps * expected.norm()


def test_the_calls_of_a_scene_run_and_leave_the_view_as_it_was(bench):
    before = bench.gradient()
    for call in bench.calls().values():
        call()
    np.testing.assert_array_equal(bench.gradient(), before)


def test_memory_is_that_of_the_arrays(bench):
    view = bench.linearized
    for K in (1, 8):  # the sums of the intersections, the planes of the tangents
        least = 4 * K * (SPLAT * view.intersections + 5 * view._raster.frame.size)
        blocks = 4 * 4 * K * view.gradient.numel()  # the argument, the result and their copies
        objects = 64 * 1024  # Python's own
        assert least <= bench.workspace(K, Meter()) <= view.workspace(K) + blocks + objects


def test_a_bench_records_times_and_the_bounds_that_are_asked(recorded):
    assert sorted(p.name for p in recorded.iterdir()) == ["bench.csv", "bounds.csv"]
    table, bounds = pd.read_csv(recorded / "bench.csv"), pd.read_csv(recorded / "bounds.csv")
    assert (table[["minimum_ms", "median_ms"]].to_numpy() > 0).all()
    time, ratio = dict(zip(table["stage"], table["minimum_ms"])), dict(zip(bounds["what"], bounds["measured"]))
    assert {"gradient", "linearize", "H v 1", "H v 8", "block diagonal", "exact blocks"} <= time.keys()
    assert ratio["H v 4 / gradient"] == pytest.approx(time["H v 4"] / time["gradient"])
    limit = bounds["asked"].str.removeprefix("≤ ").astype(float)
    assert (bounds["holds"] == (bounds["measured"] <= limit)).all()


def test_a_checkpoint_and_a_scene_can_be_the_subject(tmp_path):
    from analysis.bench.workloads import workload_of
    from splat.scenes.synthetic import SyntheticSettings, synthetic_scene
    from splat.scenes.write import write_transforms_scene

    made = synthetic_scene(SyntheticSettings(gaussians=60, views=5, width=24, height=18))
    write_transforms_scene(made.scene, tmp_path / "scene")
    run = ["--views", "3", "--iterations", "2", "--out", str(tmp_path / "run")]
    assert main(["train", str(tmp_path / "scene"), *run]) == 0
    trained = workload_of(tmp_path / "run" / "checkpoint.pt")
    assert len(trained.views) == 3 and trained.pixels == 24 * 18
    objective = SceneObjective(trained.gaussians, trained.views, trained.loss, trained.background, trained.settings)
    assert objective.counts.gaussians == len(trained.gaussians)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--repetitions", "0"], "at least 1 repetition"),
        (["--sizes", "many"], "GAUSSIANS@WIDTHxHEIGHT"),
        (["nowhere"], "nowhere"),
        (["stress", "--device", "cuda"], "leave out --device"),
        (["accuracy"], "expected bench accuracy RUN"),
        (["stress", "run/checkpoint.pt"], "expected bench accuracy RUN"),
        (["accuracy", "nowhere/checkpoint.pt"], "expected a checkpoint"),
    ],
)
def test_bad_input_gets_one_sentence(tmp_path, capsys, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "checkpoint.pt").touch()  # a missing one is refused before
    assert main(["bench", *arguments, "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err.strip()
    assert said.startswith("landscape: ") and message in said and "\n" not in said
