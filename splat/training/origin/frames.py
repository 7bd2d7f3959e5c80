"""The worlds of trainers that do not keep the scene's: similarities that move the cameras to where the Gaussians are.

    x' = s Q x + t,   as the (3, 4) matrix [s Q | t], from the world of the scene's files to the world of the Gaussians

The cameras are moved and never the Gaussians, whose harmonics would have to be rotated and whose parameters would no longer be
the trained ones.

scene        none
gsplat       `simple_trainer` normalises: up becomes -y (the mean of the cameras' up axes, by the shortest turn), the median of
             the points of the optical axes nearest to the origin becomes the origin, the median distance of the cameras 1; then
             the median of the points becomes the origin and their principal axes x, y, z, by falling variance
             (gsplat, examples/datasets/normalize.py and colmap.py).  It is not stored, and the signs of the axes are those of
             an eigenvalue solver: `gsplat_frames` are the four that are possible
nerfstudio   `dataparser_transforms.json`: x' = scale (transform x), from the world before the `applied_transform` and the
             `applied_scale` of a transforms.json
near         x' = x - c, c the middle of the cameras, where they are so far from the scene's origin (in coordinates of a map)
             that float32 moves pixels, see `shift_to_origin`
"""

from collections.abc import Sequence
from dataclasses import replace
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from landscape.errors import InputError
from splat.model.camera import Camera, common_target
from splat.model.untrusted import loose_json
from splat.scenes.formats.transforms import SINGLE_FILE
from splat.scenes.scene import Scene
from splat.scenes.view import Frame

Similarity = Float[np.ndarray, "3 4"]
HALF_TURNS = ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))
NERFSTUDIO_FILE = "dataparser_transforms.json"
LARGEST_ROUNDING = 1e-3  # px
ROUND_OFF = 1e-4  # of a rotation that was stored in single precision


def shift_to_origin(scene: Scene) -> Similarity | None:
    """The shift of a scene whose world float32 cannot hold; None where it can.

    Numbers of float32 at |c| from the origin are eps |c| apart.  At the scene's depth z, through a focal length of f pixels,
    this is eps |c| f / z pixels.  Allowed are 1e-3, as much as Adam's last steps of positions move a splat where cameras
    surround the scene (`LearningRates.position_final`).  c is rounded to float32, so that the shift itself rounds nothing.
    """
    cameras = [frame.camera for frame in scene.frames]
    centres = torch.stack([camera.centre for camera in cameras])
    middle = centres.mean(dim=0)
    place = common_target(cameras) if scene.points is None else scene.points.xyz.median(dim=0).values
    away = centres - (middle if place is None else place)
    focal = max(camera.fx for camera in cameras)
    apart = torch.finfo(torch.float32).eps * float(middle.norm()) * focal
    if apart <= LARGEST_ROUNDING * float(away.norm(dim=1).median()):
        return None
    return np.column_stack([np.eye(3), -middle.float().double().numpy()])


def shift_of(similarity: Sequence[Sequence[float]] | None) -> list[float] | None:
    """The c of a world that is moved by -c and nothing else; None of any other."""
    if similarity is None or any(row[:3] != unit for row, unit in zip(similarity, np.eye(3).tolist())):
        return None
    return [-row[3] for row in similarity]


def shift_in_words(shift: Sequence[float]) -> str:
    """Note on a world that is moved."""
    size = np.linalg.norm(shift)
    step = torch.finfo(torch.float32).eps * size
    return (
        f"the world is moved by -({', '.join(f'{each:.9g}' for each in shift)}) to its cameras: {size:.3g} from the origin, "
        f"numbers of float32 are {step:.1g} apart; positions of Gaussians are in the moved world"
    )


def posed(scene: Scene, similarity: Sequence[Sequence[float]] | None, *, centred: bool) -> Scene:
    """The scene with its cameras and points moved.  centred: with the principal points in the images' middles."""
    if similarity is None and not centred:
        return scene
    world = None if similarity is None else np.array(similarity)
    points, notes, shift = scene.points, scene.notes, shift_of(similarity)
    if points is not None and world is not None:
        matrix = torch.from_numpy(world)
        points = replace(points, xyz=points.xyz @ matrix[:, :3].T + matrix[:, 3])
    if shift is not None:
        notes = (*notes, shift_in_words(shift))
    return replace(
        scene, frames=tuple(_posed(frame, world, centred) for frame in scene.frames), points=points, notes=notes
    )


def _posed(frame: Frame, similarity: Similarity | None, centred: bool) -> Frame:
    camera, scale = frame.camera, 1.0
    if similarity is not None:
        scale = np.cbrt(np.linalg.det(similarity[:, :3]))
        camera = moved(camera, similarity, scale)
    if centred:
        camera = replace(camera, cx=camera.width / 2, cy=camera.height / 2)
    depths = frame.depth_range and (scale * frame.depth_range[0], scale * frame.depth_range[1])
    return replace(frame, camera=camera, depth_range=depths)


def moved(camera: Camera, similarity: Similarity, scale: float) -> Camera:
    """R' = R Q^T, c' = s Q c + t."""
    turn, shift = torch.from_numpy(similarity[:, :3] / scale), torch.from_numpy(similarity[:, 3].copy())
    return replace(camera, rotation=camera.rotation @ turn.T, centre=scale * turn @ camera.centre + shift)


def gsplat_frames(scene: Scene) -> list[Similarity]:
    """The four normalisations that differ by half a turn.  InputError where the scene has too few points for axes."""
    if scene.points is None or len(scene.points) < 4:
        raise InputError(
            f"expected a scene with points in {scene.root}, by whose axes gsplat normalises the world, got none; with "
            "--normalize-world-space off in the training, take --trained-by gsplat-raw"
        )
    first = _from_cameras([frame.camera for frame in scene.frames])
    points = scene.points.xyz.numpy() @ first[:, :3].T + first[:, 3]
    middle = np.median(points, axis=0)
    _, axes = np.linalg.eigh(np.cov(points, rowvar=False))
    axes = axes[:, ::-1].copy()
    axes[:, 0] *= np.sign(np.linalg.det(axes))
    whole = np.column_stack([axes.T @ first[:, :3], axes.T @ (first[:, 3] - middle)])
    return [np.diag(signs) @ whole for signs in HALF_TURNS]


def _from_cameras(cameras: Sequence[Camera]) -> Similarity:
    """gsplat's first step: up, focus and size of the cameras."""
    up = -torch.stack([camera.rotation[1] for camera in cameras]).mean(dim=0).numpy()
    up = up / np.linalg.norm(up)
    cross = np.cross(up, [0.0, -1.0, 0.0])
    if not -up[1] > -1 + 1e-9:
        raise InputError("expected cameras whose up is not +y, which gsplat mirrors instead of turning")
    skew = np.array([[0, -cross[2], cross[1]], [cross[2], 0, -cross[0]], [-cross[1], cross[0], 0]])
    turn = np.eye(3) + skew + skew @ skew / (1 - up[1])
    centres = torch.stack([camera.centre for camera in cameras]).numpy() @ turn.T
    forward = torch.stack([camera.forward for camera in cameras]).numpy() @ turn.T
    nearest = centres - (forward * centres).sum(axis=1, keepdims=True) * forward
    shift = -np.median(nearest, axis=0)
    scale = 1 / np.median(np.linalg.norm(centres + shift, axis=1))
    return scale * np.column_stack([turn, shift])


def nerfstudio_frame(checkpoint: Path, scene: Scene) -> Similarity:
    """Similarity from the file in the checkpoint's folder or the one above.  InputError where there is none, or not one."""
    for path in (checkpoint.parent / NERFSTUDIO_FILE, checkpoint.resolve().parent.parent / NERFSTUDIO_FILE):
        if path.is_file():
            break
    else:
        raise InputError(
            f"expected nerfstudio's {NERFSTUDIO_FILE} beside {checkpoint} or in the folder above, found none"
        )
    content = _json(path)
    try:
        rigid, scale = np.array(content["transform"], dtype=np.float64), float(content["scale"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"expected a transform and a scale in {path} ({error!r})") from error
    similarity = scale * _rigid(rigid, path)
    original = scene.root / SINGLE_FILE
    values = _json(original) if scene.kind == "transforms" and original.is_file() else {}
    if (applied_scale := values.get("applied_scale", 1.0)) != 1.0:
        if not (isinstance(applied_scale, int | float) and 0 < applied_scale < inf):
            raise InputError(f"expected an applied_scale above 0 in {original}, got {applied_scale!r}")
        similarity = similarity / applied_scale
    if "applied_transform" in values:
        try:
            applied = _rigid(np.array(values["applied_transform"], dtype=np.float64), original)
        except (TypeError, ValueError) as error:
            raise InputError(f"expected an applied_transform of 3 x 4 numbers in {original} ({error})") from error
        turn = similarity[:, :3] @ applied[:, :3].T
        similarity = np.column_stack([turn, similarity[:, 3] - turn @ applied[:, 3]])
    return similarity


def _json(path: Path) -> dict[str, Any]:
    try:
        content = loose_json(path.read_text(encoding="utf-8"))
    except (ValueError, OSError, RecursionError) as error:
        raise InputError(f"expected a JSON file, cannot read {path}: {error}") from error
    return content if isinstance(content, dict) else {}


def _rigid(matrix: np.ndarray, path: Path) -> Similarity:
    matrix = np.atleast_1d(matrix)[:3]
    good = matrix.shape == (3, 4) and np.isfinite(matrix).all()
    if (
        not good
        or np.abs(matrix[:, :3] @ matrix[:, :3].T - np.eye(3)).max() > ROUND_OFF
        or np.linalg.det(matrix[:, :3]) < 0
    ):
        raise InputError(f"expected a rotation and a shift, 3 x 4, in {path}, got {matrix.tolist()!r}"[:300])
    u, _, v = np.linalg.svd(matrix[:, :3])
    return np.column_stack([u @ v, matrix[:, 3]])
