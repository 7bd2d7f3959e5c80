"""A scene of a size, in a process of its own: `python -m notebooks.sizes.scene GAUSSIANS VIEWS WIDTH HEIGHT FOLDER`.

FOLDER/scene has as many views as leave VIEWS for training, FOLDER/start.ply its Gaussians
without their exact colours, degree 3.
"""

import sys
from dataclasses import replace
from pathlib import Path

from analysis.bench.workloads import Size, synthetic_workload
from splat.model.files.splat_ply import splat_ply
from splat.model.untrusted import write_atomically
from splat.scenes.splits import HOLD_OUT
from splat.scenes.synthetic import SyntheticSettings, synthetic_scene
from splat.scenes.write import write_transforms_scene

if __name__ == "__main__":
    gaussians, views, width, height = map(int, sys.argv[1:5])
    folder, frames = Path(sys.argv[5]), views + -(-views // (HOLD_OUT - 1))  # every HOLD_OUT-th is held out
    made = synthetic_scene(SyntheticSettings(gaussians, frames, width, height))
    write_transforms_scene(replace(made.scene, points=None), folder / "scene")
    start = synthetic_workload(Size(gaussians, width, height)).gaussians
    write_atomically(folder / "start.ply", splat_ply(start, tool="splat-landscape"))
