"""What a method of training adds to plain 3DGS: the interface between the loop (`splat/train.py`) and its regularizers.

The loop asks, in this order, `begin` before the first step and after a resume, and at every step:

    opacity_gain    how the opacities are changed in this step's render (dropout), or None
    gradient        what Adam descends, given the photometric gradient of the sampled view
    follow          ... after density control, or any other change of the Gaussians: which old one each new one comes from
    after           anything else, once the step is whole (unpooling, a second field's own density control)

A regularizer draws from its own generator, so that the same seed shows every method the same views in the same order and
splits the same Gaussians alike.  `state` and `restore` carry it through a checkpoint to the same bits.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from splat.camera import Camera
from splat.densify import Densified
from splat.gaussians import Gaussians
from splat.losses_cpu import ViewLoss
from splat.photometric import Photometric
from splat.plain_types import fits, short
from splat.scenes.view import View

if TYPE_CHECKING:
    from splat.train import TrainConfig, Training

Row = dict[str, Any]


@dataclass(frozen=True, eq=False)
class Step:
    """One step of a training.  number: from 1; chosen: index in `views` of the sampled view.

    gaussians: before the update.  background, loss: this step's colour, and the loss against the sampled view's image on it.
    """

    number: int
    training: "Training"
    gaussians: Gaussians
    views: Sequence[View]
    chosen: int
    background: Float[Tensor, "3"]
    loss: ViewLoss

    @property
    def config(self) -> "TrainConfig":
        return self.training.config

    @property
    def camera(self) -> Camera:
        """The sampled view's."""
        return self.views[self.chosen].camera


class Regularizer:
    """Plain 3DGS: nothing is added.  The base of the methods' own regularizers, which hold what they need between steps.

    generator: of whatever the method draws.  history: rows of what is worth a look afterwards, each with its "step";
    `landscape train` writes them to history.csv.  Both are part of the state.
    """

    def __init__(self, seed: int):
        self.generator = torch.Generator().manual_seed(seed)
        self.history: list[Row] = []

    def begin(self, training: "Training", views: Sequence[View]) -> None:
        """Steps are about to be made on these views; a second call changes nothing.  ValueError where the views lack what the
        method needs."""

    def opacity_gain(self, step: Step) -> Float[Tensor, " n"] | None:
        """Factors on the opacities of this step's render, None for 1."""
        return None

    def gradient(self, step: Step, base: Photometric) -> Float[Tensor, " p"]:
        """What the optimiser descends.  base: the sampled view's loss and gradient, in the parameters of step.gaussians."""
        return base.gradient

    def follow(self, change: Densified) -> None:
        """The Gaussians were replaced."""

    def after(self, step: Step) -> None:
        """The step is whole: update and density control are done."""

    def state(self) -> dict[str, Any]:
        """Tensors, plain types and trainings: `restore` makes a new one of the same settings go on from it to the same bits."""
        return {"generator": self.generator.get_state(), "history": self.history}

    def restore(self, state: dict[str, Any]) -> None:
        """Take over a state.  ValueError, KeyError or RuntimeError where it does not fit."""
        self.generator.set_state(state["generator"])
        if type(state["history"]) is not list:
            raise ValueError(f"expected the history as a list of rows, found {short(state['history'])}")
        for row in state["history"]:
            _require_row(row)
        self.history = list(state["history"])


def _require_row(row: Any) -> None:
    """ValueError unless a row of a history holds plain values, its step and its counts whole numbers of at least 0."""
    plain = fits(row, dict[str, int | float | bool | str]) and "step" in row
    if (
        not plain
        or any(type(row.get(name, 0)) is not int for name in ("step", "count"))
        or any(type(value) is int and value < 0 for value in row.values())
    ):
        raise ValueError(
            "expected a row of the history with plain values, its step and its counts whole numbers of at least 0, "
            f"found {short(row)}"
        )


@dataclass(frozen=True)
class Method:
    """Settings of a method, from which `regularizer(seed)` makes a new regularizer.  name: its key in `methods.METHODS`."""

    name: str = ""

    def regularizer(self, seed: int) -> Regularizer:
        return Regularizer(seed)


@dataclass(frozen=True)
class ThreeDGS(Method):
    """3D Gaussian Splatting as it is (Kerbl et al. 2023)."""

    name: Literal["3dgs"] = "3dgs"
