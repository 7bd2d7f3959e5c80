"""The benchmarks measure what they say, on sizes too small to say anything about speed."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg

from analysis.bench.command import run_bench
from analysis.bench.options import BenchOptions
from analysis.bench.speed import meters
from analysis.bench.speed.meters import HostMeter
from analysis.bench.speed.reference import reference_cost
from analysis.bench.speed.scene import SCALED, ViewBench
from analysis.bench.speed.timing import Timing, interleaved
from analysis.bench.workloads import Size, synthetic_workload
from analysis.commands.cli import main
from figures import bench as figure
from splat.backend.cpu.simd import lanes_of
from splat.curvature.objective import SceneObjective
from splat.render.formulas import SPLAT

ROOT = Path(__file__).parents[3]
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
    rounds = []
    times = interleaved({name: lambda name=name: order.append(name) for name in "ab"}, 2, lambda: rounds.append(1))
    assert "".join(order) == "ab" + "ab" + "ba" and len(rounds) == 2
    assert all(len(time.seconds) == 2 and 0 <= time.minimum <= time.median for time in times.values())


def test_times_add_round_by_round():
    both = Timing((1.0, 4.0, 2.0)) + Timing((5.0, 1.0, 2.0))
    assert both.seconds == (6.0, 5.0, 4.0) and (both.minimum, both.median) == (4.0, 5.0)
    assert (both / 2).seconds == (3.0, 2.5, 2.0)


def test_the_timed_gradients_are_the_gradient_of_the_view(bench):
    expected = bench.linearized.gradient
    assert expected.norm() > 0
    for gradient in (bench.gradient(), bench.gradient_by_autograd()):
        # both sum in the kernels' order; what differs is a rounding or two of the projection's adjoint
        assert (gradient - expected).norm() < 16 * torch.finfo(torch.float32).eps * expected.norm()


def test_the_stages_of_a_scene_run_and_leave_the_view_as_it_was(bench):
    before = bench.gradient()
    for call in {**bench.stages(), **bench.product(4), **bench.wholes()}.values():
        call()
    np.testing.assert_array_equal(bench.gradient(), before)
    np.testing.assert_array_equal(bench.adjoint.moments, bench.raster.backward(bench.cotangent).moments)


def test_pairs_are_the_pixels_of_the_rows_that_are_passed(bench):
    lists, _ = bench.raster.reached
    count = sum((int(r) >> 8 & 255) - (int(r) & 255) + 1 for r in lists.rows)
    assert bench.linearized.intersections == lists.rows.size > 0
    assert bench.raster.pairs == count * lanes_of(np.float32)


def test_memory_is_that_of_the_arrays(bench):
    view = bench.linearized
    shared = 4 * 3 * view._raster.frame.size  # the image, which the loss holds as a view of the raster's planes
    assert view.bytes - shared <= bench.kept() <= 1.1 * view.bytes
    for K in (1, 8):  # the sums of the intersections, the planes of the tangents
        least = 4 * K * (SPLAT * view.intersections + 5 * view._raster.frame.size)
        blocks = 4 * 4 * K * view.gradient.numel()  # the argument, the result and their copies
        objects = 64 * 1024  # Python's own
        assert least <= bench.workspace(K, HostMeter()) <= view.workspace(K) + blocks + objects


def test_the_reference_is_measured_in_a_process_of_its_own():
    cost = reference_cost(synthetic_workload(TINY))
    # the tiles' alphas alone: each of 60 Gaussians touches a tile of 16 x 16 pixels at least
    assert cost.gradient > 0 and cost.product > 0 and cost.peak > 4 * 60 * 16 * 16


def test_thinning_and_resizing_give_workloads_of_that_size():
    workload = synthetic_workload(TINY)
    assert len(workload.thinned(20).gaussians) == 20
    assert workload.resized(0.5).pixels == 20 * 12
    assert workload.resized(0.5).views[0].camera.fx == workload.views[0].camera.fx / 2


def test_ceilings_are_of_all_multiply_adds_and_of_bytes_read_and_written(monkeypatch):
    class Clock(HostMeter):
        def seconds(self, call):
            call()
            return 0.5

    monkeypatch.setitem(meters.ROWS, "cpu", 16)
    assert meters.fma_peak(Clock()) == 16**3 / 0.5
    assert meters.bandwidth(Clock(), 1 << 10) == 2 * (1 << 10) / 0.5


def test_a_bench_records_times_bounds_and_a_figure(recorded):
    assert sorted(p.name for p in recorded.iterdir()) == ["bench.csv", "bench.png", "bounds.csv"]
    table, bounds = pd.read_csv(recorded / "bench.csv"), pd.read_csv(recorded / "bounds.csv")
    assert (table[["minimum_ms", "median_ms"]].to_numpy() > 0).all()
    for study in ("gaussians", "pixels", "views", "threads"):
        lines = table[table["study"] == study]
        points = list(zip(lines["stage"], lines[study]))
        assert {stage for stage, _ in points} == set(SCALED) and len(set(points)) == len(points)
    assert sorted(table.loc[table["study"] == "views", "views"].unique()) == [1, 2, 4]
    stages = table[table["study"] == "stages"]
    assert set(table["device"]) == {"cpu"} and not {"gsplat", "gradient, atomic"} & set(stages["stage"])
    time, ratio = dict(zip(stages["stage"], stages["minimum_ms"])), dict(zip(bounds["what"], bounds["measured"]))
    assert ratio["H v 4 / gradient"] == pytest.approx(time["H v 4"] / time["gradient"])
    limit = bounds["asked"].str.removeprefix("≤ ").astype(float)
    assert (bounds["holds"] == (bounds["measured"] <= limit)).all()


def test_the_figure_fits_its_column_and_shows_the_recorded_times(recorded):
    table = pd.read_csv(recorded / "bench.csv")
    drawn = figure.draw(table)
    drawn.set_dpi(100)
    FigureCanvasAgg(drawn).draw()
    axes = next(axes for axes in drawn.axes if axes.get_xlabel() == "pixels")
    line = next(line for line in axes.lines if line.get_label() == "H v, K = 4, each")
    lines = table[(table["study"] == "pixels") & (table["stage"] == "H v 4")]
    points = sorted(zip(lines["pixels"], lines["minimum_ms"]))
    np.testing.assert_array_equal(np.asarray(line.get_xydata()), points)
    assert (axes.get_xscale(), axes.get_yscale()) == ("log", "log")
    assert [text.get_text() for text in drawn.legends[0].get_texts()][-1] == "in proportion"


def test_the_figure_from_the_command_line_and_its_refusal(recorded, tmp_path):
    def run(path):
        return subprocess.run(
            [sys.executable, "-m", "figures.bench", str(path)], cwd=ROOT, capture_output=True, text=True, check=False
        )

    (recorded / "bench.png").unlink()
    assert run(recorded / "bench.csv").returncode == 0 and (recorded / "bench.png").stat().st_size > 1000
    (tmp_path / "bench.csv").write_text("a,b\n1,2\n")
    refused = run(tmp_path / "bench.csv")
    assert refused.returncode == 2 and refused.stderr.startswith("expected bench.csv")


def test_the_kernels_are_recorded_with_their_ratios(tmp_path, capsys):
    arguments = ["bench", "kernels", "--sizes", str(TINY), "--repetitions", "1", "--out", str(tmp_path / "out")]
    assert main(arguments) == 0
    table, bounds = (pd.read_csv(tmp_path / "out" / name) for name in ("kernels.csv", "kernel_bounds.csv"))
    time = dict(zip(table["stage"], table["minimum_ms"]))
    ratio = dict(zip(bounds["ratio"], bounds["of_minima"]))
    product, gradient = time["H u 4"], time["gradient, compositing"]
    assert product == pytest.approx(time["J u 4"] + time["tangent of backward 4"])
    assert gradient == pytest.approx(time["forward"] + time["backward + reduce"])
    assert ratio["H u 4 / gradient, compositing"] == pytest.approx(product / gradient)
    assert str(TINY) in capsys.readouterr().out


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
        (["--downscale", "2"], "--downscale with a scene's folder"),
        (["kernels", "--images", "images_4"], "--images and --downscale with a scene's folder"),
        (["kernels", "--device", "cuda"], "which measures the CPU's kernels; leave out --device"),
    ],
)
def test_bad_input_gets_one_sentence(tmp_path, capsys, arguments, message):
    assert main(["bench", *arguments, "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err.strip()
    assert said.startswith("landscape: ") and message in said and "\n" not in said
