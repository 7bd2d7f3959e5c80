"""Where numbers come from: the time, the seed, the versions of the packages, the machine.  Needs no torch, no git."""

import importlib.metadata
import os
import platform
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

PACKAGES = ("splat-landscape", "torch", "numpy", "scipy", "numba", "matplotlib", "pyvista", "plotly")


def require_seed(seed: int) -> None:
    """ValueError where it is out of range."""
    if not 0 <= seed < 2**63:
        raise ValueError(f"expected a seed in [0, 2^63), got {seed}")


def provenance(seed: int, *, lanes: int | None = None, **more: Any) -> dict[str, Any]:
    """The `provenance` of a record (see `analysis.records.records`); `more` (checkpoint, scene, ...) is added as it is.

    lanes: float32 numbers in one SIMD vector of the kernels that ran, where known.
    """
    return {
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "seed": seed,
        "versions": versions(),
        "machine": machine(lanes),
        **more,
    }


def versions() -> dict[str, str | None]:
    """Python's version and those of the packages that the numbers depend on; None for what is not installed."""
    found: dict[str, str | None] = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            found[package] = None
    return found


def machine(lanes: int | None = None) -> dict[str, Any]:
    """The processor, how many of its cores this process may use, and the system."""
    return {
        "cpu": _cpu_name(),
        "cores": usable_cores(),
        "lanes": lanes,
        "system": f"{platform.system()} {platform.machine()}",
    }


def usable_cores() -> int:
    """Those that this process may use; all of the machine's where the system does not say (macOS)."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _cpu_name() -> str:
    listing = Path("/proc/cpuinfo")  # Linux; platform.processor() is empty there
    if listing.is_file():
        for line in listing.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
