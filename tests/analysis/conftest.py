"""A scene that several folders train on."""

from pathlib import Path

import pytest

from splat.scenes.synthetic import SyntheticSettings, synthetic_scene
from splat.scenes.write import write_transforms_scene


@pytest.fixture(scope="session")
def original(tmp_path_factory) -> Path:
    """A scene of five views of 24 x 18 px, which tests leave as it is."""
    folder = tmp_path_factory.mktemp("scenes") / "still"
    write_transforms_scene(synthetic_scene(SyntheticSettings(gaussians=60, views=5, width=24, height=18)).scene, folder)
    return folder
