"""Provenance of numbers: the time, the seed, the versions of the packages, the commit, the machine.  Needs no torch."""

import importlib.metadata
import os
import platform
import shlex
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import fields
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from msgspec import UNSET, Meta, Struct, convert

from analysis.records.schema import Maybe, NonNegative, Number
from landscape.errors import InputError
from splat.training.origin.fingerprint import Fingerprint
from splat.training.origin.options import Foreign

if TYPE_CHECKING:
    from splat.training.origin.subject import Subject

PACKAGES = ("splat-landscape", "torch", "numpy", "scipy", "numba", "matplotlib")


class Machine(Struct, kw_only=True):
    """cores: those that the process may use.  lanes: float32 numbers in a SIMD vector of the kernels; None: not known."""

    cpu: str
    cores: int | None = None
    lanes: int | None = None
    system: str = ""


class Loss(Struct, kw_only=True):
    """`LossSettings` as they are written."""

    pixel: str = "l1"
    ssim_weight: float = 0.2
    eps: float = 0.01
    literal: bool = False
    border: str = "padded"
    opacity_reg: NonNegative = 0.0
    scale_reg: NonNegative = 0.0


class Conventions(Struct, kw_only=True):
    """Those of a trainer, as `splat.training.origin.presets.Preset` has them; render: `RenderSettings`."""

    render: dict[str, bool | int | float | str | None]
    loss: Loss
    world: str = "scene"
    centred: bool = False
    widest: int | None = None
    antialias: str = "none"
    antialiased_blur: float | None = None
    different: list[str] = []


class Origin(Struct, kw_only=True):
    """What was assumed of another tool's file (`splat.training.origin.foreign`).  views: how they were found, in words."""

    trained_by: str
    images: str | None
    downscale: Annotated[float, Meta(gt=0)]
    preset: Conventions
    format: str = ""
    trained_by_source: str = ""
    views: str = ""
    notes: list[str] = []
    psnr: Number = None
    similarity: list[list[float]] | None = None


class Provenance(Struct, kw_only=True):
    """Origin of numbers.  versions: of Python and packages, None for what is not installed.

    commit: of the checkout that the code lies in, ending in + where files differ from it; None without git or outside of one.
    origin: of another tool's file, what was assumed.  other: the checkpoint at the other end of a line.  fingerprint: what the
    numbers are about.
    """

    created: str
    seed: int
    versions: dict[str, str | None]
    machine: Machine
    commit: Maybe[str | None] = UNSET
    checkpoint: Maybe[str] = UNSET
    origin: Maybe[Origin] = UNSET
    other: Maybe[str | None] = UNSET
    scene: Maybe[str] = UNSET
    scene_folder: Maybe[str] = UNSET
    views: Maybe[list[str] | None] = UNSET
    iteration: Maybe[int] = UNSET
    dtype: Maybe[str] = UNSET
    threads: Maybe[int] = UNSET
    command: Maybe[str] = UNSET
    fingerprint: Maybe[Fingerprint] = UNSET

    def other_command(self, name: str) -> str:
        """Another command on the same checkpoint, whole: with what was typed of another tool's file and its scene.

        >>> made = provenance(0, checkpoint="a.ply", command="landscape probe --guess-views a.ply --seed 1 --scene 'my fern'")
        >>> made.other_command("map")
        "landscape map a.ply --guess-views --scene 'my fern'"
        """
        takes = {f"--{each.name.replace('_', '-')}": not isinstance(each.default, bool) for each in fields(Foreign)}
        typed, kept = iter(shlex.split(self.command or "")), list[str]()
        for word in typed:
            option, given, _ = word.replace("_", "-").partition("=")
            if option in takes:
                kept += [word, next(typed, "")] if takes[option] and not given else [word]
        at = (self.checkpoint or "CHECKPOINT").removesuffix("/checkpoint.pt")
        return shlex.join(["landscape", name, at, *kept])


def require_seed(seed: int) -> None:
    """InputError where it is out of range."""
    if not 0 <= seed < 2**63:
        raise InputError(f"expected a seed in [0, 2^63), got {seed}")


def require_alike(what: str, of_runs: Mapping[Any, Any], remedy: str) -> None:
    """InputError where runs differ in what makes their curvatures those of one function.  of_runs: by run."""
    for run, value in of_runs.items():
        first, of_first = next(iter(of_runs.items()))
        if value != of_first:
            raise InputError(
                f"expected runs with the same {what}, as their curvatures are not comparable else, got {of_first} in {first} "
                f"and {value} in {run}; {remedy}"
            )


def require_own(found: Maybe[Fingerprint | None], state: str, path: Path, remedy: str) -> None:
    """InputError unless the numbers of a record are of the checkpoint in this state."""
    if not found or found.state != state:
        raise InputError(f"expected in {path} a record of the checkpoint beside it, got one of another; {remedy}")


def provenance(seed: int, *, lanes: int | None = None, **more: Any) -> Provenance:
    """Provenance of a run here and now.  lanes: as in `Machine`; more: the other fields of `Provenance`."""
    created = datetime.now(UTC).isoformat(timespec="seconds")
    return Provenance(created=created, seed=seed, versions=versions(), machine=machine(lanes), commit=commit(), **more)


def provenance_of(made: Fingerprint, subject: "Subject", command: Sequence[str]) -> Provenance:
    """Provenance of a record of these numbers.  command: as typed."""
    import torch

    from splat.backend.cpu.simd import lanes_of

    checkpoint = subject.checkpoint
    return provenance(
        made.question["seed"],
        lanes=lanes_of(np.float32),
        checkpoint=str(subject.path),
        origin=UNSET if checkpoint.origin is None else convert(checkpoint.origin, Origin),
        scene=subject.scene.name,
        scene_folder=str(subject.scene.root),
        views=list(checkpoint.scene.train),
        iteration=checkpoint.training.step,
        dtype=str(checkpoint.training.gaussians.flat.dtype).removeprefix("torch."),
        threads=torch.get_num_threads(),
        command=shlex.join(command),
        fingerprint=made,
    )


def versions() -> dict[str, str | None]:
    """Python's version and those of the packages that the numbers depend on; None for what is not installed."""
    found: dict[str, str | None] = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            found[package] = None
    return found


def commit() -> str | None:
    """Commit of the checkout with this code; see `Provenance`."""
    words = "describe --always --abbrev=12 --exclude=* --dirty=+"
    command = ["git", "-C", str(Path(__file__).parent), *words.split()]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=5).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None


def machine(lanes: int | None = None) -> Machine:
    """The processor, how many of its cores this process may use, and the system."""
    system = f"{platform.system()} {platform.machine()}"
    return Machine(cpu=_cpu_name(), cores=usable_cores(), lanes=lanes, system=system)


def usable_cores() -> int:
    """Cores that this process may use; all of the machine's where the system does not say (macOS)."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _cpu_name() -> str:
    listing = Path("/proc/cpuinfo")  # Linux; platform.processor() is empty there
    if listing.is_file():
        for line in listing.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
