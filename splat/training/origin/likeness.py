"""The guard of other tools' files: Gaussians must look like the photographs of their scene, in the reading that was taken.

Reading     Gaussians as their file may have meant them, in a world that they may be in
allowed     what the format and the preset leave open: the four worlds of gsplat, the axes of an .spz
mistaken    what writers of such files have got wrong, and the worlds of other presets

A right file was trained to look like these photographs: every other reading looks worse.  Seen on two views of the twelve
public scenes (3 or 8 training views, 1,000 steps, in part also 20, 100, 300): mistaken readings of right files gain nothing on
training views and at most 0.24 dB on others; after 1,000 steps right readings of mistaken files gain 0.52 to 28 dB, but for the
order of colours in a grey scene.
"""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain
from math import inf, isfinite, isnan
from operator import itemgetter
from pathlib import Path
from statistics import fmean

import torch

from landscape.errors import InputError
from splat.model.files.quantised import turned
from splat.model.files.splat_file import logit
from splat.model.gaussians import Gaussians
from splat.model.harmonics import Y00
from splat.render.render import render
from splat.scenes.images import resize_by_area
from splat.scenes.scene import Scene
from splat.scenes.view import View
from splat.scenes.write import bytes_of, png
from splat.training.origin.frames import Similarity, posed
from splat.training.state import TrainConfig

LEAST_PSNR = 15.0  # dB; scenes that are trained at all have more on their training views
# dB above pictures of one colour, which have 9.5 to 19.5 in twelve public scenes: half of their error is gone
MARGIN = 3.0
CLEARLY = 0.5  # dB
SMALL = 256  # px; the shorter side of the pictures on which readings are compared, which takes little time
INVERSE = torch.tensor([1.0, -1.0, -1.0, -1.0])  # of a quaternion


@dataclass(frozen=True, eq=False)
class Reading:
    """notes: what taking it says of the file.  fault, remedy: of a file that is so, where that is mistaken, in words."""

    gaussians: Gaussians
    world: Similarity | None
    notes: tuple[str, ...] = ()
    fault: str = ""
    remedy: str = ""

    @property
    def similarity(self) -> list[list[float]] | None:
        return None if self.world is None else self.world.tolist()


def mistaken(reading: Reading) -> Iterator[Reading]:
    """The readings of a file whose writer had another convention, one at a time, as far as its numbers can be that."""
    g, colours, higher = reading.gaussians, reading.gaussians.sh[:, :1], reading.gaussians.sh[:, 1:]

    def read(right: str, wrong: str, other: Gaussians | None = None, **new: torch.Tensor) -> Reading:
        other = other or g.with_flat(Gaussians.pack(g.attributes | new).flat)
        return Reading(other, reading.world, (), f"{right}, got {wrong}", f"write the file with {right}")

    yield read("quaternions w, x, y, z", "x, y, z, w", quats=g.quats.roll(1, 1))
    yield read("quaternions that turn Gaussians into the world", "their inverses", quats=g.quats * INVERSE)
    yield read("axes right, down, front", "right, up, back", turned(g))
    yield read("colours red, green, blue", "blue, green, red", sh=g.sh.flip(-1))
    yield read("SH coefficients", "colours from 0 to 1", sh=torch.cat([(colours - 0.5) / Y00, higher], 1))
    if higher.numel():
        bands = higher.transpose(1, 2).reshape(higher.shape)
        yield read("all f_rest of red, then of green, then of blue", "band by band", sh=torch.cat([colours, bands], 1))
    if g.opacity_logits.min() >= 0 and g.opacity_logits.max() <= 1:
        logits = torch.from_numpy(logit(g.opacity_logits.numpy())[0]).to(g.flat)
        yield read("logits of opacities", "opacities", opacity_logits=logits)
    if g.log_scales.min() > 0:
        yield read("logarithms of scales", "scales", log_scales=g.log_scales.log())


def likeliest(
    readings: Iterable[Reading], elsewhere: Iterable[Reading], scene: Scene, names: Sequence[str], config: TrainConfig,
    picture: Path, *, centred: bool,
) -> tuple[Reading, float]:  # fmt: skip
    """The reading that looks most like the training views of these names, and its PSNR there, dB.

    elsewhere: mistaken readings in other worlds, tried where nothing looks like the scene.  Colours are compared as the loss
    does, not cut to [0, 1].  InputError where a mistaken reading looks clearly better, below LEAST_PSNR, and below MARGIN above
    what pictures of one colour have, each its photograph's mean: this is low where photographs have little contrast.
    picture: where render and photograph are written side by side then.
    """
    views = scene.load(names)
    small = [_small(view) for view in views]

    @torch.no_grad()
    def images(reading: Reading, views: Sequence[View]) -> list[torch.Tensor]:
        frames = posed(scene, reading.similarity, centred=centred).select(names)
        sizes = [(view.camera.width, view.camera.height) for view in views]
        cameras = [frame.camera.resized(*size) for frame, size in zip(frames, sizes, strict=True)]
        background = config.background_colour(reading.gaussians.flat.dtype)
        return [render(reading.gaussians, camera, background, config.render).image for camera in cameras]

    def seen(reading: Reading) -> float:
        with suppress(InputError):  # of what cannot be rendered
            if not isnan(level := likeness(images(reading, small), small)):
                return level
        return -inf

    own, best = max(((seen(each), each) for each in readings), key=itemgetter(0))
    others = chain(mistaken(best), elsewhere if own < least(small) else ())
    level, other = max(((seen(each), each) for each in others), key=itemgetter(0))
    if level > own + CLEARLY and level >= least(small):
        before = f"{own:.1f}" if isfinite(own) else "no picture"
        raise InputError(
            f"expected {other.fault}: so read, it looks more like the photographs ({level:.1f} dB against {before} on small "
            f"training views); {other.remedy}"
        )
    rendered = images(best, views)
    level = likeness(rendered, views)
    if not level >= (wanted := least(views)):
        picture.parent.mkdir(parents=True, exist_ok=True)
        picture.write_bytes(png(bytes_of(torch.cat([rendered[0].clamp(0, 1), views[0].image], dim=2))))
        raise InputError(
            f"expected Gaussians that look like the scene's photographs, got {level:.1f} dB on training views (at least "
            f"{wanted:.1f}; pictures of one colour have {plain(views):.1f}); is this their scene? else it is other images "
            "(--images, --downscale), or another trainer (--trained-by), whose world or signs differ; "
            f"{picture} shows the render beside the photograph"
        )
    return best, level


def _small(view: View) -> View:
    camera = view.camera
    ratio = min(1.0, SMALL / min(camera.width, camera.height))
    size = round(ratio * camera.width), round(ratio * camera.height)
    return View(view.name, camera.resized(*size), resize_by_area(view.image, *size))


def likeness(images: Sequence[torch.Tensor], views: Sequence[View]) -> float:
    """Mean PSNR, dB."""
    pairs = zip(images, views, strict=True)
    return fmean(float(-10 * (image.double() - view.image).square().mean().log10()) for image, view in pairs)


def plain(views: Sequence[View]) -> float:
    """What pictures of one colour have, dB."""
    return likeness([view.image.mean(dim=(1, 2), keepdim=True) for view in views], views)


def least(views: Sequence[View]) -> float:
    return max(LEAST_PSNR, plain(views) + MARGIN)
