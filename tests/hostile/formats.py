"""Every format that is read, by its name in the table of outcomes."""

from tests.hostile.broken import Format
from tests.hostile.model_formats import QUANTISED, DotSplat, Graphdeco, Gsplat, PointCloud, Splatfacto, TextPly
from tests.hostile.run_formats import CheckpointFile, ProbeArrays, ProbeJson, RunFiles, SweepToml, TrajectoryCsv
from tests.hostile.scene_formats import Blender, ColmapBinary, ColmapText, Dtu, Llff, Pictures, Ply, PlyText, Transforms
from tests.hostile.work_formats import KeptPoints, KeptStages, MapFiles, OriginOfRecord, SliceFiles, StudyCsv, StudyToml

FORMATS: dict[str, type[Format]] = {
    each.name: each
    for each in (
        StudyCsv, CheckpointFile, ProbeJson, ProbeArrays, TrajectoryCsv, RunFiles, SweepToml, ColmapBinary, ColmapText, Llff,
        Transforms, Ply, PlyText, Pictures, PointCloud, TextPly, DotSplat, Graphdeco, Gsplat, Splatfacto, *QUANTISED,
        Blender, Dtu, SliceFiles, KeptStages, KeptPoints, MapFiles, StudyToml, OriginOfRecord,
    )
}  # fmt: skip
