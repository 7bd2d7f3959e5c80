"""What a machine with a GPU is to be asked, in a few minutes: does it agree with the CPU, and how fast is it?

    python -m analysis.gpu_check RUN/checkpoint.pt          both, on the checkpoint's training views
    python -m analysis.gpu_check 500k@1600x1060             the ratios alone, on a synthetic scene of that size

Agreement: relative differences, the GPU's loss, gradient, H v and traces against the CPU's, all in the checkpoint's precision.
Ratios: those that `landscape bench --device cuda` is held to, which also says what they are made of.  How long a whole probe
takes, `landscape probe --device cuda` says.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor

from analysis.bench import ON_BOTH, ON_GPU
from analysis.bench_scene import ViewBench, per_vector
from analysis.meters import meter_of
from analysis.timing import interleaved
from analysis.workloads import Size, Workload, synthetic_workload, workload_of
from landscape.probes import draw_probes
from splat.curvature import SceneHessian, SceneObjective
from splat.device import device_named
from splat.traces import LEAST_SAMPLES, exact_traces

REPETITIONS = 10


@dataclass(frozen=True)
class Check:
    """A number and what it should not exceed; None: nothing to compare it with, for this reason."""

    name: str
    value: float | None
    bound: float
    reason: str | None = None

    @property
    def holds(self) -> bool | None:
        return None if self.value is None else self.value <= self.bound


def agreement(workload: Workload, device: torch.device) -> list[Check]:
    """The same numbers on the CPU and on a device, from the same random vectors."""
    found: list[dict[str, Tensor]] = []
    for at in (torch.device("cpu"), device):
        w = workload.to(at)
        objective = SceneObjective(w.gaussians, w.views, w.loss, w.background, w.settings, keep_unseen=True)
        generator = torch.Generator().manual_seed(0)
        v = draw_probes(objective.active.flat.numel(), 1, generator, objective.active.flat.dtype)
        traces = exact_traces(objective, generator, samples=LEAST_SAMPLES)
        found.append(
            {
                "loss": torch.tensor(objective.loss(objective.active.flat), dtype=torch.float64),
                "gradient": objective.gradient.cpu(),
                "H v": SceneHessian(objective).apply(v),
                **{
                    f"trace of {name}": torch.tensor(trace.value, dtype=torch.float64) for name, trace in traces.items()
                },
            }
        )
    here, there = found
    differences = {name: (there[name] - here[name]).double().norm() / here[name].double().norm() for name in here}
    return [Check(name, float(value), 1e-6 if name == "loss" else 1e-5) for name, value in differences.items()]


def speed(workload: Workload, device: torch.device) -> list[Check]:
    """The ratios of the first view."""
    bench = ViewBench(workload.to(device))
    times = interleaved({**bench.wholes(), **bench.peers()}, REPETITIONS, clock=meter_of(device).seconds)
    return checks_of({name: time.minimum for name, time in per_vector(times).items()}, bench.lack)


def checks_of(seconds: dict[str, float], lack: str | None) -> list[Check]:
    """What is asked of times by name; lack: why there are none to compare with."""
    return [
        Check(f"{stage} / {unit}", seconds[stage] / seconds[unit] if unit in seconds else None, bound, lack)
        for stage, unit, bound in (*ON_GPU, *ON_BOTH)
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table; 1 where something does not hold."""
    (path,) = sys.argv[1:] if arguments is None else arguments
    device = device_named("cuda")
    if Path(path).exists():
        workload = workload_of(Path(path))
        checks = agreement(workload, device) + speed(workload, device)
    else:
        workload = synthetic_workload(Size.parse(path))
        checks = speed(workload, device)
    Console().print(table(workload.name, checks))
    return int(any(check.holds is False for check in checks))


def table(name: str, checks: Sequence[Check]) -> Table:
    result = Table("", "found", "at most", "", title=name)
    for check in checks:
        value = "-" if check.value is None else f"{check.value:.2g}"
        words = {None: check.reason, True: "holds", False: "[red]does not hold[/red]"}
        result.add_row(check.name, value, f"{check.bound:g}", words[check.holds])
    return result


if __name__ == "__main__":
    sys.exit(main())
