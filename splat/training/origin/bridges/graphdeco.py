"""The loss landscape of Gaussians in graphdeco-inria/gaussian-splatting and its descendants, through their own rasteriser.

The call is that of `gaussian_renderer/__init__.py` (read at 0a948b3): `render(camera, gaussians, pipe, background)["render"]`
is an image (3, h, w), which depends on the stored tensors of the model.  2DGS, Mip-Splatting, FSGS, CoR-GS, DNGaussian and
DropGaussian kept the call; where theirs takes more, give it as `functools.partial(render, kernel_size=0.1)`.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from torch import Tensor

from landscape import RendererHessian
from splat.losses.autograd import view_loss
from splat.losses.reference import LossSettings
from splat.render.backend import backend_of

STORED = {
    "means": "_xyz",
    "log_scales": "_scaling",
    "quats": "_rotation",
    "opacity_logits": "_opacity",
    "sh/dc": "_features_dc",
    "sh/rest": "_features_rest",
}


def graphdeco_hessian(
    render: Callable[..., Mapping[str, Tensor]],
    gaussians: Any,
    pipe: Any,
    background: Tensor,
    cameras: Sequence[Any],
    loss: LossSettings = LossSettings(),
) -> RendererHessian:
    """The Hessian over these cameras, of `scene.getTrainCameras()`, at a `GaussianModel`; blocks have this toolkit's names.

    loss: against each camera's `original_image`; by default that of their train.py, in float64.

    >>> import torch
    >>> from types import SimpleNamespace
    >>> from splat import Gaussians, SyntheticSettings, synthetic_scene
    >>> from splat.render.render import render as ours
    >>> made = synthetic_scene(SyntheticSettings(gaussians=50, views=2, width=16, height=12))
    >>> parts = made.truth.attributes | {"sh/dc": made.truth.sh[:, :1], "sh/rest": made.truth.sh[:, 1:]}
    >>> model = SimpleNamespace(**{STORED[name]: parts[name].clone().requires_grad_() for name in STORED})
    >>> def theirs(camera, pc, pipe, bg_color):
    ...     parts = {name: getattr(pc, attribute) for name, attribute in STORED.items()}
    ...     parts["sh"] = torch.cat([parts.pop("sh/dc"), parts.pop("sh/rest")], dim=1)
    ...     return {"render": ours(Gaussians.pack(parts), camera.camera, bg_color).image}
    >>> cameras = [SimpleNamespace(camera=view.camera, original_image=view.image + 0.1) for view in made.scene.load()]
    >>> H = graphdeco_hessian(theirs, model, None, torch.zeros(3), cameras)
    >>> list(H.blocks), H.apply(torch.ones(H.dim, 1)).isfinite().all()
    (['means', 'log_scales', 'quats', 'opacity_logits', 'sh'], tensor(True))
    """
    named = {name: getattr(gaussians, attribute) for name, attribute in STORED.items()}
    return RendererHessian(
        lambda camera: render(camera, gaussians, pipe, background)["render"],
        {name: value for name, value in named.items() if value.numel()},
        lambda image, camera: exact_loss(image, camera.original_image, loss),
        cameras,
    )


def exact_loss(image: Tensor, target: Tensor, loss: LossSettings) -> Tensor:
    """The loss of an image (3, h, w) in float64."""
    exact = image.double()
    return view_loss(exact, backend_of(exact).view_loss(target.to(exact.device), loss, exact))
