"""`landscape bench stress`: round-off of single precision at the limits of the renderer, on scenes of a few pixels.

OUT/stress.csv   a line for each case: relative errors of float32 against float64, in the 2-norm

    image, gradient, H v, Gauss-Newton v    with SSIM, v random signs
    traces                                  of the pixel loss alone, where they are exact
    lambda max, lambda min                  over the larger end, by Lanczos to RTOL; of small scenes

Every parameter is a float32 number stored in float64, so that both precisions start at the same point.  A scene is drawn again,
with the next seed, until no pixel lies within MARGIN of alpha_min or transmittance_min: both precisions then make the same
decisions, and differ by round-off alone.  That every error is within the bound of its condition is held by the tests.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from math import isnan, log
from pathlib import Path

import pandas as pd
import torch
from jaxtyping import Float
from rich.console import Console
from rich.progress import track
from torch import Tensor

from analysis.bench.tables import rich_table, write_table
from analysis.console.plain import say
from landscape.eigen.eigen import EigenSettings, extreme_eigenpairs
from landscape.errors import InputError
from splat.curvature.hessian import SceneHessian
from splat.curvature.objective import SceneObjective
from splat.curvature.traces import exact_traces
from splat.losses.reference import LossSettings
from splat.model.camera import Camera
from splat.model.gaussians import Gaussians
from splat.model.settings import RenderSettings
from splat.projection.reference import project
from splat.render.reference import rasterize_reference
from splat.render.render import render
from splat.scenes.view import View

# L2: in autograd's derivative of the others, the truth of the tests, terms of 1 / eps^2 cancel
WITH_SSIM, PIXELS_ALONE = LossSettings("l2"), LossSettings("l2", ssim_weight=0.0)
SEED, RTOL = 0, 1e-4
SINGLE, DOUBLE = torch.float32, torch.float64
WIDTH, HEIGHT = 24, 16
CENTRE = (0.1, 0.05, -0.1)
BACKGROUND = torch.tensor([0.2, 0.5, 0.875], dtype=torch.float64)
MARGIN = 1e-4  # relative; ln alpha is wrong by at most about 1e-5 in float32, for needles
ATTEMPTS = 50
Change = Callable[[dict[str, Tensor]], object]


@dataclass(frozen=True, eq=False)
class Case:
    """A scene with one view.  gaussians: in float64; target: the photograph.

    dense: whether it is small enough for a dense Hessian.
    """

    name: str
    gaussians: Gaussians
    camera: Camera
    settings: RenderSettings
    target: Float[Tensor, "3 h w"]
    dense: bool = True


def camera_of(width: int = WIDTH, height: int = HEIGHT, unit: float = 1.0, focal: float = 24.0) -> Camera:
    centre = torch.tensor(CENTRE, dtype=torch.float64) * unit
    return Camera(torch.eye(3).double(), centre, focal, 0.9 * focal, width / 2 + 0.3, height / 2 - 0.2, width, height)


def gaussians_of(n: int, generator: torch.Generator, change: Change = lambda _: None, unit: float = 1.0) -> Gaussians:
    """n Gaussians in front of `camera_of`, SH degree 1 (0 for a crowd); change: alters the attributes in place."""

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    quats = normal(n, 4)
    attributes = {
        "means": (0.4 * normal(n, 3) + torch.tensor([0.0, 0.0, 4.0])) * unit,
        "log_scales": 0.4 * normal(n, 3) - 1.5 + log(unit),
        "quats": quats / quats.norm(dim=1, keepdim=True),
        "opacity_logits": normal(n),
        "sh": 0.4 * normal(n, 4 if n < 100 else 1, 3),
    }
    change(attributes)
    return Gaussians.pack(attributes).to(torch.float32).to(torch.float64)


def steady(gaussians: Gaussians, camera: Camera, settings: RenderSettings) -> bool:
    """Whether every threshold decides alike when it is moved by MARGIN either way."""

    def image(factor: float) -> Tensor:
        moved = replace(
            settings, alpha_min=settings.alpha_min * factor, transmittance_min=settings.transmittance_min * factor
        )
        splats = project(gaussians, camera, settings)
        size = (camera.width, camera.height)
        return rasterize_reference(splats, BACKGROUND, *size, moved, tile=max(size))[0]

    return torch.equal(image(1 - MARGIN), image(1 + MARGIN))


def set_rows(name: str, value: object, rows: slice | int | tuple[slice | int, int] = slice(None)) -> Change:
    """attributes[name][rows] = value."""

    def change(attributes: dict[str, Tensor]) -> None:
        attributes[name][rows] = torch.as_tensor(value, dtype=torch.float64)

    return change


def duplicate(attributes: dict[str, Tensor]) -> None:
    for value in attributes.values():
        value[1:] = value[0].clone()


def _case(
    name: str, seed: int, change: Change = lambda _: None, *, n: int = 3, camera: Camera | None = None, unit: float = 1.0,
    target: float | None = None, settings: RenderSettings | None = None,
) -> Case:  # fmt: skip
    camera = camera or camera_of(unit=unit)
    settings = settings or RenderSettings(near=0.2 * unit)
    for attempt in range(ATTEMPTS):
        generator = torch.Generator().manual_seed(seed * ATTEMPTS + attempt)
        gaussians = gaussians_of(n, generator, change, unit)
        if steady(gaussians, camera, settings):
            break
    else:
        raise InputError(f"expected a scene without a pixel at a threshold for {name!r}, got none in {ATTEMPTS} seeds")
    size = (3, camera.height, camera.width)
    picture = torch.rand(size, generator=generator) if target is None else torch.full(size, target)
    return Case(name, gaussians, camera, settings, picture, dense=n < 100 and camera.width * camera.height < 1000)


def cases(seed: int) -> Iterator[Case]:
    """Every scene whose derivatives must be right."""
    yield _case("one Gaussian", seed, n=1)
    yield _case("the same depth", seed, set_rows("means", 4.0, (slice(None), 2)))
    crowd = camera_of(8, 6, focal=8.0)
    yield _case("2,000 at the same depth", seed, set_rows("means", 4.0, (slice(None), 2)), n=2000, camera=crowd)
    yield _case("exact duplicates", seed, duplicate)
    yield _case("needles, aspect 1e6", seed, set_rows("log_scales", [3.0, -10.8, -10.8]))
    yield _case("pancakes, aspect 1e6", seed, set_rows("log_scales", [3.0, 3.0, -10.8]))
    yield _case("one fills the image", seed, set_rows("log_scales", 5.0, 0))
    yield _case("across the near plane", seed, set_rows("means", [[0, 0, 0.101], [0, 0, 0.3], [0, 0, 0.099]]))
    yield _case("opacity logits of 50", seed, set_rows("opacity_logits", 50.0))
    yield _case("an opacity logit of -50", seed, set_rows("opacity_logits", -50.0, 0))
    yield _case("log-scales of 20", seed, set_rows("log_scales", 20.0, 0))
    yield _case("log-scales of -20", seed, set_rows("log_scales", -20.0, 0))
    yield _case("one log-scale of 20", seed, set_rows("log_scales", 20.0, (0, 1)))
    yield _case("quaternions of length 1e6", seed, lambda each: each["quats"].mul_(1e6))
    yield _case("quaternions of length 1e-6", seed, lambda each: each["quats"].mul_(1e-6))
    yield _case("world units of 1e-6", seed, unit=1e-6)
    yield _case("world units of 1e6", seed, unit=1e6)
    yield _case("nearly transparent", seed, set_rows("opacity_logits", -5.0))
    yield _case("no thresholds", seed, settings=RenderSettings(alpha_min=0.0, transmittance_min=0.0))
    yield _case("one pixel", seed, camera=camera_of(1, 1))
    yield _case("1 x 10,000 pixels", seed, camera=camera_of(10_000, 1, focal=5000.0))
    yield _case("10,000 x 1 pixels", seed, camera=camera_of(1, 10_000, focal=5000.0))
    yield _case("a grey target", seed, target=0.5)
    yield _case("a black target", seed, target=0.0)
    fitted = _case("zero residual everywhere", seed)
    rendered = render(fitted.gaussians, fitted.camera, BACKGROUND, fitted.settings, backend="reference")
    yield replace(fitted, target=rendered.image.float())


def objective_of(case: Case, loss: LossSettings, dtype: torch.dtype) -> SceneObjective:
    view = View(case.name, case.camera, case.target.to(dtype))
    return SceneObjective(case.gaussians.to(dtype), [view], loss, BACKGROUND, case.settings)


def numbers_of(case: Case, dtype: torch.dtype) -> dict[str, Tensor]:
    """The quantities of a case in one precision, in float64."""
    smooth, pixels = (objective_of(case, loss, dtype) for loss in (WITH_SSIM, PIXELS_ALONE))
    generator = torch.Generator().manual_seed(SEED)
    v = (torch.randint(0, 2, (smooth.active.flat.numel(), 1), generator=generator) * 2 - 1).to(dtype)
    H = SceneHessian(smooth, keep_null=True)
    found = {
        "image": next(iter(smooth.linearized)).image,
        "gradient": smooth.gradient,
        "H v": H.apply(v),
        "Gauss-Newton v": SceneHessian(smooth, gauss_newton=True, keep_null=True).apply(v),
        "traces": torch.tensor([trace.value for trace in exact_traces(pixels, generator).values()]),
    }
    if case.dense:
        active = SceneHessian(smooth)
        ends = extreme_eigenpairs(active, generator, EigenSettings(rtol=RTOL, max_matvecs=2 * active.dim))
        found |= {"lambda max": ends.largest.values[:1], "lambda min": ends.smallest.values[:1]}
    return {name: value.double() for name, value in found.items()}


def compared(case: Case) -> dict[str, float]:
    """Relative errors of single precision; of the ends over the larger one."""
    rough, exact = numbers_of(case, SINGLE), numbers_of(case, DOUBLE)
    sizes = {name: float(value.norm()) for name, value in exact.items()}
    ends = [name for name in ("lambda max", "lambda min") if name in sizes]
    sizes |= dict.fromkeys(ends, max((sizes[name] for name in ends), default=0.0))
    off = {name: float((rough[name] - value).norm()) for name, value in exact.items()}
    return {name: off[name] / size if size else off[name] for name, size in sizes.items()}


def run_stress(out: Path) -> int:
    """Compare every case, print and write the table; 1 where something is not a number, else 0."""
    console, todo = Console(), list(cases(SEED))
    shown = track(todo, "stress (first compiling)", console=Console(stderr=True), transient=True)
    errors = {case.name: compared(case) for case in shown}
    table = pd.DataFrame.from_dict(errors, orient="index").rename_axis("case").reset_index()
    console.print(rich_table(table, "float32 against float64: relative errors"))
    missed = [name for name, found in errors.items() if any(isnan(error) for error in found.values())]
    say(*(f"expected numbers, got NaN in {name}" for name in missed), console=console)
    out.mkdir(parents=True, exist_ok=True)
    write_table(table, out / "stress.csv", console)
    return 1 if missed else 0
