"""Our renderer behind the interface of each tool: the bridges find what the exact operators say."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from landscape import RendererHessian
from splat import Gaussians, LossSettings, SceneHessian, SceneObjective, SyntheticSettings, synthetic_scene
from splat.losses.autograd import view_loss
from splat.render.backend import backend_of
from splat.render.render import render
from splat.training.origin.bridges import STORED, graphdeco_hessian, gsplat_hessian, nerfstudio_hessian

VIEWS = synthetic_scene(SyntheticSettings(gaussians=50, views=2, width=16, height=12)).scene.load()


def objective(degree: int, loss: LossSettings) -> SceneObjective:
    """The truth against photographs that are 0.1 brighter: no residual of L1 is near 0."""
    truth = synthetic_scene(SyntheticSettings(gaussians=50, views=2, width=16, height=12, sh_degree=degree)).truth
    views = [replace(view, image=view.image + 0.1) for view in VIEWS]
    return SceneObjective(truth.to(torch.float64), views, loss)


def image_of(parts: dict[str, Tensor], camera: int) -> Tensor:
    named = {name: value for name, value in parts.items() if not name.startswith("sh/")}
    named["sh"] = torch.cat([value for name, value in parts.items() if name.startswith("sh/")], dim=1)
    return render(Gaussians.pack(named), VIEWS[camera].camera, torch.zeros(3, dtype=torch.float64)).image


def of_graphdeco(parts: dict[str, Tensor], images: list[Tensor], loss: LossSettings) -> RendererHessian:
    model = SimpleNamespace(**{theirs: parts[name] for name, (theirs, *_) in STORED.items()})

    def theirs(camera, pc, pipe, bg_color):
        assert pipe == "pipe" and not bg_color.any()
        return {"render": image_of({name: getattr(pc, theirs) for name, (theirs, *_) in STORED.items()}, camera.index)}

    cameras = [SimpleNamespace(index=index, original_image=image) for index, image in enumerate(images)]
    return graphdeco_hessian(theirs, model, "pipe", torch.zeros(3), cameras, loss)


def of_gsplat(parts: dict[str, Tensor], images: list[Tensor], loss: LossSettings) -> RendererHessian:
    splats: Any = torch.nn.ParameterDict({theirs: parts[name] for name, (_, theirs, _) in STORED.items()})

    def rasterization(means, quats, scales, opacities, colors, viewmats, Ks, width, height, sh_degree, packed):
        assert (width, height, packed) == (16, 12, True) and colors.shape[1] == (sh_degree + 1) ** 2
        assert viewmats.shape == (1, 4, 4) and Ks.shape == (1, 3, 3)
        named = {"means": means, "log_scales": scales.log(), "quats": quats, "opacity_logits": opacities.logit()}
        return image_of(named | {"sh/all": colors}, int(viewmats[0, 0, 0])).permute(1, 2, 0)[None], None, {}

    poses = torch.arange(2.0)[:, None, None].expand(2, 4, 4)
    pictures = [image.permute(1, 2, 0) for image in images]
    return gsplat_hessian(rasterization, splats, poses, torch.ones(2, 3, 3), pictures, loss, packed=True)


def of_nerfstudio(parts: dict[str, Tensor], images: list[Tensor], loss: LossSettings) -> RendererHessian:
    class Splatfacto(torch.nn.Module):
        def forward(self, camera):
            return {"rgb": image_of(parts, camera).permute(1, 2, 0), "depth": parts["means"].sum(), "background": None}

        def get_param_groups(self):
            still = {"camera_opt": [torch.zeros(3)]}
            return {theirs: [parts[name]] for name, (*_, theirs) in STORED.items()} | still

        def get_loss_dict(self, outputs, batch, metrics_dict=None):
            image = outputs["rgb"].permute(2, 0, 1)
            main = view_loss(image, backend_of(image).view_loss(batch["image"], loss, image))
            return {"main_loss": main, "of_depth": outputs["depth"], "words": "none"}

    return nerfstudio_hessian(Splatfacto(), [(index, {"image": image}) for index, image in enumerate(images)])


@pytest.mark.parametrize("degree", [0, 1])
@pytest.mark.parametrize(
    ("bridge", "loss"),
    [(of_graphdeco, LossSettings()), (of_gsplat, LossSettings(border="valid")), (of_nerfstudio, LossSettings())],
)
def test_products_are_those_of_the_exact_operator(bridge, loss, degree):
    truth = objective(degree, loss)
    parts = dict(truth.active.attributes)
    sh = parts.pop("sh")
    stored = {name: value.clone().requires_grad_() for name, value in parts.items()}
    stored |= {"sh/dc": sh[:, :1].clone().requires_grad_(), "sh/rest": sh[:, 1:].clone().requires_grad_()}
    H, exact = bridge(stored, [view.image for view in truth.views], loss), SceneHessian(truth, keep_null=True)
    assert list(H.blocks) == ["means", "log_scales", "quats", "opacity_logits", "sh"] == list(truth.active.blocks)
    rows = torch.arange(H.dim)[truth.active.blocks["sh"]].reshape(sh.shape)
    order = torch.cat([torch.arange(int(rows.min())), rows[:, :1].reshape(-1), rows[:, 1:].reshape(-1)])
    V = torch.randn(H.dim, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    constant = stored["means"].sum().item() if bridge is of_nerfstudio else 0  # a term that does not read the picture
    assert float(H.value) == pytest.approx(float(truth.loss(truth.active.flat)) + constant, rel=1e-6)
    assert (H.gradient - truth.gradient[order]).norm() < 1e-6 * truth.gradient.norm()
    found, right = H.apply(V[order]), exact.apply(V)[order]
    assert (found - right).norm() < 1e-3 * right.norm()
