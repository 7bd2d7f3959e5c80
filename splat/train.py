"""Training of 3D Gaussian Splatting (Kerbl et al. 2023): settings, state, and the loop, which reads top to bottom.

One step renders one view, takes the gradient of its photometric loss, lets the method's regularizer change it
(`splat/regularizers`), updates every stored parameter with Adam, and, while density control is under way, clones, splits
and prunes.  Steps are counted from 1.  Views come in epochs, each a new random order.  All randomness is drawn from one
generator, and `Training` holds all that the next step depends on: a training that is saved and loaded
(`splat/checkpoint.py`) continues to the same bits.

    position rate(step) = extent * position^(1 - s) * position_final^s,   s = step / iterations
    SH degree(step)     = min(sh_degree, (step - 1) // sh_degree_every)

The Gaussians hold only the SH bands in use; a band joins as zeros.  That is the same as carrying bands whose gradient
is zero, and spares their cost.

The published code orders a step otherwise, which makes one update more or less here and there:

    update      after density control, whose new tensors have no gradient yet: a step that clones, splits and prunes updates
                nothing (144 of 30,000 steps), one that resets opacities not these.  Here every step updates, and density
                control sees what it led to; its statistics are of the render before, as there
    last step   makes no update there, and here one at the lowest of the position rates
    SH degree   rises before the renders of the steps 1000, 2000, 3000; here before those of 1001, 2001, 3001

An update moves a parameter by about its rate, and from 2,000 steps on a hundred others lie between two that differ.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from math import inf, isfinite

import torch
from jaxtyping import Float
from torch import Tensor

from splat.adam import Adam
from splat.camera import Camera
from splat.curvature import SceneObjective
from splat.densify import Densified, DensifySettings, ScreenGradients, densify, reset_opacities
from splat.gaussians import Gaussians
from splat.loss_functions import loss_against
from splat.losses import LossSettings
from splat.losses_cpu import ViewLoss
from splat.photometric import Photometric, photometric
from splat.regularizers.regularizer import Method, Regularizer, Step, ThreeDGS
from splat.scenes.view import View
from splat.settings import RenderSettings


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
    method: what is added to 3DGS, with its settings (`splat/regularizers/methods.py`).
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


@dataclass(frozen=True)
class StepResult:
    """One step done: its number, the view's loss before the update, how many Gaussians there are after it, the view's name."""

    step: int
    loss: float
    gaussians: int
    view: str


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

    def control_density(self, step: int, camera: Camera, base: Photometric) -> None:
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


def with_background(view: View, old: Float[Tensor, "3"], new: Float[Tensor, "3"]) -> Float[Tensor, "3 h w"]:
    """The view's image, composited over another colour where it is transparent; photographs are opaque."""
    if view.alpha is None:
        return view.image
    return view.image + (1 - view.alpha) * (new - old)[:, None, None]


def train(training: Training, views: Sequence[View]) -> Iterator[StepResult]:
    """Make the steps that are left of config.iterations, one each time the next item is asked for.

    Between two items `training` is whole, so that it can be saved, evaluated or left there.  ValueError where there are no
    views, they lack what the method needs, or a loss or gradient is not finite.
    """
    config, regularizer = training.config, training.regularizer
    if not views:
        raise ValueError("expected at least one view to train on, got none")
    regularizer.begin(training, views)
    losses = [loss_against(view.image, config.loss, training.gaussians.flat) for view in views]
    while training.step < config.iterations:
        number = training.step + 1
        training.raise_sh_degree(min(config.sh_degree, (number - 1) // config.sh_degree_every))
        step = _next_step(training, number, views, losses)
        camera, gaussians = step.camera, training.gaussians
        gain = regularizer.opacity_gain(step)
        base = photometric(gaussians, camera, step.loss, step.background, config.render, gain)
        _require_finite("loss", base.loss, step)
        gradient = regularizer.gradient(step, base)
        _require_finite("gradient", float(gradient.sum()), step)  # before the Gaussians and their moments take it over
        training.descend(gradient, number)
        training.control_density(number, camera, base)
        regularizer.after(step)
        training.step = number
        yield StepResult(number, base.loss, len(training.gaussians), views[step.chosen].name)


def _require_finite(what: str, value: float, step: Step) -> None:
    """ValueError that names the step and its view, unless a loss, or the sum of a gradient, is finite."""
    if not isfinite(value):
        name = step.views[step.chosen].name
        raise ValueError(f"expected a finite {what}, got {value} at step {step.number} on view {name}; lower the rates")


def _next_step(training: Training, number: int, views: Sequence[View], losses: Sequence[ViewLoss]) -> Step:
    """The view of a step and what it is compared with."""
    config, gaussians = training.config, training.gaussians
    chosen = training.next_view(len(views))
    background, loss = config.background_colour(gaussians.flat.dtype), losses[chosen]
    if config.random_background:
        drawn = torch.rand(3, generator=training.generator, dtype=background.dtype)
        target = with_background(views[chosen], background, drawn)
        background, loss = drawn, loss_against(target, config.loss, gaussians.flat)
    return Step(number, training, gaussians, views, chosen, background, loss)
