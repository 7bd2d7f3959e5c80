"""Surfels, the flat Gaussians of 2DGS (Huang et al. 2024), in plain torch: a renderer that is not ours, measured by both ways.

A surfel has a centre p, two unit tangents t_u, t_v (a quaternion), two scales, an opacity and a colour.  The ray o + t d of a
pixel meets its plane, with the normal n, at t = n . (p - o) / n . d.  There (eqs. 4 to 11 of the paper)

    u = t_u . (o + t d - p) / s_u,   v likewise,   G = exp(-(u^2 + v^2) / 2)
    alpha = opacity * max(G, exp(-|x - x_p|^2))           x: the pixel, x_p: the centre in the image, px

and colours are composed from the front, in the order of the centres' depths.  Below 1/255 an alpha is dropped.
Autograd differentiates all of it twice, so the exact operators are those of autograd, without a line of derivatives.
"""

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor
from torch.nn.functional import normalize

from landscape import DenseOperator, ObjectiveHessian, RendererHessian
from splat import Camera, LossSettings, SyntheticSettings, View, synthetic_scene
from splat.losses.autograd import view_loss
from splat.render.backend import backend_of

LEAST = 1 / 255
RATES = {"means": 2e-3, "log_scales": 2e-2, "quats": 1e-2, "opacity_logits": 5e-2, "colours": 2e-2}  # of Adam
Stored = dict[str, Tensor]


def start(points: Tensor, colours: Tensor, size: float) -> Stored:
    """Surfels at points, of this size, turned at random."""
    count, generator = len(points), torch.Generator().manual_seed(0)
    return {
        "means": points.double(),
        "log_scales": torch.full((count, 2), size, dtype=torch.float64).log(),
        "quats": torch.randn(count, 4, generator=generator, dtype=torch.float64),
        "opacity_logits": torch.full((count,), 0.5, dtype=torch.float64),
        "colours": colours.double(),
    }


def tangents(quats: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The columns of the rotation: both tangents and the normal, (n, 3) each."""
    w, x, y, z = normalize(quats, dim=1).unbind(dim=1)
    first = torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], dim=1)
    second = torch.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], dim=1)
    return first, second, torch.linalg.cross(first, second)


def render(surfels: Stored, camera: Camera) -> Tensor:
    """The image (3, h, w), on black."""
    rotation, centre = camera.rotation.to(surfels["means"]), camera.centre.to(surfels["means"])
    y, x = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    pixels = torch.stack([x, y], dim=-1).reshape(-1, 2).to(surfels["means"])
    focal, middle = pixels.new_tensor([camera.fx, camera.fy]), pixels.new_tensor([camera.cx, camera.cy])
    rays = torch.cat([(pixels - middle) / focal, torch.ones_like(pixels[:, :1])], dim=1) @ rotation  # (pixels, 3)
    offsets = surfels["means"] - centre
    seen = offsets @ rotation.T  # (surfels, 3), in the camera's axes
    order = torch.argsort(seen[:, 2].detach())
    order = order[seen[order, 2].detach() > 0.01]
    offsets, seen = offsets[order], seen[order]
    first, second, normal = tangents(surfels["quats"][order])
    # the ray meets the plane, but for a ray along it, which the second term of alpha draws
    slant = rays @ normal.T
    slant = torch.where(slant.abs() < 1e-9, 1e-9, slant)
    along = (normal * offsets).sum(dim=1) / slant
    hit = along[:, :, None] * rays[:, None, :] - offsets  # (pixels, surfels, 3)
    scales = surfels["log_scales"][order].exp()
    uv = torch.stack([(hit * first).sum(dim=2) / scales[:, 0], (hit * second).sum(dim=2) / scales[:, 1]])
    flat = torch.exp(-uv.square().sum(dim=0) / 2)
    at = focal * seen[:, :2] / seen[:, 2:] + middle
    blurred = torch.exp(-(pixels[:, None] - at).square().sum(dim=2))
    alpha = torch.sigmoid(surfels["opacity_logits"][order]) * torch.maximum(flat, blurred)
    alpha = torch.where(alpha < LEAST, 0.0, alpha.clamp_max(0.99))
    passed = torch.cat([torch.ones_like(alpha[:, :1]), (1 - alpha).cumprod(dim=1)[:, :-1]], dim=1)
    return ((alpha * passed) @ surfels["colours"][order]).T.reshape(3, camera.height, camera.width)


@dataclass(frozen=True, eq=False)
class Surfels:
    """Trained surfels as a scene of `notebooks.renderer`: the bridge in a type, and the exact operators in float64."""

    stored: Stored
    views: list[View]
    dtype: torch.dtype = torch.float64
    name: str = "surfels"

    @property
    def gaussians(self) -> int:
        return len(self.stored["means"])

    @property
    def type(self) -> str:
        return str(self.dtype).removeprefix("torch.")

    @cached_property
    def losses(self) -> list:
        like = torch.zeros(1, dtype=torch.float64)
        return [backend_of(like).view_loss(view.image, LossSettings("l1"), like) for view in self.views]

    def loss(self, image: Tensor, index: int) -> Tensor:
        """L1 + SSIM of a view, in float64."""
        return view_loss(image.double(), self.losses[index])

    def image(self, flat: Tensor, index: int) -> Tensor:
        """The image of a view, from all parameters as one vector."""
        parts = flat.split([value.numel() for value in self.stored.values()])
        shaped = {name: part.view_as(self.stored[name]) for name, part in zip(self.stored, parts, strict=True)}
        return render(shaped, self.views[index].camera)

    @cached_property
    def flat(self) -> Tensor:
        return torch.cat([value.detach().reshape(-1) for value in self.stored.values()])

    @cached_property
    def exact(self) -> DenseOperator:
        """The Hessian by double backward."""
        numbers = range(len(self.views))

        def mean(flat: Tensor) -> Tensor:
            return torch.stack([self.loss(self.image(flat, index), index) for index in numbers]).mean()

        found = ObjectiveHessian(mean, self.flat).apply(torch.eye(len(self.flat), dtype=torch.float64))
        return DenseOperator((found + found.T) / 2)

    @cached_property
    def exact_gauss_newton(self) -> DenseOperator:
        """J^T l'' J, mean over views: J by forward differentiation, l'' J by a second derivative of the loss."""
        total = torch.zeros(len(self.flat), len(self.flat), dtype=torch.float64)
        for index in range(len(self.views)):
            J = torch.autograd.functional.jacobian(
                lambda flat, index=index: self.image(flat, index).reshape(-1),
                self.flat,
                vectorize=True,
                strategy="forward-mode",
            )
            image = self.image(self.flat, index).requires_grad_()
            (g,) = torch.autograd.grad(self.loss(image, index), image, create_graph=True)
            columns = [torch.autograd.grad(g, image, v.view_as(g), retain_graph=True)[0].reshape(-1) for v in J.T]
            total += J.T @ torch.stack(columns, dim=1) / len(self.views)
        return DenseOperator((total + total.T) / 2)

    @cached_property
    def traces(self) -> dict[str, tuple[float, float]]:
        diagonal = self.exact_gauss_newton.matrix.diagonal()
        return {name: (float(diagonal[rows].sum()), 0.0) for name, rows in self.foreign().blocks.items()}

    def foreign(self) -> RendererHessian:
        named = {name: value.clone().to(self.dtype).requires_grad_() for name, value in self.stored.items()}
        numbers = range(len(self.views))
        return RendererHessian(lambda index: render(named, self.views[index].camera), named, self.loss, numbers)


def trained(gaussians: int = 120, width: int = 32, height: int = 24, steps: int = 300) -> Surfels:
    """Surfels trained on three views of the synthetic scene with L1 + SSIM and Adam."""
    made = synthetic_scene(SyntheticSettings(gaussians=gaussians, views=3, width=width, height=height))
    points, views = made.scene.points, made.scene.load()
    assert points is not None
    nearest = torch.cdist(points.xyz, points.xyz).topk(2, largest=False).values[:, 1]
    begun = start(points.xyz, points.rgb, float(nearest.median()))
    scene = Surfels({name: value.requires_grad_() for name, value in begun.items()}, views)
    optimiser = torch.optim.Adam([{"params": [value], "lr": RATES[name]} for name, value in scene.stored.items()])
    for step in range(steps):
        optimiser.zero_grad()
        scene.loss(render(scene.stored, views[step % 3].camera), step % 3).backward()
        optimiser.step()
    return Surfels({name: value.detach() for name, value in scene.stored.items()}, views)
