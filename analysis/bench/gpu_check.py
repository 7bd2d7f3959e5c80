"""Check a GPU in a few minutes: agreement with the CPU, recorded products, and the times of a probe and of a training.

    python -m analysis.bench.gpu_check                            every part, on synthetic scenes
    python -m analysis.bench.gpu_check RUN/checkpoint.pt          training from that checkpoint, and agreement there, too
    python -m analysis.bench.gpu_check --only recordings probe    some parts

    agreement    relative differences of the GPU's loss, gradient, H v and traces from the CPU's, in single precision
    recordings   products as CUDA graphs against the same launched kernel by kernel: to the last bit, and how much faster
    probe        seconds of `landscape probe` on 500,000 Gaussians in 24 views
    training     minutes of 10,000 steps of StableGS with all viewpoints in 3 views, at the pace of two hundred
    checkpoint   agreement at the checkpoint, in double precision and in single

How fast the kernels are, stage by stage, says `landscape bench --device cuda`.

In single precision round-off decides in a trained scene whether some Gaussian is drawn at some pixel, and which way L1 slopes.
So there the two may differ by twice what a change of the opacities' last bits is seen to change on the CPU.

Every part is a process with a time limit: a kernel that reads beyond its memory leaves no GPU to the process that launched it.
A part's table is printed and written when it ends.
"""

import json
import subprocess
import sys
import tempfile
from argparse import ArgumentParser
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from math import inf
from pathlib import Path
from time import perf_counter
from typing import Any, cast

import pandas as pd
import torch
from rich.console import Console
from torch import Tensor

from analysis.bench.speed.meters import Meter, meter_of
from analysis.bench.speed.timing import interleaved
from analysis.bench.tables import rich_table
from analysis.bench.workloads import Size, Workload, synthetic_checkpoint, synthetic_workload, workload_of
from analysis.console.failures import program
from analysis.console.options import DeviceName
from analysis.probe.command import run_probe
from analysis.probe.options import ProbeOptions
from landscape.errors import InputError
from landscape.probes import draw_probes
from splat.backend.device import device_named
from splat.backend.gpu.graphs import CALLS
from splat.curvature.hessian import SceneHessian
from splat.curvature.objective import SceneObjective
from splat.curvature.traces import LEAST_SAMPLES, exact_traces
from splat.scenes.synthetic import SyntheticSettings
from splat.training.checkpoint import write_atomically
from splat.training.densify import DensifySettings
from splat.training.loop import prepare, train
from splat.training.methods.stablegs.stablegs import StableGS
from splat.training.state import TrainConfig, Training

# of a norm; of the loss a tenth of it.  Single: a hundred round-offs, as sums in another order have; double: less than any
# wrong term of a formula makes
AGREED = {torch.float32: 1e-5, torch.float64: 1e-9}
CPU = torch.device("cpu")
NEIGHBOURS = 3  # changes of last bits
REPETITIONS = 10
PROBE_SECONDS = 60.0  # what the project promises of the largest scene
STEPS, PAPERS_MINUTES = 10_000, 13.0  # of a training; the time is StableGS's, as its paper reports it
FIRST, MEASURED = 10, 200  # steps: not timed, since kernels are compiled; timed


@dataclass(frozen=True)
class Check:
    """A number and what it should not exceed; None: nothing to compare it with, for this reason; infinite: it failed."""

    name: str
    value: float | None
    bound: float
    reason: str | None = None

    @property
    def verdict(self) -> str:
        """Whether it holds, or why there is no number."""
        if self.value is None or self.value == inf:
            return self.reason or ""
        return "holds" if self.value <= self.bound else "does not hold"

    @property
    def fails(self) -> bool:
        return self.value is not None and not self.value <= self.bound


# --- parts ------------------------------------------------------------------------------------------------------------


def agreement(workload: Workload, device: torch.device, neighbours: int = 0) -> list[Check]:
    """Compare the same numbers on the CPU and on a device, from the same random vectors.

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


def in_both_precisions(workload: Workload, device: torch.device) -> list[Check]:
    """Agreement at a trained scene: in double precision first, which tells whether the formulas agree."""
    checks = []
    for dtype, neighbours in ((torch.float64, 0), (torch.float32, NEIGHBOURS)):
        found = agreement(replace(workload, gaussians=workload.gaussians.to(dtype)), device, neighbours)
        checks += [replace(check, name=f"{check.name}, {str(dtype).removeprefix('torch.')}") for check in found]
    return checks


def recordings(workload: Workload, meter: Meter) -> list[Check]:
    """Compare the last of a few products, which is recorded, with the same launched kernel by kernel."""
    w, checks = workload.to(meter.device), []
    objective = SceneObjective(w.gaussians, w.views, w.loss, w.background, w.settings)
    hessian, generator = SceneHessian(objective, keep_null=True), torch.Generator(meter.device).manual_seed(0)
    for vectors in (1, 8):
        if not hessian.recordable(vectors):
            checks.append(Check(f"H v {vectors}, recorded", None, 0.0, "not recorded here"))
            continue
        blocks = [draw_probes(hessian.dim, vectors, generator, hessian.dtype) for _ in range(CALLS + 1)]
        differences = [
            (hessian.apply(V) - objective.mean_over_views(hessian.views.apply(V))).abs().max() for V in blocks
        ]
        V = blocks[-1]
        calls = {"recorded": lambda V=V: hessian.apply(V), "launched": lambda V=V: hessian.views.apply(V)}
        times = interleaved(calls, REPETITIONS, clock=meter.seconds)
        ratio = times["recorded"].minimum / times["launched"].minimum
        checks.append(Check(f"H v {vectors}, recorded - launched", float(max(differences)), 0.0))
        checks.append(Check(f"H v {vectors}, seconds recorded / launched", ratio, 1.0))
    return checks


def probe(settings: SyntheticSettings, device: torch.device, **options: Any) -> list[Check]:
    """Time a probe, from the checkpoint to the pictures; options: of `ProbeOptions`."""
    with tempfile.TemporaryDirectory() as folder:
        checkpoint = synthetic_checkpoint(settings, Path(folder))
        start = perf_counter()
        code = run_probe(ProbeOptions(checkpoint, device=cast(DeviceName, device.type), **options))
        seconds = perf_counter() - start
    name = f"{settings.gaussians} Gaussians, {settings.views} views, s"
    return [Check("exit code", code, 0), Check(name, seconds, PROBE_SECONDS)]


def training(workload: Workload, device: torch.device, first: int = FIRST, measured: int = MEASURED) -> list[Check]:
    """The minutes that all steps take at the pace of a few, without density control."""
    degree = workload.gaussians.sh_degree
    config = TrainConfig(STEPS, sh_degree=degree, sh_degree_every=1, loss=workload.loss, render=workload.settings)
    config = replace(config, method=StableGS(warm_up=0), densify=DensifySettings(enabled=False))
    views, state = list(workload.views[:3]), Training.start(workload.gaussians, 1.0, config)
    state.move(device)
    prepare(state, views)
    steps = train(state, views)
    for _ in range(first):
        next(steps)
    start = perf_counter()
    for _ in range(measured):
        next(steps)  # reads the loss, and so ends when the device has
    minutes = (perf_counter() - start) / measured * STEPS / 60
    name = f"{STEPS} steps of StableGS, {len(workload.gaussians)} Gaussians, {len(views)} views, minutes"
    return [Check(name, minutes, PAPERS_MINUTES)]


def _synthetic(count: int, width: int, height: int) -> Workload:
    return synthetic_workload(Size(count, width, height))


PARTS: dict[str, tuple[float, Callable[[torch.device, Path | None], list[Check]]]] = {  # seconds at most, and the check
    "agreement": (180, lambda device, path: agreement(_synthetic(2000, 200, 150), device)),
    "recordings": (90, lambda device, path: recordings(_synthetic(10_000, 504, 378), meter_of(device))),
    "probe": (240, lambda device, path: probe(SyntheticSettings(500_000, 24, 1600, 1060, sh_degree=3), device)),
    "training": (
        90,
        lambda device, path: training(workload_of(path) if path else _synthetic(10_000, 504, 378), device),
    ),
    "checkpoint": (240, lambda device, path: in_both_precisions(workload_of(path), device) if path else []),
}


# --- one after the other ----------------------------------------------------------------------------------------------


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables; 1 where something does not hold, 2 where there is no GPU to ask."""
    parser = ArgumentParser("python -m analysis.bench.gpu_check")
    parser.add_argument("checkpoint", nargs="?", type=Path, help="RUN/checkpoint.pt")
    parser.add_argument("--only", nargs="+", default=[], choices=PARTS, metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--out", type=Path, default=Path("gpu_check.json"), help="written after every part")
    parser.add_argument("--into", type=Path, help="work on one part in this process, and write its numbers there")
    options = parser.parse_args(arguments)
    try:
        device = device_named("cuda")
    except InputError as error:
        print(f"gpu_check: {error}", file=sys.stderr)
        return 2
    if options.into:
        checks = PARTS[options.only[0]][1](device, options.checkpoint)
        options.into.write_text(json.dumps([asdict(check) for check in checks]))
        return 0
    again = [sys.executable, "-m", "analysis.bench.gpu_check", *filter(None, [options.checkpoint])]
    chosen = options.only or [name for name in PARTS if name != "checkpoint" or options.checkpoint]
    commands = {name: (PARTS[name][0], [*map(str, again), "--only", name]) for name in chosen}
    found = in_turn(commands, options.out, Console())
    return int(any(check.fails for checks in found.values() for check in checks))


def in_turn(commands: Mapping[str, tuple[float, list[str]]], out: Path, console: Console) -> dict[str, list[Check]]:
    """Checks of each part, by name; commands: a limit in seconds and a command that takes --into FILE."""
    found: dict[str, list[Check]] = {}
    for name, (limit, command) in commands.items():
        console.rule(name)
        start = perf_counter()
        found[name] = _found(name, command, limit)
        rows = [(check.name, check.value, f"{check.bound:g}", check.verdict) for check in found[name]]
        table = pd.DataFrame(rows, columns=["", "found", "at most", " "])
        console.print(rich_table(table, f"{name}, {perf_counter() - start:.0f} s"))
        lines = {part: [asdict(check) for check in checks] for part, checks in found.items()}
        write_atomically(out, json.dumps(lines, indent=1).encode())
    return found


def _found(name: str, command: list[str], limit: float) -> list[Check]:
    with tempfile.TemporaryDirectory() as folder:
        into = Path(folder) / "checks.json"
        try:
            code = subprocess.run([*command, "--into", str(into)], timeout=limit).returncode
        except subprocess.TimeoutExpired:
            return [Check(name, inf, 0.0, f"not done in {limit:.0f} s")]
        if code or not into.is_file():
            return [Check(name, inf, 0.0, f"failed with exit code {code}, see above")]
        return [Check(**line) for line in json.loads(into.read_text())]


if __name__ == "__main__":
    program(main)
