"""The numbers of a quick probe, stored with the version of the formulas that gave them: `python -m` this module stores them."""

import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import pytest
import torch

from analysis.console.overrides import leaves
from analysis.probe.command import run_probe
from analysis.probe.options import ProbeOptions
from analysis.records.json_files import plain
from analysis.records.records import read_record
from splat.scenes.scene import load_scene
from splat.scenes.splits import split_scene
from splat.scenes.synthetic import synthetic_scene
from splat.scenes.write import write_transforms_scene
from splat.training.checkpoint import save_checkpoint
from splat.training.origin.fingerprint import FORMULAS
from splat.training.origin.subject import SceneReference
from splat.training.state import TrainConfig, Training
from tests.analysis.probe.probed import SCENE

STORED = Path(__file__).with_name("formulas.json")
PARTS = ("objective", "traces", "eigenvalues", "anisotropy", "slice", "counts", "steps")
ROUND_OFF = ("residual", "vector_error", "errors", "products", "matvecs", "renders", "evaluations", "crossed_points")
BOUND = 1e-3  # of a number: in double precision the numbers of processors differ by far less


def numbers(folder: Path) -> dict[str, float]:
    """Every number of a quick probe in double precision, near the truth of a scene: no training has to be repeated."""
    made = synthetic_scene(SCENE)
    write_transforms_scene(made.scene, folder / "still")
    scene, path = load_scene(folder / "still"), folder / "double.pt"
    flat = made.truth.flat.double()
    gaussians = made.truth.with_flat(flat + 0.02 * torch.sin(torch.arange(len(flat), dtype=torch.float64)))
    split = split_scene(scene, 3)
    training = Training.start(gaussians, scene.extent(split.train), TrainConfig(sh_degree=gaussians.sh_degree))
    save_checkpoint(path, training, SceneReference.to(scene, path, split, None, 1.0))
    options = ProbeOptions(path, quick=True, slice_points=5, out=folder / "probe")
    assert run_probe(options, drawn=lambda _: []) == 0
    data = plain(read_record(folder / "probe").data)
    return {name: value for name, value in _flat({part: data[part] for part in PARTS}).items() if _counts(name, value)}


def _flat(content: Any) -> dict[str, Any]:
    lists = {"": content} if isinstance(content, list) else leaves(content)
    found = {}
    for name, value in lists.items():
        inner = enumerate(value) if isinstance(value, list) else ()
        found |= {f"{name}.{i}.{key}".strip("."): v for i, each in inner for key, v in _flat({"": each}).items()}
        found |= {} if isinstance(value, list) else {name: value}
    return {name.strip("."): value for name, value in found.items()}


def _counts(name: str, value: Any) -> bool:
    return isinstance(value, int | float) and not name.rstrip(".0123456789").endswith(ROUND_OFF)


def test_a_formula_that_changes_a_number_has_a_version_of_its_own(tmp_path):
    stored = json.loads(STORED.read_text(encoding="utf-8"))
    found, known = numbers(tmp_path), stored["numbers"]
    changed = [name for name in known if found.get(name) != pytest.approx(known[name], rel=BOUND, abs=1e-12)]
    assert found.keys() == known.keys() and not changed, (
        f"{changed[:5]} are other numbers: raise the formula version (FORMULAS in splat/training/origin/fingerprint.py), "
        f"and store the numbers anew: python -m {__name__}"
    )
    assert stored["formulas"] == FORMULAS, "the numbers of this version are not stored: python -m " + __name__


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        content = {"formulas": FORMULAS, "numbers": numbers(Path(folder))}
    STORED.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    sys.exit(0)
