"""The loss landscape of Gaussians in nerfstudio-project/gsplat, through its own rasteriser.

The calls are those of `examples/simple_trainer.py` (read at 00877bf): `rasterization(means=, quats=, scales=, opacities=,
colors=, viewmats=, Ks=, width=, height=, ...)` gives colours (cameras, h, w, 3) first; scales are stored as logarithms,
opacities as logits, and its checkpoints hold the tensors "means", "quats", "scales", "opacities", "sh0", "shN".  So too
`rasterization_2dgs`.
"""

from collections.abc import Callable, Mapping, Sequence
from math import isqrt
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from landscape import RendererHessian
from splat.losses.reference import LossSettings
from splat.training.origin.bridges.graphdeco import exact_loss

STORED = {
    "means": "means",
    "log_scales": "scales",
    "quats": "quats",
    "opacity_logits": "opacities",
    "sh/dc": "sh0",
    "sh/rest": "shN",
}


def gsplat_hessian(
    rasterization: Callable[..., tuple],
    splats: Mapping[str, Tensor],
    viewmats: Float[Tensor, "c 4 4"],
    Ks: Float[Tensor, "c 3 3"],
    images: Sequence[Float[Tensor, "h w 3"]],
    loss: LossSettings = LossSettings(border="valid"),
    **options: Any,
) -> RendererHessian:
    """The Hessian over these cameras at a ParameterDict of splats; blocks have this toolkit's names.

    rasterization: gsplat's, or `rasterization_2dgs`.  viewmats: world to camera.  images: in [0, 1], one for each camera.
    loss: by default that of its trainer, in float64, without its regularisers.  options: for rasterization, as sh_degree=2,
    packed=True.

    >>> from splat import Gaussians, SyntheticSettings, synthetic_scene
    >>> from splat.render.render import render
    >>> made = synthetic_scene(SyntheticSettings(gaussians=50, views=2, width=16, height=12))
    >>> views, parts = made.scene.load(), made.truth.attributes
    >>> parts |= {"sh/dc": parts["sh"][:, :1], "sh/rest": parts["sh"][:, 1:]}
    >>> splats = torch.nn.ParameterDict({key: parts[name].clone() for name, key in STORED.items()})
    >>> def rasterization(means, quats, scales, opacities, colors, viewmats, Ks, width, height, sh_degree):  # stands for theirs
    ...     parts = dict(means=means, quats=quats, log_scales=scales.log(), opacity_logits=opacities.logit(), sh=colors)
    ...     image = render(Gaussians.pack(parts), views[int(viewmats[0, 0, 0])].camera).image
    ...     return image.permute(1, 2, 0)[None], None, {}
    >>> which = torch.arange(2.0)[:, None, None].expand(2, 4, 4)
    >>> H = gsplat_hessian(rasterization, splats, which, which, [view.image.permute(1, 2, 0) + 0.1 for view in views])
    >>> list(H.blocks), H.apply(torch.ones(H.dim, 1)).isfinite().all()
    (['means', 'log_scales', 'quats', 'opacity_logits', 'sh'], tensor(True))
    """
    named = {name: splats[key] for name, key in STORED.items() if key in splats and splats[key].numel()}
    bands = sum(named[name].shape[1] for name in ("sh/dc", "sh/rest") if name in named)
    options = {"sh_degree": isqrt(bands) - 1} | options

    def image_of(index: int) -> Tensor:
        height, width, _ = images[index].shape
        stored = {name: splats[name] for name in ("means", "quats")} | {"width": width, "height": height}
        found = rasterization(
            **stored, scales=torch.exp(splats["scales"]), opacities=torch.sigmoid(splats["opacities"]),
            colors=torch.cat([named[name] for name in ("sh/dc", "sh/rest") if name in named], dim=1),
            viewmats=viewmats[index : index + 1], Ks=Ks[index : index + 1], **options,
        )  # fmt: skip
        return found[0][0, ..., :3].permute(2, 0, 1)

    def loss_of(image: Tensor, index: int) -> Tensor:
        return exact_loss(image, images[index].permute(2, 0, 1), loss)

    return RendererHessian(image_of, named, loss_of, range(len(images)))
