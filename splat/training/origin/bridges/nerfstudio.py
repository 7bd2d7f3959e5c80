"""The loss landscape of any model of nerfstudio, splats, networks and hash grids, by its own calls.

They are those of `models/base_model.py` (read at 02b6a46): `model(rays or camera)["rgb"]` is the picture, `get_loss_dict` gives
its losses, `get_param_groups` the parameters; of `utils/eval_utils.py` (027afab): `eval_setup` loads a run; and of
`data/datamanagers/full_images_datamanager.py` (0143803): `next_train(step)` gives a camera, elsewhere rays, and its batch.

    config, pipeline, *_ = eval_setup(Path("outputs/.../config.yml"), test_mode="val")
    views = [pipeline.datamanager.next_train(step) for step in range(20)]
    H = nerfstudio_hessian(pipeline.model, views)
"""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from landscape import RendererHessian

NAMES = {
    "scales": "log_scales",
    "opacities": "opacity_logits",
    "features_dc": "sh/dc",
    "features_rest": "sh/rest",
}  # of splatfacto's groups


def nerfstudio_hessian(
    model: Any, views: Sequence[tuple[Any, Mapping[str, Any]]], groups: Sequence[str] | None = None
) -> RendererHessian:
    """The Hessian of the mean loss over views, pairs of rays (or a camera) and their batch, at a model in `eval()`.

    groups: of the parameters, all by default; each is a block.  Terms of the loss that do not read the picture are constants:
    what depends on samples along the rays, or on the parameters alone, has no part in H.

    >>> class Model(torch.nn.Module):  # stands for theirs
    ...     def __init__(self):
    ...         super().__init__()
    ...         self.field = torch.nn.Linear(2, 3).double()
    ...     def forward(self, rays):
    ...         return {"rgb": torch.sigmoid(self.field(rays)), "depth": rays[:, 0]}
    ...     def get_param_groups(self):
    ...         return {"fields": list(self.field.parameters())}
    ...     def get_loss_dict(self, outputs, batch, metrics_dict=None):
    ...         return {"rgb_loss": ((outputs["rgb"] - batch["image"]) ** 2).mean(), "far": outputs["depth"].mean()}
    >>> rays = torch.linspace(0, 1, 10, dtype=torch.float64).reshape(5, 2)
    >>> H = nerfstudio_hessian(Model().eval(), [(rays, {"image": torch.zeros(5, 3)})])
    >>> H.blocks, H.apply(torch.ones(H.dim, 1, dtype=H.dtype)).isfinite().all()
    ({'fields': slice(0, 9, None)}, tensor(True))
    """
    found = model.get_param_groups()
    named = {
        f"{NAMES.get(group, group)}/{index}": part
        for group, parts in found.items()
        for index, part in enumerate(parts)
        if (groups is None or group in groups) and part.requires_grad and part.numel()
    }
    others: dict[str, Any] = {}

    def image_of(view: tuple[Any, Mapping[str, Any]]) -> Tensor:
        outputs = model(view[0])
        others.clear()
        others.update({name: _still(value) for name, value in outputs.items() if name != "rgb"})
        return outputs["rgb"]

    def loss_of(image: Tensor, view: tuple[Any, Mapping[str, Any]]) -> Tensor:
        losses = model.get_loss_dict(others | {"rgb": image}, view[1])
        return torch.stack([value.reshape(()) for value in losses.values() if isinstance(value, Tensor)]).sum()

    return RendererHessian(image_of, named, loss_of, views)


def _still(value: Any) -> Any:
    """A value without its graph."""
    if isinstance(value, Tensor):
        return value.detach()
    return [_still(part) for part in value] if isinstance(value, list) else value
