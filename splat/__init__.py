"""3D Gaussian Splatting with exact second derivatives: scenes, a renderer, training, and the loss's Hessian.

    Gaussians, Camera           n Gaussians over one flat vector of parameters; a pinhole camera
    View, load_scene            a camera with its picture; a scene of them from a folder of any usual format
    split_scene                 names of training and test views by the protocols of the field
    SyntheticSettings, synthetic_scene    a small scene whose Gaussians are known
    RenderSettings              the thresholds of the renderer
    LossSettings                the loss of an image against its picture
    initial_gaussians           the start of a training, from points or at random
    TrainConfig, Training, train    what a training does; its state; its steps
    METHODS                     what a training adds to 3DGS, by name
    evaluate                    PSNR, SSIM, LPIPS of views
    load_checkpoint             a training, with its scene, from a file
    SceneObjective              the mean loss over views as a function of the Gaussians' parameters
    SceneHessian                its Hessian as an operator for the estimators of `landscape`
    exact_traces                the traces of its blocks

Each name is imported from its module when it is first used.
"""

# ruff: noqa: F401

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from splat.curvature.hessian import SceneHessian
    from splat.curvature.objective import SceneObjective
    from splat.curvature.traces import exact_traces
    from splat.losses.reference import LossSettings
    from splat.model.camera import Camera
    from splat.model.gaussians import Gaussians
    from splat.model.settings import RenderSettings
    from splat.scenes.scene import load_scene
    from splat.scenes.splits import split_scene
    from splat.scenes.synthetic import SyntheticSettings, synthetic_scene
    from splat.scenes.view import View
    from splat.training.checkpoint import load_checkpoint
    from splat.training.loop import train
    from splat.training.methods.methods import METHODS
    from splat.training.score.evaluate import evaluate
    from splat.training.start import initial_gaussians
    from splat.training.state import TrainConfig, Training

_MODULES = {
    "METHODS": "training.methods.methods",
    "Camera": "model.camera",
    "Gaussians": "model.gaussians",
    "LossSettings": "losses.reference",
    "RenderSettings": "model.settings",
    "SceneHessian": "curvature.hessian",
    "SceneObjective": "curvature.objective",
    "SyntheticSettings": "scenes.synthetic",
    "TrainConfig": "training.state",
    "Training": "training.state",
    "View": "scenes.view",
    "evaluate": "training.score.evaluate",
    "exact_traces": "curvature.traces",
    "initial_gaussians": "training.start",
    "load_checkpoint": "training.checkpoint",
    "load_scene": "scenes.scene",
    "split_scene": "scenes.splits",
    "synthetic_scene": "scenes.synthetic",
    "train": "training.loop",
}


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module 'splat' has no attribute {name!r}")
    return getattr(import_module(f"splat.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return [*_MODULES]
