"""The viewer: the splat in the browser, by viser, in the colours of any field of its Gaussians.

    field       what colours the splats; the ends of its scale, and which splats are shown, are percentiles
    cameras     the training views, with their photographs; the chosen one is rendered by our own renderer
    click       the splat with most weight in the pixel there, again by our own renderer: outlined, and its numbers
    e₁, e₂      steps along the steepest directions of a probe beside the checkpoint: splats, render and loss there

viser's covariances are float16, so the scene is moved and scaled until its Gaussians lie within RADIUS.  Its colours are those
of the constant band.
"""

from collections.abc import Mapping
from dataclasses import replace
from threading import Lock
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from analysis.commands.map.fields import Fields, in_words
from analysis.commands.map.pictures import rendered
from analysis.measures.units import UNITS
from analysis.records.quantities import Shade, percent, quantity
from landscape.errors import InputError
from splat.curvature.fields import Field
from splat.curvature.objective import SceneObjective
from splat.model.camera import Camera, look_at
from splat.model.gaussians import Gaussians
from splat.model.harmonics import Y00
from splat.projection.antialias import baked
from splat.projection.reference import rotation_matrices
from splat.render.sight import sight
from splat.scenes.write import bytes_of

APPEARANCE = "appearance"
RADIUS, WITHIN = 20.0, 0.95  # viser's units, and the share of the Gaussians that lies within
LARGEST = 6e4  # of a covariance, just below the end of float16
NARROW = 2000.0  # focal length of a click's pixel, px
OUTLINE, SEGMENTS = 2.0, 48  # of a picked splat: standard deviations, and of each of its three rings
MARK = (213, 94, 0)  # vermilion


class Frame:
    """viser's coordinates: (x - centre) scale."""

    def __init__(self, gaussians: Gaussians) -> None:
        means = gaussians.means.double()
        self.centre = means.median(dim=0).values
        distance = np.quantile((means - self.centre).norm(dim=1).numpy(), WITHIN)
        self.scale = RADIUS / max(float(distance), 1e-12)

    def place(self, points: Tensor) -> np.ndarray:
        return ((points.double() - self.centre) * self.scale).numpy()

    def back(self, point: Any) -> Tensor:
        return torch.tensor(point, dtype=torch.float64) / self.scale + self.centre

    def axes(self, gaussians: Gaussians) -> Tensor:
        """[n, 3, 3]: the standard deviations along the axes of each, in columns."""
        gaussians = baked(gaussians)
        return (
            rotation_matrices(gaussians.quats.double()) * (gaussians.log_scales.double().exp() * self.scale)[:, None, :]
        )

    def splats(self, gaussians: Gaussians) -> dict[str, np.ndarray]:
        """centers and covariances, float32, that float16 can hold."""
        axes = self.axes(gaussians)
        covariances = (axes @ axes.mT).clamp(-LARGEST, LARGEST)
        return {"centers": self.place(gaussians.means).astype(np.float32), "covariances": covariances.float().numpy()}

    def outline(self, gaussians: Gaussians, index: int) -> np.ndarray:
        """[m, 2, 3]: the segments of a Gaussian's rings around its three axes, OUTLINE standard deviations from its centre."""
        first = OUTLINE * self.axes(gaussians)[index].mT  # a row an axis
        turn = torch.linspace(0, 2 * torch.pi, SEGMENTS + 1, dtype=first.dtype)[:, None]
        rings = turn.cos() * first[:, None] + turn.sin() * first.roll(-1, 0)[:, None]
        points = self.place(gaussians.means[index]) + rings.numpy()
        return np.stack([points[:, :-1], points[:, 1:]], axis=2).reshape(-1, 2, 3)


class Viewer:
    """The page of one scene."""

    def __init__(self, server: Any, objective: SceneObjective, start: int = 0) -> None:
        """start: place of the training view from which the page is seen at first."""
        self.server, self.objective, self.frame = server, objective, Frame(objective.active)
        self.fields: Fields | None = None
        self.names = {APPEARANCE: APPEARANCE}  # of the fields, by what they are in words
        self.steps: Mapping[str, tuple[Tensor, float]] = {}
        self.sliders: dict[str, Any] = {}
        self.picked: tuple[int, float] | None = None  # a Gaussian in sight, and its share of the pixel
        self._drawing = Lock()  # callbacks come from several threads
        active = objective.active
        self.plain = (0.5 + Y00 * active.sh[:, 0]).clamp(0, 1).float().numpy()
        self.opacities = baked(active).opacity_logits.sigmoid().float().numpy()[:, None]
        look: dict[str, Any] = {"rgbs": self.plain, "opacities": self.opacities}
        self.splats = server.scene.add_gaussian_splats("/splats", **self.frame.splats(active), **look)
        self.mark = server.scene.add_frame("/picked", show_axes=False, visible=False)
        self._add_cameras(start)
        gui = server.gui
        self.field = gui.add_dropdown("field", (APPEARANCE,), hint="What colours the splats.")
        self.legend = gui.add_html("")
        self.scale = gui.add_multi_slider("scale, percentiles", 0.0, 100.0, 0.5, (10.0, 98.0))
        self.ends = gui.add_html("")  # of the scale, as values
        self.shown = gui.add_multi_slider("show, percentiles", 0.0, 100.0, 0.5, (0.0, 100.0))
        self.between = gui.add_html("")  # which values are shown
        for control in (self.field, self.scale, self.shown):
            control.on_update(lambda _: self.recolour())
        self.numbers = gui.add_markdown("Click a splat for its numbers.")
        names = tuple(view.name for view in objective.views)
        self.view = gui.add_dropdown("training view", names, initial_value=names[start])
        self.render = gui.add_image(self._image(active), label="render")
        self.loss = gui.add_markdown(f"loss {quantity(objective.loss(active.flat))}")
        self.view.on_update(lambda _: self.step())
        server.scene.on_click()(lambda event: self.click(event.ray_origin, event.ray_direction))

    def _add_cameras(self, start: int) -> None:
        """The training views; the page's own camera stands in one of them, whose photograph would hide the scene."""
        cameras, scene = [view.camera for view in self.objective.views], self.server.scene
        down = torch.stack([camera.rotation[1] for camera in cameras]).mean(dim=0)
        scene.set_up_direction(tuple((-down).tolist()))
        places = np.stack([self.frame.place(camera.centre) for camera in cameras])
        apart = np.linalg.norm(places - places.mean(axis=0), axis=1).max() or RADIUS / 10
        for view, camera, place in zip(self.objective.views, cameras, places, strict=True):
            turn = Rotation.from_matrix(camera.rotation.T.numpy()).as_quat(scalar_first=True)
            step = -(-max(camera.width, camera.height) // 256)  # small photographs load at once
            scene.add_camera_frustum(
                f"/cameras/{view.name}", fov=2 * float(np.arctan(camera.height / 2 / camera.fy)),
                aspect=camera.width / camera.height, scale=apart / 10,
                image=bytes_of(view.image)[::step, ::step],
                wxyz=turn, position=place, thickness=1.0, thickness_units="screen", visible=camera is not cameras[start],
            )  # fmt: skip
        own, first = cameras[start], self.server.initial_camera
        first.position, first.up = tuple(places[start].tolist()), tuple((-own.rotation[1]).tolist())
        depth = float(((self.objective.active.means.double() - own.centre) @ own.forward).median())
        # which it turns about
        first.look_at = tuple(self.frame.place(own.centre + max(depth, 0.0) * own.forward).tolist())
        first.fov = 2 * float(np.arctan(own.height / 2 / own.fy))

    def add_fields(self, fields: Fields, shown: str) -> None:
        """The drop-down's further entries, once they are measured."""
        words = {APPEARANCE: APPEARANCE} | {name: kind.words for name, kind in fields.kinds.items()}
        if shown not in words:
            raise InputError(
                f"expected a probe with eigenvectors of this checkpoint for --field {shown}, got none; run landscape probe "
                "first"
            )
        self.fields, self.names = fields, {text: name for name, text in words.items()}
        self.field.options = (*self.names,)
        self.field.value = words[shown]
        self.recolour()

    def add_steps(self, steps: Mapping[str, tuple[Tensor, float]]) -> None:
        """A slider for each direction, in curvature units."""
        self.steps = steps
        for name in steps:
            self.sliders[name] = self.server.gui.add_slider(f"step along {name}", -UNITS, UNITS, UNITS / 30, 0.0)
            self.sliders[name].on_update(lambda _: self.step())

    def recolour(self) -> None:
        """The splats' colours, which of them are shown, the legend, and the number of the picked one that comes first."""
        self._tell()
        name = self.names[self.field.value]
        if self.fields is None or name == APPEARANCE:
            self.splats.rgbs, self.splats.opacities = self.plain, self.opacities
            self.legend.content = self.ends.content = self.between.content = ""
            return
        kind, values = self.fields.kinds[name], self.fields.values[name].numpy()
        ends = (float(self.scale.value[0]), float(self.scale.value[1]))
        shade = Shade.of(name, kind.words, kind.unit, kind.scale, values, self.fields.weight, ends)
        known = values[np.isfinite(values)]
        low, high = np.percentile(known, self.shown.value) if len(known) else (0.0, 0.0)
        everything = tuple(self.shown.value) == (0, 100)
        inside = np.ones(len(values), bool) if everything else (values >= low) & (values <= high)
        self.splats.rgbs = shade.colours_of(values)
        self.splats.opacities = self.opacities * inside[:, None]
        self.legend.content = _small(f"{shade.title}{shade.legend}")
        self.ends.content = _small(f"colours {_range(kind, shade.value(shade.low), shade.value(shade.high))}")
        some = "all" if everything else f"{inside.sum():,} of {len(values):,}"
        self.between.content = _small(f"{some} splats, {_range(kind, float(low), float(high))}")

    def step(self) -> None:
        """The splats, the render of the chosen view and the loss where the sliders are."""
        with self._drawing:
            there = self._here()
            self.splats.set_gaussians(
                **self.frame.splats(there), rgbs=self.splats.rgbs.copy(), opacities=self.splats.opacities.copy()
            )
            self._mark(there)
            self.render.image = self._image(there)
            self.loss.content = f"loss {quantity(self.objective.loss(there.flat))}"

    def _here(self) -> Gaussians:
        """The Gaussians where the sliders are."""
        flat = self.objective.active.flat.clone()
        for name, (vector, reach) in self.steps.items():
            flat += self.sliders[name].value / UNITS * reach * vector.to(flat)
        return self.objective.active.with_flat(flat)

    def _image(self, gaussians: Gaussians) -> np.ndarray:
        place = [view.name for view in self.objective.views].index(self.view.value)
        return bytes_of(rendered(self.objective, place, gaussians))

    def click(self, origin: Any, direction: Any) -> None:
        """Pick the splat at a ray, in viser's coordinates."""
        self.picked = heaviest_on_ray(
            self.objective, self.frame.back(origin), torch.tensor(direction, dtype=torch.float64)
        )
        if self.picked is None:
            self.numbers.content = "Nothing there."
        self._tell()
        with self._drawing:
            self._mark(self._here())

    def _tell(self) -> None:
        if self.picked is not None:
            self.numbers.content = self.told(*self.picked)

    def _mark(self, gaussians: Gaussians) -> None:
        """Outline the picked splat where it is now, with its number."""
        self.mark.visible = self.picked is not None
        if self.picked is not None:
            index, scene = self.picked[0], self.server.scene
            scene.add_line_segments(
                "/picked/outline", self.frame.outline(gaussians, index), MARK, thickness=2.0, thickness_units="screen"
            )
            place = tuple(self.frame.place(gaussians.means[index]).tolist())
            words = f"● Gaussian {self._number(index):,}"  # the dot lies on it, above all splats
            scene.add_label("/picked/label", words, position=place, anchor="center-left")

    def _number(self, index: int) -> int:
        """Of a Gaussian in sight, among all."""
        return int(self.objective.mask.nonzero()[index, 0])

    def told(self, index: int, share: float) -> str:
        """A Gaussian in sight, and its share of the pixel: its numbers, that of the field shown first."""
        title = f"**Gaussian {self._number(index):,}**, {percent(share)} of this pixel"
        if self.fields is None:
            return title
        kinds, shown = self.fields.kinds, self.names[self.field.value]
        numbers = {name: in_words(kinds[name], float(self.fields.values[name][index])) for name in kinds}
        pairs = {name: f"gn_{name}" for name in kinds if f"gn_{name}" in kinds}
        single = [name for name in kinds if name not in (shown, *pairs, *pairs.values())]
        lines = [title, "", *(f"**{kinds[name].words}: {numbers[name]}**" for name in (shown,) if name in kinds), ""]
        lines += [f"- {kinds[name].words}: {numbers[name]}" for name in single]
        lines += ["", "| | Hessian | Gauss-Newton |", "| --- | --- | --- |"]
        lines += [f"| {kinds[a].words} | {numbers[a]} | {numbers[b]} |" for a, b in pairs.items()]
        return "\n".join(lines)


def _range(kind: Field, low: float, high: float) -> str:
    return f"from {in_words(replace(kind, unit=''), low)} to {in_words(kind, high)}"


def _small(text: str) -> str:
    return f'<div style="padding:0 1em;font-size:.85em">{text}</div>'


def heaviest_on_ray(objective: SceneObjective, origin: Tensor, direction: Tensor) -> tuple[int, float] | None:
    """The Gaussian with most weight in the pixel of a camera of one pixel along a ray, and this weight; None: there is none."""
    aside = torch.eye(3, dtype=torch.float64)[int(direction.abs().argmin())]
    camera = Camera(look_at(origin, origin + direction, aside), origin, NARROW, NARROW, 0.5, 0.5, 1, 1)
    weight = sight(objective.active, camera, objective.settings).weight
    best = int(weight.argmax())
    return (best, float(weight[best])) if weight[best] > 0 else None
