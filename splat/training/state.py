"""Settings and state of a training of 3D Gaussian Splatting, and the interface of the methods that add to it.

TrainConfig, MethodSettings    plain values; with the start and the views they determine the result
Training, Method               the state that changes from step to step; `Method` has the method's part of it
Step                           one step: its number, its view, its loss

The loop (`splat/training/loop.py`) makes the steps; a checkpoint (`splat/training/checkpoint.py`) contains config and state.
Steps count from 1.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Annotated, Any, ClassVar, Generic, Literal, TypeVar

import torch
from jaxtyping import Float
from msgspec import Meta
from torch import Tensor

from landscape.errors import InputError
from landscape.results import ShortRepr
from splat.backend.memory import free_memory
from splat.curvature.objective import SceneObjective
from splat.losses.autograd import Clamped
from splat.losses.protocols import ViewLoss
from splat.losses.reference import LossSettings
from splat.losses.regularizers import Regularizers
from splat.model.camera import Camera
from splat.model.gaussians import Gaussians
from splat.model.settings import RenderSettings
from splat.model.typed import MOST, Count, Length, NonNegative, Positive, Settings, Share, typed
from splat.projection.antialias import sampling_widths
from splat.render.backend import backend_of
from splat.render.loss_and_gradient import LossAndGradient, loss_and_gradient
from splat.scenes.view import View
from splat.training.adam import Adam
from splat.training.densify import Densified, DensifySettings, ScreenGradients, densify, reset_opacities

FILTER_EVERY = 100  # steps
LOSS_PLANES = 9  # planes that a loss keeps: of a target and its moments
LOSSES = 0.25  # share of the free memory that losses may take
Protocol = Literal["common", "llff"]
Row = dict[str, Count | float | bool | str]  # of `Method.history`


@dataclass(frozen=True, eq=False)
class Step:
    """One step of a training.

    number: from 1.  gaussians: before the update.  chosen: index in `views` of the sampled view.  background: RGB.  loss_of:
    the loss against the image of a view, by its index, on that background.
    """

    number: int
    training: "Training"
    gaussians: Gaussians
    views: Sequence[View]
    chosen: int
    background: Float[Tensor, "3"]
    loss_of: Callable[[int], ViewLoss | Clamped]

    @property
    def config(self) -> "TrainConfig":
        return self.training.config

    def loss_and_gradient(
        self, gaussians: Gaussians, opacity_scale: Float[Tensor, " n"] | None = None
    ) -> LossAndGradient:
        """`of_view` of the sampled view."""
        return self.of_view(self.chosen, gaussians, opacity_scale)

    def of_view(
        self, index: int, gaussians: Gaussians, opacity_scale: Float[Tensor, " n"] | None = None
    ) -> LossAndGradient:
        """Loss and gradient of a view, with the regularisers, at these Gaussians.  opacity_scale: see `render`."""
        camera, loss = self.views[index].camera, self.loss_of(index)
        found = loss_and_gradient(gaussians, camera, loss, self.background, self.config.render, opacity_scale)
        regularizers = Regularizers(gaussians, self.config.loss, len(gaussians))
        return replace(found, loss=found.loss + regularizers.value, gradient=regularizers.add_gradient(found.gradient))

    @property
    def camera(self) -> Camera:
        """The sampled view's."""
        return self.views[self.chosen].camera


@dataclass(frozen=True)
class MethodSettings(Settings):
    """Settings of a method; `create` makes a `Method` from them.  name: its key in `methods.METHODS`.

    ITERATIONS: default number of steps.
    """

    name: str = ""
    ITERATIONS: ClassVar[int] = 2000

    def create(self, seed: int) -> "Method":
        """The method before its first step."""
        return Method(self, seed)

    def parts(self, config: "TrainConfig") -> dict[str, int]:
        """Number of steps before each part of the method begins, by the part's setting; without parts that are off."""
        return {self.name: 0}

    def density_control(self, config: "TrainConfig") -> DensifySettings:
        """Settings for cloning, splitting and removing Gaussians."""
        return config.densify

    def scaled(self, config: "TrainConfig", keep: Collection[str] = ()) -> "TrainConfig":
        """The training with the method's published schedule scaled to its length.  keep: dotted names that stay as they are."""
        return config


S = TypeVar("S", bound=MethodSettings)


class Method(Generic[S]):
    """Additions of a method to 3DGS, and its state between steps.  This base class adds nothing: it is 3DGS.

    hook            runs                                      arguments          result
    on_start        before the first step, after a resume     training, views    InputError where views lack what it needs
    own_step        in place of all up to after_step          step               the loss before it; None: do a step of 3DGS
    opacity_scale   before the sampled view is rendered       step               (n,) factors on the opacities, or None
    gradient        after its backward pass, before Adam      step, base         loss and gradient to go on with
    on_densify      after each change of the Gaussians        change             which old one each new one comes from
    after_step      after Adam and density control            step

    The hook `gradient` returns a loss with two gradients: Adam descends its `gradient`, density control averages its
    `screen_gradient`.

    generator: for all random numbers of the method.  It is not the training's, so that with the same seed every method sees the
    same views in the same order and splits the same Gaussians alike.  history: rows, each with its "step", which
    `landscape train` writes to history.csv.  Both are in `state`; after `restore` a training continues to the same bits.
    """

    def __init__(self, settings: S, seed: int):
        self.settings = settings
        self.generator = torch.Generator().manual_seed(seed)
        self.history: list[dict[str, Any]] = []

    def on_start(self, training: "Training", views: Sequence[View]) -> None:
        """Prepare; a second call must change nothing."""

    def own_step(self, step: Step) -> float | None:
        """Change step.training.gaussians, in place, without the sampled view, Adam and density control."""
        return None

    def opacity_scale(self, step: Step) -> Float[Tensor, " n"] | None:
        return None

    def gradient(self, step: Step, base: LossAndGradient) -> LossAndGradient:
        """base: the sampled view's, in the parameters of step.gaussians."""
        return base

    def on_densify(self, change: Densified) -> None: ...

    def after_step(self, step: Step) -> None: ...

    def state(self) -> dict[str, Any]:
        """What `restore` takes, by name: tensors, plain values and trainings."""
        return {"generator": self.generator.get_state(), "history": self.history}

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from a state.  ValueError, KeyError, TypeError or RuntimeError where it is not one of this method."""
        self.generator.set_state(state["generator"])
        self.history = typed(list[Row], state["history"], "history")
        if not all(type(row.get("step")) is int and type(row.get("count", 0)) is int for row in self.history):
            raise InputError("'history': expected a step, and counts, that are whole numbers in every row")


@dataclass(frozen=True)
class ThreeDGS(MethodSettings):
    """3D Gaussian Splatting (Kerbl et al. 2023) without additions."""

    name: Literal["3dgs"] = "3dgs"


@dataclass(frozen=True)
class LearningRates(Settings):
    """Learning rates of Adam in 3DGS: about the change of a stored parameter in a step.

    position, position_final: per unit of the scene's extent, at the first step and at the last.  position_hold: steps before
    the rate begins to fall.  sh_constant, sh_higher: for the SH band of degree 0 and for those above.
    """

    position: Positive = 1.6e-4
    position_final: Positive = 1.6e-6
    position_hold: Count = 0
    log_scales: NonNegative = 5e-3
    quats: NonNegative = 1e-3
    opacity_logits: NonNegative = 0.05
    sh_constant: NonNegative = 2.5e-3
    sh_higher: NonNegative = 2.5e-3 / 20


@dataclass(frozen=True)
class TrainConfig(Settings):
    """Everything that a training's result depends on beside its start and its views.

    sh_degree: the highest SH degree, 0 to 3; training begins with 0 and adds one every sh_degree_every steps.
    background: the colour that the views were composited over, RGB in [0, 1]; it is drawn behind the Gaussians.
    random_background: draw another colour each step, behind the Gaussians and behind views that have an alpha channel.
    clamp_image: clamp the image to [0, 1] in the loss of a step; the objective whose Hessian is studied never clamps.
    protocol: name of the training protocol, which has set the other settings: common to all methods, or a published one
        (`methods/protocols.csv`).
    method: what is added to 3DGS, with its settings (`splat/training/methods/methods.py`).
    InputError where a setting is out of its range.

    >>> from splat import METHODS
    >>> TrainConfig(iterations=300, method=METHODS["stablegs"](warm_up=100)).method.name
    'stablegs'
    """

    iterations: Length = 2000
    seed: Count = 0
    sh_degree: Annotated[int, Meta(ge=0, le=3)] = 3
    sh_degree_every: Length = 1000
    background: tuple[Share, Share, Share] = (0.0, 0.0, 0.0)
    random_background: bool = False
    clamp_image: bool = False
    protocol: Protocol = "common"
    loss: LossSettings = field(default_factory=LossSettings)
    rates: LearningRates = field(default_factory=LearningRates)
    densify: DensifySettings = field(default_factory=DensifySettings)
    render: RenderSettings = field(default_factory=RenderSettings)
    method: MethodSettings = field(default_factory=ThreeDGS)

    @property
    def is_white(self) -> bool:
        """Whether every step is on a white background."""
        return self.background == (1.0, 1.0, 1.0) and not self.random_background

    def background_colour(self, dtype: torch.dtype) -> Float[Tensor, "3"]:
        return torch.tensor(self.background, dtype=dtype)

    def loss_against(self, image: Float[Tensor, "3 h w"], like: Tensor) -> ViewLoss | Clamped:
        """The loss of a step against a view's image; like: see `splat.losses.autograd.loss_against`."""
        loss = backend_of(like).view_loss(image, self.loss, like)
        return Clamped(loss) if self.clamp_image else loss

    def losses_against(self, views: Sequence[View], like: Tensor) -> Callable[[int], ViewLoss | Clamped]:
        """A function from a view's index to `loss_against` its image; it caches as many losses as LOSSES allows."""
        each = LOSS_PLANES * like.element_size() * max(view.camera.width * view.camera.height for view in views)
        most = max(1, int(LOSSES * free_memory(like.device)) // each)
        return lru_cache(min(most, len(views)))(lambda index: self.loss_against(views[index].image, like))

    def objective(self, gaussians: Gaussians, views: Sequence[View], *, keep_unseen: bool = False) -> SceneObjective:
        """This loss, on this background, averaged over views: the objective whose Hessian is studied.  See `SceneObjective`."""
        background = self.background_colour(gaussians.flat.dtype)
        return SceneObjective(gaussians, views, self.loss, background, self.render, keep_unseen=keep_unseen)


@dataclass(eq=False, repr=False)
class Training(ShortRepr):
    """State of a training: all that its next step depends on.

    extent: radius of the training cameras, world units (`splat/scenes/scene.py`).  step: steps made so far.
    order: indices of the views still to come in this epoch, last first.

    >>> from splat import Gaussians
    >>> Training.start(Gaussians(torch.ones(14), sh_degree=0), extent=1.0, config=TrainConfig()).step
    0
    """

    config: TrainConfig
    extent: float
    gaussians: Gaussians
    adam: Adam
    screen_gradients: ScreenGradients
    generator: torch.Generator
    method: Method
    order: list[int] = field(default_factory=list)
    step: int = 0
    _rates: tuple[tuple, Tensor] | None = field(default=None, init=False, repr=False)  # of `rates`

    @classmethod
    def start(cls, gaussians: Gaussians, extent: float, config: TrainConfig) -> "Training":
        """A training before its first step.  gaussians: copied; extent: world units, see `Scene.extent`.

        InputError where there are no Gaussians, one is not finite, their SH degree is above the training's, or extent is not
        positive and finite.
        """
        if len(gaussians) == 0:
            raise InputError("expected at least one Gaussian to start from, got none; use a random start")
        if gaussians.sh_degree > config.sh_degree:
            raise InputError(
                f"expected a start of at most the training's SH degree {config.sh_degree}, got {gaussians.sh_degree}; "
                "drop bands with Gaussians.select or raise sh_degree"
            )
        if not 0 < extent <= MOST:
            raise InputError(f"expected an extent above 0 and of at most {MOST:g}, got {extent}")
        gaussians.require_finite()
        flat = gaussians.flat.detach().clone()
        return cls(
            config=config,
            extent=extent,
            gaussians=gaussians.with_flat(flat),
            adam=Adam.zero(gaussians),
            screen_gradients=ScreenGradients.zero(len(gaussians), flat.dtype, flat.device),
            generator=torch.Generator().manual_seed(config.seed),
            method=config.method.create(config.seed),
        )

    def move(self, device: torch.device) -> None:
        """Continue on another device; the generator stays on the CPU, so that it draws the same numbers everywhere."""
        gradients, adam = self.screen_gradients, self.adam
        self.gaussians, adam.first, adam.second = (
            each.with_flat(each.flat.to(device)) for each in (self.gaussians, adam.first, adam.second)
        )
        self.screen_gradients = ScreenGradients(gradients.total.to(device), gradients.renders.to(device))

    def next_view(self, count: int) -> int:
        """Index of the next of `count` views; each comes once per epoch, in random order."""
        if not self.order:
            self.order = torch.randperm(count, generator=self.generator).tolist()
        return self.order.pop()

    def descend(self, gradient: Float[Tensor, " p"], step: int) -> None:
        """Update every parameter in place with Adam, at the rates of this step."""
        self.adam.update(self.gaussians.flat, gradient, self.rates(step))

    def rates(self, step: int) -> Float[Tensor, " p"]:
        """The learning rate of every parameter at a step, in a vector that the next call may write to."""
        gaussians, rates = self.gaussians, self.config.rates
        position = position_rate(rates, self.extent, step, self.config.iterations)
        what = len(gaussians), gaussians.sh_degree, rates, gaussians.flat.device
        if self._rates is None or self._rates[0] != what:
            self._rates = what, learning_rates(gaussians, rates, position)
        self._rates[1][gaussians.blocks["means"]] = position
        return self._rates[1]

    def control_density(self, step: int, camera: Camera, base: LossAndGradient) -> None:
        """Collect the screen-space gradient of a render; clone, split, prune and reset opacities in the steps for it."""
        schedule, iterations = self.config.method.density_control(self.config), self.config.iterations
        if schedule.collects(step, iterations):
            self.screen_gradients.add(base.screen_gradient, base.splats, camera)
        if schedule.densifies(step, iterations):
            gradients, large = self.screen_gradients.mean, schedule.prunes_large(step)
            self.gaussians.require_finite()
            self.replace_gaussians(
                densify(self.gaussians, gradients, self.extent, schedule, self.generator, prune_large=large)
            )
        if schedule.resets_opacity(step, iterations, white=self.config.is_white):
            assert schedule.reset_opacity is not None
            reset_opacities(self.gaussians, schedule.reset_opacity)
            self.adam.forget("opacity_logits")

    def replace_gaussians(self, change: Densified) -> None:
        """Continue with the Gaussians of a change; Adam's moments are kept with kept Gaussians, and 0 for new ones."""
        if not len(change.gaussians):
            raise InputError(f"every Gaussian became transparent or too large by step {self.step + 1}; lower the rates")
        change.gaussians.require_finite()
        self.gaussians = change.gaussians
        self.adam.select(change.parents, change.fresh)
        flat = change.gaussians.flat
        self.screen_gradients = ScreenGradients.zero(len(change.gaussians), flat.dtype, flat.device)
        self.method.on_densify(change)

    def update_filter(self, step: int, cameras: Sequence[Camera]) -> None:
        """Compute the 3-D filter of Mip-Splatting after a step, where the render settings have it.

        As in its published code: at the start, whenever density control has changed the Gaussians, and after density control
        every FILTER_EVERY steps, but not in the last FILTER_EVERY.
        """
        config = self.config
        if config.render.antialias != "mip-splatting":
            return
        schedule, iterations = config.method.density_control(config), config.iterations
        settled = not schedule.collects(step, iterations) and step < iterations - FILTER_EVERY
        due = schedule.densifies(step, iterations) or (settled and step > 0 and step % FILTER_EVERY == 0)
        if due or self.gaussians.filter_widths is None:
            self.gaussians = self.gaussians.with_filter(sampling_widths(self.gaussians, cameras))

    def raise_sh_degree(self, degree: int) -> None:
        """Add bands of zeros up to this degree."""
        if degree > self.gaussians.sh_degree:
            everyone = torch.arange(len(self.gaussians))
            self.gaussians = self.gaussians.select(everyone, degree)
            self.adam.select(everyone, sh_degree=degree)


def position_rate(rates: LearningRates, extent: float, step: int, iterations: int) -> float:
    """Position learning rate at a step, world units."""
    s = max(0, step - rates.position_hold) / max(1, iterations - rates.position_hold)
    return extent * rates.position ** (1 - s) * rates.position_final**s


def learning_rates(gaussians: Gaussians, rates: LearningRates, position: float) -> Float[Tensor, " p"]:
    """The rate of every stored parameter."""
    result = gaussians.with_flat(torch.empty_like(gaussians.flat))
    each = result.attributes
    each["means"].fill_(position)
    each["log_scales"].fill_(rates.log_scales)
    each["quats"].fill_(rates.quats)
    each["opacity_logits"].fill_(rates.opacity_logits)
    each["sh"].fill_(rates.sh_higher)  # at once, which is faster than all bands but one
    each["sh"][:, 0] = rates.sh_constant
    return result.flat
