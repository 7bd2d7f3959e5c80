"""The methods' published trainings, as presets: `protocols.csv`, which is the table and the data at once.

    method, setting     the setting as `--set` names it, or "start", the option; empty: there is none, see the note
    published, source   the value in the released code and the line that says so, as in "owner/repository file:line"
    unit                of the numbers
    default             the value without a protocol: that of the trainings that are the same for all methods
    llff                the value with the protocol "llff", that of the code's script for LLFF with 3 views; empty: the default
    note                where ours differs, or what is not here

The lines are those of jiaw-z/CoR-GS at 1db13a4, VITA-Group/FSGS at a536a64, Fictionarry/DNGaussian at 13ecf60, xuyx55/DropoutGS
at 6ce7c0d, and for DCVL-3D/DropGaussian_release those of its copy liuhw01/DropGaussian_release at fae60cd.
"""

import csv
from functools import cache
from pathlib import Path
from typing import get_args

from landscape.errors import InputError
from splat.training.state import Protocol

COMMON: Protocol = "common"


@cache
def table() -> tuple[dict[str, str], ...]:
    """The rows, by column."""
    with Path(__file__).with_name("protocols.csv").open(encoding="utf-8", newline="") as file:
        return tuple(csv.DictReader(file))


def presets(method: str, protocol: Protocol) -> dict[str, str]:
    """The settings of a protocol as `--set` takes them; none of "common".  InputError where a method has no such training.

    >>> presets("dngaussian", "llff")["rates.position"], presets("dngaussian", "common")
    ('0.016', {})
    """
    if protocol not in get_args(Protocol):
        raise InputError(f"expected a protocol among {', '.join(get_args(Protocol))}, got {protocol!r}")
    if protocol == COMMON:
        return {}
    known = [row for row in table() if row[protocol]]
    found = {row["setting"]: row[protocol] for row in known if row["method"] == method}
    if not found:
        names = ", ".join(dict.fromkeys(row["method"] for row in known))
        raise InputError(f"expected a method with a published training for {protocol} ({names}), got {method!r}")
    return found
