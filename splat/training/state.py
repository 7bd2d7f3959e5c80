"""What a method of training adds to plain 3DGS: the interface between the loop (`splat/training/loop.py`) and its regularizers.

The loop asks, in this order, `begin` before the first step and after a resume, and at every step:

    opacity_scale    how the opacities are changed in this step's render (dropout), or None
    gradient        what Adam descends, given the photometric gradient of the sampled view
    follow          ... after density control, or any other change of the Gaussians: which old one each new one comes from
    after           anything else, once the step is whole (unpooling, a second field's own density control)

A regularizer draws from its own generator, so that the same seed shows every method the same views in the same order and
splits the same Gaussians alike.  `state` and `restore` carry it through a checkpoint to the same bits.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import inf
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from splat.curvature.objective import SceneObjective
from splat.losses.cpu.loss import ViewLoss
from splat.losses.reference import LossSettings
from splat.model.camera import Camera
from splat.model.gaussians import Gaussians
from splat.model.settings import RenderSettings
from splat.render.loss_and_gradient import LossAndGradient
from splat.scenes.view import View
from splat.training.densify import Densified, DensifySettings, ScreenGradients, densify, reset_opacities
from splat.training.optim.adam import Adam
from splat.training.plain_types import fits, short

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

    def opacity_scale(self, step: Step) -> Float[Tensor, " n"] | None:
        """Factors on the opacities of this step's render, None for 1."""
        return None

    def gradient(self, step: Step, base: LossAndGradient) -> Float[Tensor, " p"]:
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


@dataclass(frozen=True)
class LearningRates:
    """Adam's rates of 3DGS, about what a step changes a stored parameter by.

    position, position_final: per unit of the scene's extent, at the first step and at the last.  sh_constant, sh_higher: of the
    SH band of degree 0 and of those above.
    """

    position: float = 1.6e-4
    position_final: float = 1.6e-6
    log_scales: float = 5e-3
    quats: float = 1e-3
    opacity_logits: float = 0.05
    sh_constant: float = 2.5e-3
    sh_higher: float = 2.5e-3 / 20

    def __post_init__(self) -> None:
        if not (0 < self.position < inf and 0 < self.position_final < inf):
            raise ValueError(
                "expected finite position rates above 0 (decay is exponential), got "
                f"{self.position}, {self.position_final}"
            )
        others = self.log_scales, self.quats, self.opacity_logits, self.sh_constant, self.sh_higher
        if not all(0 <= rate < inf for rate in others):
            raise ValueError(f"expected finite learning rates of at least 0, got {self}")


@dataclass(frozen=True)
class TrainConfig:
    """Everything that a training's result depends on beside its start and its views.

    sh_degree: the highest SH degree, 0 to 3; one is added every sh_degree_every steps, from 0.
    background: the colour that the views were composited over, RGB in [0, 1], drawn behind the Gaussians.
    random_background: instead draw a colour each step, under the Gaussians and under views that have an alpha channel.
    method: what is added to 3DGS, with its settings (`splat/training/methods/methods.py`).
    ValueError where a setting is out of its range.
    """

    iterations: int = 2000
    seed: int = 0
    sh_degree: int = 3
    sh_degree_every: int = 1000
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    random_background: bool = False
    loss: LossSettings = field(default_factory=LossSettings)
    rates: LearningRates = field(default_factory=LearningRates)
    densify: DensifySettings = field(default_factory=DensifySettings)
    render: RenderSettings = field(default_factory=RenderSettings)
    method: Method = field(default_factory=ThreeDGS)

    def __post_init__(self) -> None:
        if self.iterations < 1:
            raise ValueError(f"expected at least 1 iteration, got {self.iterations}")
        if not 0 <= self.seed < 2**63:
            raise ValueError(f"expected a seed in [0, 2^63), got {self.seed}")
        if not 0 <= self.sh_degree <= 3:
            raise ValueError(f"expected sh_degree 0, 1, 2 or 3, got {self.sh_degree}")
        if self.sh_degree_every < 1:
            raise ValueError(f"expected sh_degree_every of at least 1, got {self.sh_degree_every}")
        if len(self.background) != 3 or not all(0 <= value <= 1 for value in self.background):
            raise ValueError(f"expected a background of three numbers in [0, 1], got {self.background}")

    @property
    def is_white(self) -> bool:
        """Whether every step is on a white background."""
        return self.background == (1.0, 1.0, 1.0) and not self.random_background

    def background_colour(self, dtype: torch.dtype) -> Float[Tensor, "3"]:
        return torch.tensor(self.background, dtype=dtype)

    def objective(self, gaussians: Gaussians, views: Sequence[View], *, keep_unseen: bool = False) -> SceneObjective:
        """This loss, on this background, averaged over views: the objective whose Hessian is studied.  See `SceneObjective`."""
        background = self.background_colour(gaussians.flat.dtype)
        return SceneObjective(gaussians, views, self.loss, background, self.render, keep_unseen=keep_unseen)


@dataclass(eq=False)
class Training:
    """A training under way: all that its next step depends on.

    extent: radius of the training cameras, world units (`splat/scenes/scene.py`).  step: steps made so far.
    order: indices of the epoch's views still to come, last first.
    """

    config: TrainConfig
    extent: float
    gaussians: Gaussians
    adam: Adam
    screen_gradients: ScreenGradients
    generator: torch.Generator
    regularizer: Regularizer
    order: list[int] = field(default_factory=list)
    step: int = 0

    @classmethod
    def start(cls, gaussians: Gaussians, extent: float, config: TrainConfig) -> "Training":
        """A training before its first step.  The Gaussians are copied; extent: world units, as of `Scene.extent`.

        ValueError where there are no Gaussians, one is not finite, or their SH degree is above the training's.
        """
        if len(gaussians) == 0:
            raise ValueError("expected at least one Gaussian to start from, got none; use a random start")
        if gaussians.sh_degree > config.sh_degree:
            raise ValueError(
                f"expected a start of at most the training's SH degree {config.sh_degree}, got {gaussians.sh_degree}; "
                "drop bands with Gaussians.select or raise sh_degree"
            )
        if not 0 < extent < float("inf"):
            raise ValueError(f"expected a finite extent above 0, got {extent}")
        gaussians.require_finite()
        flat = gaussians.flat.detach().clone()
        return cls(
            config=config,
            extent=extent,
            gaussians=gaussians.with_flat(flat),
            adam=Adam.zero(gaussians),
            screen_gradients=ScreenGradients.zero(len(gaussians), flat.dtype, flat.device),
            generator=torch.Generator().manual_seed(config.seed),
            regularizer=config.method.regularizer(config.seed),
        )

    def move(self, device: torch.device) -> None:
        """Continue on another device; the generator stays on the CPU, so that it draws the same numbers everywhere."""
        gradients = self.screen_gradients
        self.gaussians = self.gaussians.with_flat(self.gaussians.flat.to(device))
        self.adam.first, self.adam.second = (
            moment.with_flat(moment.flat.to(device)) for moment in (self.adam.first, self.adam.second)
        )
        self.screen_gradients = ScreenGradients(gradients.total.to(device), gradients.renders.to(device))

    def next_view(self, count: int) -> int:
        """Index of the next view; every view once before any again."""
        if not self.order:
            self.order = torch.randperm(count, generator=self.generator).tolist()
        return self.order.pop()

    def descend(self, gradient: Float[Tensor, " p"], step: int) -> None:
        """Update every parameter with Adam in place, at the rates of this step (counted from 1)."""
        self.adam.update(self.gaussians.flat, gradient, self.rates(step))

    def rates(self, step: int) -> Float[Tensor, " p"]:
        """The learning rate of every parameter at a step."""
        position = position_rate(self.config.rates, self.extent, step, self.config.iterations)
        return learning_rates(self.gaussians, self.config.rates, position)

    def control_density(self, step: int, camera: Camera, base: LossAndGradient) -> None:
        """Collect the screen-space gradient of a render; clone, split, prune and reset opacities in the steps that do so."""
        schedule, iterations = self.config.densify, self.config.iterations
        if schedule.collects(step, iterations):
            self.screen_gradients.add(base.screen_gradient, base.splats, camera)
        if schedule.densifies(step, iterations):
            gradients, large = self.screen_gradients.mean, schedule.prunes_large(step)
            self.follow(densify(self.gaussians, gradients, self.extent, schedule, self.generator, prune_large=large))
        if schedule.resets_opacity(step, iterations, white=self.config.is_white):
            reset_opacities(self.gaussians, schedule.reset_opacity)
            self.adam.forget("opacity_logits")

    def follow(self, change: Densified) -> None:
        """Replace the Gaussians: Adam's moments follow each one that is kept and are 0 for new ones."""
        if not len(change.gaussians):
            raise ValueError(f"every Gaussian became transparent or too large by step {self.step + 1}; lower the rates")
        self.gaussians = change.gaussians
        self.adam.select(change.parents, change.fresh)
        flat = change.gaussians.flat
        self.screen_gradients = ScreenGradients.zero(len(change.gaussians), flat.dtype, flat.device)
        self.regularizer.follow(change)

    def raise_sh_degree(self, degree: int) -> None:
        """Add bands of zeros up to this degree."""
        if degree > self.gaussians.sh_degree:
            everyone = torch.arange(len(self.gaussians))
            self.gaussians = self.gaussians.select(everyone, degree)
            self.adam.select(everyone, sh_degree=degree)


def position_rate(rates: LearningRates, extent: float, step: int, iterations: int) -> float:
    """Position learning rate at a step, world units."""
    s = step / iterations
    return extent * rates.position ** (1 - s) * rates.position_final**s


def learning_rates(gaussians: Gaussians, rates: LearningRates, position: float) -> Float[Tensor, " p"]:
    """The rate of every stored parameter."""
    result = gaussians.with_flat(torch.empty_like(gaussians.flat))
    each = result.attributes
    each["means"].fill_(position)
    each["log_scales"].fill_(rates.log_scales)
    each["quats"].fill_(rates.quats)
    each["opacity_logits"].fill_(rates.opacity_logits)
    each["sh"][:, :1] = rates.sh_constant
    each["sh"][:, 1:] = rates.sh_higher
    return result.flat
