"""A synthetic scene whose Gaussians are known: a still life over a chequered floor before a wall.

Axes as a camera's: +x right, +y down, +z away from the cameras; the floor is the plane y = 1, the wall z = 3.  A
striped ball, a ring and a box stand between them: texture, occlusion, and depths from about 2.5 to 8.
Every surface is tiled with flat Gaussians: normal along the surface, tangential scales from the area that each covers.
The cameras stand on an arc and look at the middle; the pictures are renders of the Gaussians, over black.
"""

from dataclasses import dataclass
from functools import partial
from math import cos, pi, sin, sqrt
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from landscape.errors import InputError
from landscape.results import ShortRepr
from splat.model.camera import Camera, look_at
from splat.model.gaussians import Gaussians
from splat.model.harmonics import Y00
from splat.render.render import Rendering, render
from splat.scenes.scene import Scene
from splat.scenes.view import Frame, Points, View, inside_image, pixel_coordinates

GOLDEN = (1 + sqrt(5)) / 2
FLOOR, WALL = 1.0, 3.0
TARGET = (0.0, 0.3, 0.4)


@dataclass(frozen=True)
class SyntheticSettings:
    """gaussians: about how many (each surface rounds its share).  arc: degrees that the cameras span.

    point_share: share of the Gaussians seen by two views that become points; point_noise: their error, in units of the
    Gaussian's largest scale.  InputError where a value is out of its range.

    >>> SyntheticSettings(views=3).width
    120
    """

    gaussians: int = 1600
    views: int = 12
    width: int = 120
    height: int = 90
    arc: float = 32.0
    sh_degree: int = 1
    point_share: float = 0.6
    point_noise: float = 0.3
    seed: int = 0

    def __post_init__(self) -> None:
        if self.gaussians < 50 or self.views < 2 or min(self.width, self.height) < 8:
            raise InputError(f"expected at least 50 Gaussians, 2 views and 8 x 8 pixels, got {self}")
        if not (0 < self.arc < 150 and 0 < self.point_share <= 1 and self.point_noise >= 0):
            raise InputError(f"expected 0 < arc < 150, 0 < point_share <= 1 and point_noise >= 0, got {self}")


@dataclass(frozen=True, eq=False, repr=False)
class SyntheticScene(ShortRepr):
    """The scene as a loader would give it, and the Gaussians that it was rendered from."""

    scene: Scene
    truth: Gaussians


@dataclass(frozen=True, eq=False)
class Surface:
    """Samples of a surface: where, outward normal, colour; area: world units squared."""

    xyz: Float[Tensor, "n 3"]
    normal: Float[Tensor, "n 3"]
    rgb: Float[Tensor, "n 3"]
    area: float


def synthetic_scene(settings: SyntheticSettings = SyntheticSettings()) -> SyntheticScene:
    """Build the Gaussians and render every view.  The same settings give the same scene.

    >>> made = synthetic_scene(SyntheticSettings(gaussians=50, views=2, width=16, height=12))
    >>> made.scene.names, 45 < len(made.truth) < 55
    (('images/view_000.png', 'images/view_001.png'), True)
    """
    generator = torch.Generator().manual_seed(settings.seed)
    shares = {_floor: 0.36, _wall: 0.22, _ball: 0.16, _ring: 0.12, _box: 0.14}  # of the Gaussians
    surfaces = [build(round(share * settings.gaussians), generator) for build, share in shares.items()]
    truth = _gaussians(surfaces, settings.sh_degree, generator)
    cameras = _arc_of_cameras(settings)
    with torch.no_grad():
        renderings = [render(truth, camera, depth=True) for camera in cameras]
    frames = []
    for i, (camera, rendering) in enumerate(zip(cameras, renderings)):
        name = f"images/view_{i:03d}.png"
        frames.append(Frame(name, camera, partial(View, name, image=rendering.image.clamp(0, 1))))
    points = _points(truth, frames, renderings, settings, generator)
    scene = Scene("synthetic", Path("synthetic"), "synthetic", tuple(frames), points, torch.zeros(3))
    return SyntheticScene(scene, truth)


def _lattice(n: int, generator: torch.Generator) -> Float[Tensor, "n 2"]:
    """n evenly spread places in the unit square (Kronecker lattice of the golden ratio), shaken a little."""
    i = torch.arange(n, dtype=torch.float64)
    even = torch.stack([(i + 0.5) / n, (i / GOLDEN + 0.5) % 1], dim=-1)
    return (even + (torch.rand(n, 2, generator=generator, dtype=torch.float64) - 0.5) * 0.3 / sqrt(n)).clamp(0, 1)


def _mix(pattern: Tensor, first: tuple[float, float, float], second: tuple[float, float, float]) -> Tensor:
    a, b = (torch.tensor(colour, dtype=torch.float64) for colour in (first, second))
    return a + (b - a) * pattern[:, None].to(torch.float64)


def _vector(x: float, y: float, z: float) -> Float[Tensor, "3"]:
    return torch.tensor([x, y, z], dtype=torch.float64)


def _parallelogram(
    n: int, generator: torch.Generator, corner: Tensor, u: Tensor, v: Tensor
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"], Float[Tensor, "n 2"], float]:
    """Places corner + s u + t v, the unit normal at each, their (s, t), and the area."""
    st = _lattice(n, generator)
    normal = torch.linalg.cross(u, v)
    area = float(normal.norm())
    return corner + st[:, :1] * u + st[:, 1:] * v, (normal / area).expand(n, 3), st, area


def _floor(n: int, generator: torch.Generator) -> Surface:
    corner, across, away = _vector(-4.2, FLOOR, -1.8), _vector(8.4, 0, 0), _vector(0, 0, WALL + 1.8)
    xyz, normal, _, area = _parallelogram(n, generator, corner, across, away)
    cells = torch.floor(xyz[:, 0] / 0.9) + torch.floor(xyz[:, 2] / 0.9)
    return Surface(xyz, normal, _mix(cells % 2, (0.86, 0.82, 0.72), (0.28, 0.34, 0.42)), area)


def _wall(n: int, generator: torch.Generator) -> Surface:
    corner, across, down = _vector(-5, FLOOR - 4.5, WALL), _vector(10, 0, 0), _vector(0, 4.5, 0)
    xyz, normal, st, area = _parallelogram(n, generator, corner, across, down)
    wave = 0.5 + 0.5 * torch.sin(4 * pi * st[:, 0]) * torch.cos(2 * pi * st[:, 1])
    return Surface(xyz, normal, _mix(wave, (0.25, 0.42, 0.62), (0.80, 0.62, 0.50)), area)


def _ball(n: int, generator: torch.Generator) -> Surface:
    s, t = _lattice(n, generator).unbind(-1)
    height, angle, radius = 1 - 2 * s, 2 * pi * t, 0.65
    ring = (1 - height * height).sqrt()
    normal = torch.stack([ring * torch.cos(angle), height, ring * torch.sin(angle)], dim=-1)
    stripes = torch.sin(9 * normal[:, 1] + 3 * normal[:, 0]) > 0
    xyz = _vector(-0.75, FLOOR - radius, 0.2) + radius * normal
    return Surface(xyz, normal, _mix(stripes, (0.85, 0.2, 0.16), (0.96, 0.85, 0.3)), 4 * pi * radius**2)


def _ring(n: int, generator: torch.Generator) -> Surface:
    around, tube = (2 * pi * _lattice(n, generator)).unbind(-1)
    radius, thickness = 0.75, 0.22
    out = torch.stack([torch.cos(around), torch.sin(around), torch.zeros_like(around)], dim=-1)
    normal = torch.cos(tube)[:, None] * out + torch.sin(tube)[:, None] * _vector(0, 0, 1)
    xyz = _vector(0.75, FLOOR - radius - thickness, 1.3) + radius * out + thickness * normal
    rgb = _mix(torch.cos(6 * around) > 0, (0.16, 0.55, 0.38), (0.72, 0.88, 0.62))
    return Surface(xyz, normal, rgb, 4 * pi**2 * radius * thickness)


def _box(n: int, generator: torch.Generator) -> Surface:
    """The front, the top and the two sides of a cube on the floor, turned a little."""
    side, turn = 0.7, pi / 7
    x, z, down = _vector(cos(turn), 0, sin(turn)), _vector(-sin(turn), 0, cos(turn)), _vector(0, 1, 0)
    corner = _vector(0.45, FLOOR - side, -0.6)
    faces = [(corner, x, down), (corner, z, x), (corner, down, z), (corner + side * x, z, down)]
    parts = [_parallelogram(n // 4, generator, start, side * u, side * v)[:3] for start, u, v in faces]
    xyz, normal, st = (torch.cat(values) for values in zip(*parts))
    dots = (st - 0.5).norm(dim=1) < 0.3
    return Surface(xyz, normal, _mix(dots, (0.36, 0.24, 0.58), (0.93, 0.93, 0.96)), 4 * side * side)


def _gaussians(surfaces: list[Surface], sh_degree: int, generator: torch.Generator) -> Gaussians:
    """Flat Gaussians along the surfaces; the higher bands tint the colour a little with direction."""
    xyz, normal, rgb = (torch.cat([getattr(s, name) for s in surfaces]) for name in ("xyz", "normal", "rgb"))
    n = len(xyz)
    spacing = torch.cat([torch.full((len(s.xyz),), sqrt(s.area / len(s.xyz)), dtype=torch.float64) for s in surfaces])
    spread = 1 + 0.2 * (torch.rand(n, 3, generator=generator, dtype=torch.float64) - 0.5)
    sh = 0.04 * torch.randn(n, (sh_degree + 1) ** 2, 3, generator=generator, dtype=torch.float64)
    sh[:, 0] += (rgb - 0.5) / Y00
    attributes = {
        "means": xyz,
        "log_scales": (spacing[:, None] * torch.tensor([0.55, 0.55, 0.08], dtype=torch.float64) * spread).log(),
        "quats": _rotation_to(normal),
        "opacity_logits": 2.5 + 0.5 * torch.randn(n, generator=generator, dtype=torch.float64),
        "sh": sh,
    }
    return Gaussians.pack(attributes).to(torch.float32)


def _rotation_to(normal: Float[Tensor, "n 3"]) -> Float[Tensor, "n 4"]:
    """Unit quaternions (w x y z) that take e_z to the normals: the half-way rotation (1 + n_z, e_z x n)."""
    x, y, z = normal.unbind(-1)
    half = torch.stack([1 + z, -y, x, torch.zeros_like(z)], dim=-1)
    opposite = torch.tensor([0.0, 1.0, 0.0, 0.0], dtype=normal.dtype)  # n = -e_z: half a turn about x
    half = torch.where((z < -1 + 1e-9)[:, None], opposite, half)
    return half / half.norm(dim=1, keepdim=True)


def _arc_of_cameras(settings: SyntheticSettings) -> list[Camera]:
    """Cameras on an arc before the scene, rising and sinking a little, all looking at its middle."""
    target, down = _vector(*TARGET), _vector(0, 1, 0)
    focal = 1.1 * settings.width
    cameras = []
    for i in range(settings.views):
        place = i / (settings.views - 1) - 0.5
        angle = settings.arc * pi / 180 * place
        offset = _vector(sin(angle), -0.3 + 0.1 * cos(3 * pi * place), -cos(angle))
        centre = target + 4.6 * offset
        rotation = look_at(centre, target, down)
        size = settings.width, settings.height
        cameras.append(Camera(rotation, centre, focal, focal, size[0] / 2, size[1] / 2, *size))
    return cameras


def _points(
    truth: Gaussians,
    frames: list[Frame],
    renderings: list[Rendering],
    settings: SyntheticSettings,
    generator: torch.Generator,
) -> Points:
    """Points as structure from motion might find them: a noisy share of the centres, with the views that see each."""
    means = truth.means.double()
    scale = truth.log_scales.double().exp().amax(dim=1)
    visible = torch.stack([_unoccluded(f.camera, means, scale, r) for f, r in zip(frames, renderings)], dim=1)
    candidates = (visible.sum(dim=1) >= 2).nonzero()[:, 0]
    order = torch.randperm(len(candidates), generator=generator)
    chosen = candidates[order[: round(settings.point_share * len(candidates))]].sort().values
    noise = torch.randn(len(chosen), 3, generator=generator, dtype=torch.float64)
    xyz = means[chosen] + settings.point_noise * scale[chosen, None] * noise
    rgb = (0.5 + Y00 * truth.sh[chosen, 0]).clamp(0, 1)
    return Points(xyz, rgb, visible[chosen].nonzero(), tuple(frame.name for frame in frames))


def _unoccluded(camera: Camera, xyz: Tensor, scale: Tensor, rendering: Rendering) -> Tensor:
    """Inside the image and no more than its own size behind the surface that the picture shows there."""
    assert rendering.depth is not None
    pixel, z = pixel_coordinates(camera, xyz)
    inside = inside_image(camera, xyz)
    column = pixel[:, 0].clamp(0, camera.width - 1).long()
    row = pixel[:, 1].clamp(0, camera.height - 1).long()
    surface = (rendering.depth / rendering.alpha.clamp_min(1e-6))[row, column]
    return inside & (z < surface + 2 * scale)
