"""What each trainer's renderer, loss and world are, as settings of this project.

                graphdeco   gsplat <= 1.5   gsplat 1.6   nerfstudio   brush   lichtfeld   splat-landscape
    alpha cap   0.99        0.999           0.99         0.999        0.999   0.99        0.99
    near        0.2         0.01            0.01         0.01         0.2*    0.2*        0.2
    blur, px^2  0.3         0.3             0.3          0.3          0.3     0.3         0.3
    principal   middle      own             own          own          own     own         own
    SSIM        padded      valid           valid        valid        own*    valid       padded
    width       <= 1600     any             any          any          any     any         any
    world       scene       normalised      normalised   its file     scene   scene       scene

*: not known, or not here: 3DGS's.  Sources: graphdeco-inria/gaussian-splatting 1152adc; gsplat v1.5.3 and 1.6 (`_constants.py`,
`examples/simple_trainer.py`, `losses.py`); nerfstudio `models/splatfacto.py`; Brush `kernels/helpers.rs`, `rasterize.rs`;
LichtFeld `src/training/trainer.cpp`.  SSIM: whether windows may reach beyond the image (`LossSettings.border`).  Not followed:
the limits of the projection's Jacobian are 3DGS's; splats end at alpha 1/255 and not at 3 or 3.33 sigma.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from landscape.errors import InputError
from splat.losses.reference import LossSettings
from splat.model.settings import RenderSettings

World = Literal["scene", "gsplat", "nerfstudio"]
UNKNOWN = "its near plane is not known here, 3DGS's 0.2 is used"


@dataclass(frozen=True)
class Preset:
    """centred: principal points are taken for the images' middles.  widest: wider pictures are reduced to this, px.

    different: sentences on what is not followed.
    """

    render: RenderSettings = RenderSettings()
    loss: LossSettings = LossSettings()
    world: World = "scene"
    centred: bool = False
    widest: int | None = None
    different: tuple[str, ...] = ()


_VALID = LossSettings(border="valid")
_OLD, _NEW = RenderSettings(alpha_max=0.999, near=0.01), RenderSettings(near=0.01)
PRESETS: Mapping[str, Preset] = {
    "graphdeco": Preset(centred=True, widest=1600),
    "gsplat": Preset(_OLD, _VALID, "gsplat"),
    "gsplat-raw": Preset(_OLD, _VALID),  # with --no-normalize-world-space
    "gsplat-1.6": Preset(_NEW, _VALID, "gsplat"),
    "nerfstudio": Preset(
        _OLD,
        _VALID,
        "nerfstudio",
        different=("it trains on random backgrounds and on clamped colours, here neither is done",),
    ),
    "brush": Preset(RenderSettings(alpha_max=0.999), different=("its SSIM is another", UNKNOWN)),
    "lichtfeld": Preset(loss=_VALID, different=(UNKNOWN,)),
    "splat-landscape": Preset(),
}


def preset_of(said: str | None, asked: str | None) -> tuple[str, str]:
    """(name, who says so) of the trainer: the one that was asked for, else the one that the file says.

    InputError where neither is one of `PRESETS`.

    >>> preset_of("brush", None)
    ('brush', 'the file')
    """
    name = asked or said
    if name is not None and name in PRESETS:
        return name, "asked for" if asked else "the file"
    found = f"the file, which says {said!r}" if asked is None and said else (asked or "nothing in the file")
    raise InputError(
        f"expected --trained-by with one of {', '.join(PRESETS)}, whose conventions to follow, got {found}"
    )
