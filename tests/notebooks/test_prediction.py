"""The trainings of the study of prediction: seven switches, none mixed up with another or with a pair of others."""

from itertools import combinations
from pathlib import Path

import numpy as np

from analysis.console.overrides import assignments, overridden
from analysis.runs.sweep.sweep_file import Cell, read_sweep
from splat.training.methods.stablegs.stablegs import StableGS
from splat.training.state import TrainConfig

FILE = Path(__file__).parents[2] / "notebooks" / "prediction.toml"


def switches(cell: Cell) -> dict[str, bool]:
    """Which are on, by the letters of the file's head; every other setting is its default."""
    usual = TrainConfig(2000, method=StableGS(vsp_weight=0.0))
    config = overridden(usual, assignments(cell.training.set))
    values = {
        "a": (config.densify.gradient_threshold, 1e-4, 4e-4),
        "b": (cell.training.sh_degree, 0, 3),
        "c": (config.method.drop_share, 0.0, 0.2),  # pyright: ignore[reportAttributeAccessIssue]
        "d": (config.method.asp_weight, 0.0, 1.0),  # pyright: ignore[reportAttributeAccessIssue]
        "e": (config.loss.opacity_reg, 0.0, 0.01),
        "f": (config.densify.start, 150, 500),
        "g": (cell.training.start, "triangulated", "dense"),
    }
    assert all(value in (off, on) for value, off, on in values.values())
    assert config.method.vsp_weight == 0  # pyright: ignore[reportAttributeAccessIssue]
    return {letter: value == on for letter, (value, _, on) in values.items()}


def test_its_cells_are_a_fraction_of_resolution_four_for_every_scene_and_seed():
    cells = read_sweep(FILE).cells
    assert len(cells) == 32 * 3 * 6 and {cell.training.save_at_psnr for cell in cells} == {(30, 33, 36)}
    for scene in {cell.scene for cell in cells}:
        found = {cell.method: switches(cell) for cell in cells if (cell.scene, cell.seed) == (scene, 0)}
        assert all(name == "".join(letter for letter, on in each.items() if on) for name, each in found.items())
        signs = np.array([[1 if on else -1 for on in each.values()] for each in found.values()])
        assert len(np.unique(signs, axis=0)) == 32 and not signs.sum(axis=0).any()
        for few in (2, 3):  # two switches, and one and a pair
            assert not any(signs[:, list(chosen)].prod(axis=1).sum() for chosen in combinations(range(7), few))
