"""The loss landscape of other tools' objects, through their own renderers (`landscape.RendererHessian`).

graphdeco     `gaussian_renderer/__init__.py` (read at 0a948b3): `render(camera, gaussians, pipe, background)["render"]` is an
              image (3, h, w).  2DGS, Mip-Splatting, FSGS, CoR-GS, DNGaussian and DropGaussian kept the call; where theirs
              takes more, give it as `functools.partial(render, kernel_size=0.1)`
gsplat        `examples/simple_trainer.py` (00877bf): `rasterization(means=, ...)` and `rasterization_2dgs` give colours
              (cameras, h, w, 3) first.  Scales are stored as logarithms, opacities as logits
nerfstudio    `models/base_model.py` (02b6a46): `model(rays or camera)["rgb"]` is the picture of splats, networks or hash grids,
              `get_loss_dict` gives its losses, `get_param_groups` the parameters.  `utils/eval_utils.py` (027afab) loads a run,
              `data/datamanagers/full_images_datamanager.py` (0143803) gives a camera, elsewhere rays, and its batch:

    config, pipeline, *_ = eval_setup(Path("outputs/.../config.yml"), test_mode="val")
    H = nerfstudio_hessian(pipeline.model, [pipeline.datamanager.next_train(step) for step in range(20)])

Quaternions keep the length q that is stored: curvature in one is 1/q^2 of that at length 1, where `landscape probe` measures.
"""

from collections.abc import Callable, Mapping, Sequence
from math import isqrt
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from landscape import RendererHessian
from splat.losses.autograd import view_loss
from splat.losses.reference import LossSettings
from splat.render.backend import backend_of

STORED = {  # by graphdeco, gsplat and nerfstudio's splatfacto
    "means": ("_xyz", "means", "means"),
    "log_scales": ("_scaling", "scales", "scales"),
    "quats": ("_rotation", "quats", "quats"),
    "opacity_logits": ("_opacity", "opacities", "opacities"),
    "sh/dc": ("_features_dc", "sh0", "features_dc"),
    "sh/rest": ("_features_rest", "shN", "features_rest"),
}


def graphdeco_hessian(
    render: Callable, model: Any, pipe: Any, background: Tensor, cameras: Sequence, loss: LossSettings = LossSettings()
) -> RendererHessian:
    """The Hessian over these cameras, of `scene.getTrainCameras()`, at a `GaussianModel`.

    loss: against each camera's `original_image`; by default that of their train.py, in float64.

    >>> from types import SimpleNamespace
    >>> model = SimpleNamespace(**{name: torch.ones(5, 3, requires_grad=True) for name, *_ in STORED.values()})
    >>> def render(camera, gaussians, pipe, background):  # stands for theirs
    ...     light = sum(value.square().mean() for value in vars(gaussians).values())
    ...     return {"render": background[:, None, None] + light * camera.original_image}
    >>> H = graphdeco_hessian(render, model, None, torch.zeros(3), [SimpleNamespace(original_image=torch.rand(3, 12, 16))])
    >>> list(H.blocks), H.apply(torch.ones(H.dim, 1)).isfinite().all()
    (['means', 'log_scales', 'quats', 'opacity_logits', 'sh'], tensor(True))
    """
    return RendererHessian(
        lambda camera: render(camera, model, pipe, background)["render"],
        {name: value for name, (key, *_) in STORED.items() if (value := getattr(model, key)).numel()},
        lambda image, camera: _exact_loss(image, camera.original_image, loss),
        cameras,
    )


def gsplat_hessian(
    rasterization: Callable[..., tuple],
    splats: Mapping[str, Tensor],
    viewmats: Float[Tensor, "c 4 4"],
    Ks: Float[Tensor, "c 3 3"],
    images: Sequence[Float[Tensor, "h w 3"]],
    loss: LossSettings = LossSettings(border="valid"),
    **options: Any,
) -> RendererHessian:
    """The Hessian over these cameras at a ParameterDict of splats.

    viewmats: world to camera.  images: in [0, 1], one for each camera.  loss: by default that of its trainer, in float64,
    without its regularisers.  options: for rasterization, as sh_degree=2, packed=True.

    >>> sizes = {"means": (5, 3), "scales": (5, 3), "quats": (5, 4), "opacities": (5,), "sh0": (5, 1, 3), "shN": (5, 3, 3)}
    >>> splats = torch.nn.ParameterDict({name: torch.ones(size) for name, size in sizes.items()})
    >>> def rasterization(viewmats, Ks, width, height, sh_degree, **stored):  # stands for theirs
    ...     return sum(value.square().mean() for value in stored.values()) * torch.ones(1, height, width, 3), None, {}
    >>> H = gsplat_hessian(rasterization, splats, torch.eye(4)[None], torch.eye(3)[None], [torch.rand(12, 16, 3)])
    >>> list(H.blocks), H.apply(torch.ones(H.dim, 1)).isfinite().all()
    (['means', 'log_scales', 'quats', 'opacity_logits', 'sh'], tensor(True))
    """
    stored = {name: splats[key] for name, (_, key, _) in STORED.items() if key in splats and splats[key].numel()}
    bands = [stored[name] for name in ("sh/dc", "sh/rest") if name in stored]
    options = {"sh_degree": isqrt(sum(each.shape[1] for each in bands)) - 1} | options

    def image_of(index: int) -> Tensor:
        height, width, _ = images[index].shape
        colours, *_ = rasterization(
            means=splats["means"], quats=splats["quats"], scales=torch.exp(splats["scales"]),
            opacities=torch.sigmoid(splats["opacities"]), colors=torch.cat(bands, dim=1), width=width, height=height,
            viewmats=viewmats[index : index + 1], Ks=Ks[index : index + 1], **options,
        )  # fmt: skip
        return colours[0, ..., :3].permute(2, 0, 1)

    targets = [image.permute(2, 0, 1) for image in images]
    return RendererHessian(image_of, stored, lambda image, i: _exact_loss(image, targets[i], loss), range(len(targets)))


def nerfstudio_hessian(model: Any, views: Sequence[tuple], groups: Sequence[str] | None = None) -> RendererHessian:
    """The Hessian of the mean loss over views, pairs of rays (or a camera) and their batch, at a model in `eval()`.

    groups: of the parameters, all by default; each is a block.  Terms of the loss that do not read the picture are constants:
    what depends on samples along the rays, or on the parameters alone, has no part in H.

    >>> class Model(torch.nn.Linear):  # stands for theirs
    ...     def forward(self, rays):
    ...         return {"rgb": torch.sigmoid(super().forward(rays)), "depth": rays[:, 0]}
    ...     def get_param_groups(self):
    ...         return {"fields": list(self.parameters())}
    ...     def get_loss_dict(self, outputs, batch, metrics_dict=None):
    ...         return {"rgb_loss": ((outputs["rgb"] - batch["image"]) ** 2).mean(), "far": outputs["depth"].mean()}
    >>> rays = torch.linspace(0, 1, 10).reshape(5, 2)
    >>> H = nerfstudio_hessian(Model(2, 3).eval(), [(rays, {"image": torch.zeros(5, 3)})])
    >>> H.blocks, H.apply(torch.ones(H.dim, 1)).isfinite().all()
    ({'fields': slice(0, 9, None)}, tensor(True))
    """
    ours = {theirs: name for name, (*_, theirs) in STORED.items()}
    named = {
        f"{ours.get(group, group)}/{index}": part
        for group, parts in model.get_param_groups().items()
        for index, part in enumerate(parts)
        if (groups is None or group in groups) and part.requires_grad and part.numel()
    }
    others: dict[str, Any] = {}

    def image_of(view: tuple) -> Tensor:
        others.clear()  # what lists keep of the last view's graph
        outputs = model(view[0])
        others.update({name: each.detach() if isinstance(each, Tensor) else each for name, each in outputs.items()})
        return outputs["rgb"]

    def loss_of(image: Tensor, view: tuple) -> Tensor:
        losses = model.get_loss_dict(others | {"rgb": image}, view[1])
        return torch.stack([value.reshape(()) for value in losses.values() if isinstance(value, Tensor)]).sum()

    return RendererHessian(image_of, named, loss_of, views)


def _exact_loss(image: Tensor, target: Tensor, loss: LossSettings) -> Tensor:
    """The loss of an image (3, h, w) in float64."""
    exact = image.double()
    return view_loss(exact, backend_of(exact).view_loss(target.to(exact.device), loss, exact))
