"""A record with its pictures: the one way in which the commands write what they found."""

from collections.abc import Mapping
from pathlib import Path
from time import perf_counter

import numpy as np

from analysis.console.drawing import Draw, draw
from analysis.console.stages import Stages
from analysis.records.records import ProbeRecord, SliceRecord, write_data, write_record


def write_with_pictures(
    folder: Path,
    data: ProbeRecord | SliceRecord,
    arrays: Mapping[str, Mapping[str, np.ndarray]],
    stages: Stages,
    start: float,
    drawn: Draw | None = None,
) -> None:
    """Write the record into `folder`, draw its pictures, and add to data how long all took since `start` and what was said.

    drawn: draws the pictures, where `drawing` has begun with it.
    """
    data.timing = {"total": perf_counter() - start}
    write_record(folder, data, arrays)
    with stages.stage("pictures"):
        data.notes += draw("make_all", folder) if drawn is None else drawn(folder)
    # the pictures are drawn from the record; only now is it known how long they took
    data.timing = {**stages.timing, "total": perf_counter() - start}
    write_data(folder, data)
