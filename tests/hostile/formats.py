"""Every format that is read, by its name in the table of outcomes."""

from tests.hostile.broken import Format
from tests.hostile.run_formats import CheckpointFile, ProbeArrays, ProbeJson, RunFiles, SweepToml, TrajectoryCsv
from tests.hostile.scene_formats import ColmapBinary, ColmapText, Llff, Pictures, Ply, PlyText, Transforms

FORMATS: dict[str, type[Format]] = {
    each.name: each
    for each in (
        CheckpointFile, ProbeJson, ProbeArrays, TrajectoryCsv, RunFiles, SweepToml, ColmapBinary, ColmapText, Llff, Transforms,
        Ply, PlyText, Pictures,
    )
}  # fmt: skip
