"""A record of a probe as one table for the terminal."""

from collections.abc import Iterator, Mapping
from typing import Any

from rich import box
from rich.table import Table

from analysis.console.budget import NEEDS_DENSITY
from analysis.records.findings import attribute_name
from analysis.records.quantities import limits, measured, quantity

ENDS = {
    "max": "largest eigenvalue",
    "second": "second largest",
    "min": "smallest eigenvalue",
    "power_max": "power iteration, max",
    "power_min": "power iteration, min",
}
COUNTS = {
    "Gaussians in sight": ("visible_gaussians", "gaussians"),
    "active parameters": ("active_parameters", "parameters"),
    "SH degree in use": ("sh_degree_active", "sh_degree_stored"),
}
ERRORS = "± of a trace: its standard error; of an eigenvalue: within it lies a true one, not necessarily the end."
NARROW = 0.1  # of the value
OUTCOMES = {True: "[green]passed[/]", False: "[red]FAILED[/]", None: "[yellow]could not run[/]"}


def probe_table(data: Mapping[str, Any]) -> Table:
    """Traces, eigenvalues, anisotropy, counts and checks of a record's data."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, caption=ERRORS, caption_justify="left")
    table.add_column("", no_wrap=True)
    table.add_column("value ± error", justify="right", no_wrap=True)
    table.add_column("τ", justify="right", no_wrap=True)
    table.add_column("")
    for name, trace in data["traces"].items():
        value = measured(trace["value"], trace["standard_error"])
        about = f"{trace['sign']}, dim {trace['dim']:,}, {trace['matvecs']} products{_reason(trace)}"
        table.add_row(f"trace of {attribute_name(name)}", value, quantity(trace["tau"]), about)
    table.add_section()
    for name, end in data["eigenvalues"].items():
        main, share = max(end["shares"].items(), key=lambda item: item[1])
        about = f"{share:.0%} {attribute_name(main)}, {end['matvecs']} products{_reason(end)}"
        table.add_row(ENDS[name], measured(end["value"], end["residual"]), "", about)
    table.add_section()
    for name, index in data["anisotropy"].items():
        if index["note"] != NEEDS_DENSITY:  # the record's notes say that these were left out
            table.add_row(name.replace("_", " "), *_index(index))
    table.add_section()
    for row in _depth_rows(data.get("depth")):
        table.add_row(*row)
    table.add_section()
    for name, (used, stored) in COUNTS.items():
        table.add_row(name, f"{data['counts'][used]:,}", "", f"of {data['counts'][stored]:,}")
    table.add_section()
    for name, check in data["checks"].items():
        about = f"{OUTCOMES[check['passed']]}, at most {quantity(check['bound'])}"
        about += f" ({check['note']})" if check.get("note") else ""
        table.add_row(f"check: {name.replace('_', ' ')}", quantity(check["value"]), "", about)
    return table


def _depth_rows(depth: Mapping[str, Any] | None) -> Iterator[tuple[str, str, str, str]]:
    """Of positions: along the rays, over a direction across them."""
    if depth is None:
        return
    median = f"median {quantity(depth['gradient_median'])}, {depth['pairs']:,} pairs of Gaussian and view"
    yield "depth gradient / lateral", quantity(depth["gradient_ratio"]), "", median
    yield "depth curvature / lateral", *_index(depth["curvature_ratio"])
    for row in depth["rises"]:
        rises = " over ".join(measured(row[kind], row[f"{kind}_error"]) for kind in ("depth", "lateral"))
        name = f"depth / lateral rise, {row['pixels']:g} px"
        yield name, measured(row["ratio"], row["ratio_error"]), "", rises


def _index(index: Mapping[str, Any]) -> tuple[str, str, str]:
    """Value, nothing, bracket and note; a narrow bracket is written as an error."""
    value, low, high, note = (index[key] for key in ("value", "low", "high", "note"))
    if low is None and high is None:
        return quantity(value), "", note
    if low is None or high is None:
        bracket = " to ".join("unbounded" if end is None else quantity(end) for end in (low, high))
    elif high - low < NARROW * abs(high + low) / 2:
        if value is not None and low <= value <= high:
            return measured(value, max(high - value, value - low)), "", note
        bracket = measured((low + high) / 2, (high - low) / 2)
    else:
        bracket = " to ".join(limits(low, high))
    return quantity(value), "", f"{bracket} ({note})" if note else bracket


def _reason(entry: Mapping[str, Any]) -> str:
    """Why it stopped, where that was not because the error asked for was reached."""
    return "" if entry["reason"] in ("tolerance", "exact") else f", {entry['reason']}"
