"""Renderer, loss and world of each trainer, as settings of this project.

                graphdeco   gsplat <= 1.5   gsplat 1.6   nerfstudio   brush   lichtfeld   splat-landscape
    alpha cap   0.99        0.999           0.99         0.999        0.999   0.99        0.99
    near        0.2         0.01            0.01         0.01         0.2*    0.2*        0.2
    blur, px^2  0.3         0.3             0.3          0.3          0.3     0.3         0.3
    antialiased mip         mip-plain       mip          mip-plain    plain** mip*        mip
    principal   middle      own             own          own          own     own         own
    SSIM        padded      valid           valid        valid        own*    valid       padded
    width       <= 1600     any             any          any          any     any         any
    world       scene       normalised      normalised   its file     scene   scene       scene

*: not known, or not here: 3DGS's.  **: mip-plain with a blur of 0.1.  antialiased: by what equation, where the Gaussians are
(`splat/projection/antialias.py`).  mip-splatting is a graphdeco with that, a blur of its cfg_args' kernel_size (0.1), and a 3-D
filter; splat-landscape-mip is the same through the cameras' own principal points.  Sources: graphdeco-inria/gaussian-splatting
1152adc; gsplat v1.5.3 and 1.6 (`_constants.py`, `examples/simple_trainer.py`, `losses.py`); nerfstudio `models/splatfacto.py`;
Brush `kernels/helpers.rs`, `rasterize.rs`; LichtFeld `src/training/trainer.cpp`.  SSIM: whether windows may reach beyond the
image (`LossSettings.border`).  Not followed: the limits of the projection's Jacobian are 3DGS's; splats end at alpha 1/255 and
not at 3 or 3.33 sigma.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

from landscape.errors import InputError, did_you_mean
from splat.losses.reference import LossSettings
from splat.model.settings import Antialias, RenderSettings

World = Literal["scene", "gsplat", "nerfstudio"]
UNKNOWN = "its near plane is not known here, 3DGS's 0.2 is used"


@dataclass(frozen=True)
class Preset:
    """centred: principal points are taken for the images' middles.  widest: wider pictures are reduced to this, px.

    antialias, antialiased_blur: of Gaussians that are antialiased, the blur where it is another than `render` has.
    different: sentences on what is not followed.
    """

    render: RenderSettings = RenderSettings()
    loss: LossSettings = LossSettings()
    world: World = "scene"
    centred: bool = False
    widest: int | None = None
    antialias: Antialias = "mip"
    antialiased_blur: float | None = None
    different: tuple[str, ...] = ()


_VALID = LossSettings(border="valid")
_OLD, _NEW = RenderSettings(alpha_max=0.999, near=0.01), RenderSettings(near=0.01)
PRESETS: Mapping[str, Preset] = {
    "graphdeco": Preset(centred=True, widest=1600),
    "gsplat": Preset(_OLD, _VALID, "gsplat", antialias="mip-plain"),
    "gsplat-raw": Preset(_OLD, _VALID, antialias="mip-plain"),  # with --no-normalize-world-space
    "gsplat-1.6": Preset(_NEW, _VALID, "gsplat"),
    "nerfstudio": Preset(
        _OLD,
        _VALID,
        "nerfstudio",
        antialias="mip-plain",
        different=("it trains on random backgrounds and on clamped colours, here neither is done",),
    ),
    "brush": Preset(
        RenderSettings(alpha_max=0.999),
        antialias="mip-plain",
        antialiased_blur=0.1,
        different=("its SSIM is another", UNKNOWN),
    ),
    "mip-splatting": Preset(
        RenderSettings(blur=0.1, antialias="mip-splatting"), centred=True, widest=1600, antialias="mip-splatting"
    ),
    "lichtfeld": Preset(loss=_VALID, different=(UNKNOWN, "its antialiasing is not known here, 3DGS's is used")),
    "splat-landscape": Preset(),
    "splat-landscape-mip": Preset(RenderSettings(blur=0.1, antialias="mip-splatting"), antialias="mip-splatting"),
}


def render_of(preset: Preset, settings: Mapping[str, Any], *, antialiased: bool) -> RenderSettings:
    """Settings of the trainer's renderer; settings: of the tool, by its names (`SplatFile.settings`).

    >>> found = render_of(PRESETS["brush"], {}, antialiased=True)
    >>> found.antialias, found.blur
    ('mip-plain', 0.1)
    """
    found = preset.render
    if antialiased:
        blur = found.blur if preset.antialiased_blur is None else preset.antialiased_blur
        found = replace(found, antialias=preset.antialias, blur=blur)
    kernel = settings.get("kernel_size")
    if found.antialias == "mip-splatting" and isinstance(kernel, int | float):
        found = replace(found, blur=float(kernel))
    return found


def preset_of(said: str | None, asked: str | None) -> tuple[str, str]:
    """(name, who says so) of the trainer: the one that was asked for, else the one that the file says.

    InputError where neither is one of `PRESETS`.

    >>> preset_of("brush", None)
    ('brush', 'the file')
    """
    if (name := asked or said or "nothing") in PRESETS:
        return name, "asked for" if asked else "the file"
    raise InputError(
        f"expected --trained-by with one of {', '.join(PRESETS)}, whose conventions to follow, got {name}"
        f"{did_you_mean(name, PRESETS) or '; of the original 3DGS: graphdeco'}"
    )
