"""What a machine with a GPU is to be asked, in a few minutes: does it agree with the CPU, and how fast is it?

    python -m analysis.bench.gpu_check                            every part, on synthetic scenes
    python -m analysis.bench.gpu_check RUN/checkpoint.pt          training from that checkpoint, and agreement there, too
    python -m analysis.bench.gpu_check --only ratios probe        some parts

    agreement    relative differences of the GPU's loss, gradient, H v and traces from the CPU's, in single precision
    recordings   products as CUDA graphs against the same launched kernel by kernel: to the last bit, and how much faster
    ratios       those that `landscape bench --device cuda` is held to, which also says what they are made of
    probe        seconds of `landscape probe` on 500,000 Gaussians in 24 views
    training     minutes of 10,000 steps of StableGS with all viewpoints in 3 views, at the pace of two hundred
    checkpoint   agreement at the checkpoint, in double precision and in single

In single precision round-off decides in a trained scene whether some Gaussian is drawn at some pixel, and which way L1 slopes:
of fern's gradient after 2,000 steps, opacities changed by their last bits change 2e-6 to 2e-5 on one CPU, of H v up to 8e-6.
So there the two may differ by twice what such changes are seen to make.

Every part is a process with a limit of its own, lest one that fails, or hangs, takes the others along: a kernel that reads
beyond its memory leaves no GPU to the process that launched it.  A part's table is printed and written when it ends.
"""

import json
import subprocess
import sys
import tempfile
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from math import inf, isinf
from pathlib import Path
from time import perf_counter
from typing import Any, cast

import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor

from analysis.bench.command import LARGEST, ON_BOTH, ON_GPU
from analysis.bench.speed.meters import Meter, meter_of
from analysis.bench.speed.scene import ViewBench, per_vector
from analysis.bench.workloads import Size, Workload, synthetic_checkpoint, synthetic_workload, workload_of
from analysis.console.options import DeviceName, ProbeOptions
from analysis.console.timing import interleaved
from analysis.probe.command import run_probe
from landscape.probes import draw_probes
from splat.backend.device import device_named
from splat.backend.gpu.graphs import CALLS
from splat.curvature.hessian import SceneHessian
from splat.curvature.objective import SceneObjective
from splat.curvature.traces import LEAST_SAMPLES, exact_traces
from splat.scenes.synthetic import SyntheticSettings
from splat.training.checkpoint import write_atomically
from splat.training.densify import DensifySettings
from splat.training.loop import train
from splat.training.methods.stablegs.stablegs import StableGS
from splat.training.state import TrainConfig, Training

AGREED = {torch.float32: 1e-5, torch.float64: 1e-9}  # of a norm; of the loss a tenth of it
CPU = torch.device("cpu")
NEIGHBOURS = 3  # changes of last bits
REPETITIONS = 10
STEPS, PAPERS_MINUTES = 10_000, 13.0
FIRST, MEASURED = 10, 200  # steps: not timed, since kernels are compiled; timed
SECONDS = 540.0  # for all parts together


@dataclass(frozen=True)
class Check:
    """A number and what it should not exceed; None: nothing to compare it with, for this reason; infinite: it failed."""

    name: str
    value: float | None
    bound: float
    reason: str | None = None

    @property
    def holds(self) -> bool | None:
        return None if self.value is None else self.value <= self.bound


# --- parts ------------------------------------------------------------------------------------------------------------


def agreement(workload: Workload, device: torch.device, neighbours: int = 0) -> list[Check]:
    """The same numbers on the CPU and on a device, from the same random vectors.

    neighbours: times that the opacities' last bits are changed; twice what that changes on the CPU is no disagreement.
    """
    here, bound = _numbers(workload, CPU), AGREED[workload.gaussians.flat.dtype]
    moved = [_apart(here, _numbers(_with_other_last_bits(workload, seed), CPU)) for seed in range(neighbours)]
    checks = []
    for name, off in _apart(here, _numbers(workload, device)).items():
        asked = bound / 10 if name == "loss" else bound
        checks.append(Check(name, off, max([asked, *(2 * other[name] for other in moved)])))
    return checks


def _with_other_last_bits(workload: Workload, seed: int) -> Workload:
    """Every opacity logit moved to one of the two numbers next to it."""
    gaussians = workload.gaussians.with_flat(workload.gaussians.flat.clone())
    logits = gaussians.opacity_logits
    up = torch.rand(logits.shape, generator=torch.Generator().manual_seed(seed)) < 0.5
    logits.copy_(torch.nextafter(logits, torch.where(up, inf, -inf).to(logits)))
    return replace(workload, gaussians=gaussians)


def _numbers(workload: Workload, at: torch.device) -> dict[str, Tensor]:
    w = workload.to(at)
    objective = SceneObjective(w.gaussians, w.views, w.loss, w.background, w.settings, keep_unseen=True)
    generator = torch.Generator().manual_seed(0)
    v = draw_probes(objective.active.flat.numel(), 1, generator, objective.active.flat.dtype)
    traces = exact_traces(objective, generator, samples=LEAST_SAMPLES)
    return {
        "loss": torch.tensor(objective.loss(objective.active.flat), dtype=torch.float64),
        "gradient": objective.gradient.cpu(),
        "H v": SceneHessian(objective).apply(v),
        **{f"trace of {name}": torch.tensor(trace.value, dtype=torch.float64) for name, trace in traces.items()},
    }


def _apart(here: dict[str, Tensor], there: dict[str, Tensor]) -> dict[str, float]:
    """Norms of the differences, as shares of the norms."""
    return {name: float((there[name] - here[name]).double().norm() / here[name].double().norm()) for name in here}


def recordings(workload: Workload, meter: Meter) -> list[Check]:
    """The last of a few products, which is recorded, against the same launched kernel by kernel."""
    w, checks = workload.to(meter.device), []
    objective = SceneObjective(w.gaussians, w.views, w.loss, w.background, w.settings)
    hessian, generator = SceneHessian(objective, keep_null=True), torch.Generator(meter.device).manual_seed(0)
    for vectors in (1, 8):
        if not objective.recordable(vectors):
            checks.append(Check(f"H v {vectors}, recorded", None, 0.0, "not recorded here"))
            continue
        blocks = [draw_probes(hessian.dim, vectors, generator, hessian.dtype) for _ in range(CALLS + 1)]
        differences = [(hessian.apply(V) - objective.mean(hessian.launched(V))).abs().max() for V in blocks]
        V = blocks[-1]
        calls = {"recorded": lambda V=V: hessian.apply(V), "launched": lambda V=V: hessian.launched(V)}
        times = interleaved(calls, REPETITIONS, clock=meter.seconds)
        ratio = times["recorded"].minimum / times["launched"].minimum
        checks.append(Check(f"H v {vectors}, recorded - launched", float(max(differences)), 0.0))
        checks.append(Check(f"H v {vectors}, seconds recorded / launched", ratio, 1.0))
    return checks


def ratios(workload: Workload, device: torch.device) -> list[Check]:
    """Of times of the first view."""
    bench = ViewBench(workload.to(device))
    times = interleaved({**bench.wholes(), **bench.peers()}, REPETITIONS, clock=meter_of(device).seconds)
    return checks_of({name: time.minimum for name, time in per_vector(times).items()}, bench.lack)


def checks_of(seconds: dict[str, float], lack: str | None) -> list[Check]:
    """What is asked of times by name; lack: why there are none to compare with."""
    return [
        Check(f"{stage} / {unit}", seconds[stage] / seconds[unit] if unit in seconds else None, bound, lack)
        for stage, unit, bound in (*ON_GPU, *ON_BOTH)
    ]


def probe(settings: SyntheticSettings, device: torch.device, **options: Any) -> list[Check]:
    """The seconds of a probe, from the checkpoint to the pictures; options: of `ProbeOptions`."""
    with tempfile.TemporaryDirectory() as folder:
        checkpoint = synthetic_checkpoint(settings, Path(folder))
        start = perf_counter()
        code = run_probe(ProbeOptions(checkpoint, device=cast(DeviceName, device.type), **options))
        seconds = perf_counter() - start
    return [
        Check("exit code", code, 0),
        Check(f"{settings.gaussians} Gaussians, {settings.views} views, s", seconds, 60.0),
    ]


def training(workload: Workload, device: torch.device, first: int = FIRST, measured: int = MEASURED) -> list[Check]:
    """The minutes that all steps take at the pace of a few, without density control."""
    degree = workload.gaussians.sh_degree
    config = TrainConfig(STEPS, sh_degree=degree, sh_degree_every=1, loss=workload.loss, render=workload.settings)
    config = replace(config, method=StableGS(warm_up=0), densify=DensifySettings(enabled=False))
    views, state = list(workload.views[:3]), Training.start(workload.gaussians, 1.0, config)
    state.move(device)
    state.regularizer.begin(state, views)
    steps = train(state, views)
    for _ in range(first):
        next(steps)
    start = perf_counter()
    for _ in range(measured):
        next(steps)  # reads the loss, and so ends when the device has
    minutes = (perf_counter() - start) / measured * STEPS / 60
    name = f"{STEPS} steps of StableGS, {len(workload.gaussians)} Gaussians, {len(views)} views, minutes"
    return [Check(name, minutes, PAPERS_MINUTES)]


def _small() -> Workload:
    return synthetic_workload(Size(2000, 200, 150))


def in_both_precisions(workload: Workload, device: torch.device) -> list[Check]:
    """Of a trained scene: double first, which tells whether the formulas agree."""
    double, single = (
        replace(workload, gaussians=workload.gaussians.to(dtype)) for dtype in (torch.float64, torch.float32)
    )
    found = {"float64": agreement(double, device), "float32": agreement(single, device, NEIGHBOURS)}
    return [replace(check, name=f"{check.name}, {dtype}") for dtype, checks in found.items() for check in checks]


def _like_fern() -> Workload:
    return synthetic_workload(Size(10_000, 504, 378))


Part = tuple[float, Callable[[torch.device, Path | None], list[Check]]]
PARTS: dict[str, Part] = {  # seconds at most, and what is asked, of a checkpoint where one is given
    "agreement": (180, lambda device, path: agreement(_small(), device)),
    "recordings": (90, lambda device, path: recordings(_like_fern(), meter_of(device))),
    "ratios": (150, lambda device, path: ratios(synthetic_workload(Size.parse(LARGEST)), device)),
    "probe": (240, lambda device, path: probe(SyntheticSettings(500_000, 24, 1600, 1060, sh_degree=3), device)),
    "training": (90, lambda device, path: training(workload_of(path) if path else _like_fern(), device)),
    "checkpoint": (240, lambda device, path: in_both_precisions(workload_of(path), device) if path else []),
}


# --- one after the other ----------------------------------------------------------------------------------------------


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables; 1 where something does not hold, 2 where there is no GPU to ask."""
    options = _options(sys.argv[1:] if arguments is None else arguments)
    try:
        device = device_named("cuda")
    except ValueError as error:
        print(f"gpu_check: {error}", file=sys.stderr)
        return 2
    if options.into:
        checks = PARTS[options.only[0]][1](device, options.checkpoint)
        options.into.write_text(json.dumps([asdict(check) for check in checks]))
        return 0
    again = [
        sys.executable,
        "-m",
        "analysis.bench.gpu_check",
        *([str(options.checkpoint)] if options.checkpoint else []),
    ]
    chosen = options.only or [name for name in PARTS if name != "checkpoint" or options.checkpoint]
    commands = {name: (PARTS[name][0], [*again, "--only", name]) for name in chosen}
    found = in_turn(commands, options.out, options.seconds, Console())
    return int(any(check.holds is False for checks in found.values() for check in checks))


def _options(arguments: Sequence[str]) -> Namespace:
    parser = ArgumentParser("python -m analysis.bench.gpu_check")
    parser.add_argument("checkpoint", nargs="?", type=Path, help="RUN/checkpoint.pt")
    parser.add_argument("--only", nargs="+", default=[], choices=PARTS, metavar="PART", help=", ".join(PARTS))
    parser.add_argument(
        "--out", type=Path, default=Path("gpu_check.json"), help="what was found, written after every part"
    )
    parser.add_argument("--seconds", type=float, default=SECONDS, help="for all parts together")
    parser.add_argument("--into", type=Path, help="work on one part in this process, and write its numbers there")
    return parser.parse_args(arguments)


def in_turn(
    commands: Mapping[str, tuple[float, list[str]]], out: Path, seconds: float, console: Console
) -> dict[str, list[Check]]:
    """What each part finds, whose command takes --into FILE; a limit and a command each, and seconds for all together."""
    end, found = perf_counter() + seconds, {}
    for name, (limit, command) in commands.items():
        console.rule(name)
        start = perf_counter()
        found[name] = _found(name, command, min(limit, end - start))
        console.print(table(f"{name}, {perf_counter() - start:.0f} s", found[name]))
        lines = {part: [asdict(check) for check in checks] for part, checks in found.items()}
        write_atomically(out, json.dumps(lines, indent=1).encode())
    return found


def _found(name: str, command: list[str], limit: float) -> list[Check]:
    if limit <= 0:
        return [Check(name, None, 0.0, "no time was left")]
    with tempfile.TemporaryDirectory() as folder:
        into = Path(folder) / "checks.json"
        try:
            code = subprocess.run([*command, "--into", str(into)], timeout=limit).returncode
        except subprocess.TimeoutExpired:
            return [Check(name, inf, 0.0, f"not done in {limit:.0f} s")]
        if code or not into.is_file():
            return [Check(name, inf, 0.0, f"failed with exit code {code}, see above")]
        return [Check(**line) for line in json.loads(into.read_text())]


def table(name: str, checks: Sequence[Check]) -> Table:
    result = Table("", "found", "at most", "", title=name)
    for check in checks:
        value = "-" if check.value is None or isinf(check.value) else f"{check.value:.2g}"
        words = {None: check.reason, True: "holds", False: "[red]does not hold[/red]"}[check.holds]
        if check.value is not None and isinf(check.value):
            words = f"[red]{check.reason}[/red]"
        result.add_row(check.name, value, f"{check.bound:g}", words)
    return result


if __name__ == "__main__":
    sys.exit(main())
