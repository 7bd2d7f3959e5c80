"""Every kind of file that is read, with a good example: it is used as by the commands, to the numbers and pages that follow."""

import json
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from splat.model.gaussians import Gaussians
from splat.scenes.scene import load_scene
from splat.scenes.synthetic import SyntheticSettings, synthetic_scene
from splat.scenes.write import write_transforms_scene
from splat.training.checkpoint import open_subject
from splat.training.origin.options import Foreign
from tests.hostile.broken import Read, Reader
from tests.hostile.mutations import Random
from tests.hostile.records import RECORDS
from tests.splat.model.files import written
from tests.splat.model.files.test_quantised import sog
from tests.splat.scenes import folders
from tests.splat.scenes.formats.test_dtu import write_dtu

# Scenes


def scene(write: Callable[[Path], object], broken: str, at: str = ".", depths: str = "", guarded: str = "") -> Reader:
    """A folder of a scene, whose pictures are read and from whose points a training would start."""

    def use(root: Path, chance: Random) -> Read:
        found = load_scene(root / at, depths=root / depths if depths else None)
        views = found.load()
        for view in views:
            assert torch.isfinite(view.image).all() and 0 <= view.image.min() <= view.image.max() <= 1, "a picture"
        for frame in found.frames:
            assert torch.isfinite(frame.camera.rotation).all() and torch.isfinite(frame.camera.centre).all(), "a pose"
        if found.points is not None:
            assert torch.isfinite(found.points.xyz).all(), "points that are not finite"
            assert (found.points.rgb >= 0).all() and (found.points.rgb <= 1).all(), "colours out of range"
        return [views[0].image]

    return Reader(write, use, broken, guarded)


def _transforms(root: Path) -> None:
    folders.write_transforms(root, k1=0.01, k2=0.0, p1=0.0, p2=0.0, camera_model="OPENCV", background=[0, 0.5, 1])


def _points(root: Path, *, text: bool) -> None:
    folders.write_transforms(root, ply_file_path="points.ply")
    lines = ["ply", f"format {'ascii' if text else 'binary_little_endian'} 1.0", "element vertex 6"]
    lines += [f"property double {axis}" for axis in "xyz"]
    lines += [f"property uchar {colour}" for colour in ("red", "green", "blue")]
    content = "\n".join([*lines, "property list uint int views", "end_header", ""]).encode()
    for xyz, rgb, seen in zip(folders.XYZ[:6], folders.RGB, folders.SEEN):
        if text:
            content += f"{' '.join(map(str, [*xyz.tolist(), *rgb.tolist(), len(seen), *seen]))}\n".encode()
        else:
            content += xyz.astype("<f8").tobytes() + rgb.tobytes() + np.array([len(seen), *seen], "<i4").tobytes()
    (root / "points.ply").write_bytes(content)


def _pictures(root: Path) -> None:
    folders.write_transforms(root)
    content = json.loads((root / "transforms.json").read_text())
    (root / "masks").mkdir()
    (root / "depths").mkdir()
    width, height = folders.SIZE
    inside = np.zeros((height, width), np.uint8)
    inside[4:12, 4:16] = 255
    for i, (frame, suffix) in enumerate(zip(content["frames"], (".png", ".jpg", ".webp"), strict=True)):
        old = root / frame["file_path"]
        Image.open(old).save(old.with_suffix(suffix))
        frame["file_path"] = f"images/{old.stem}{suffix}"
        if suffix != ".png":
            old.unlink()
        Image.fromarray(inside).save(root / f"masks/{old.stem}.png")
        depth = np.linspace(1, 2 + i, height * width).reshape(height, width)
        if i:
            np.save(root / f"depths/{old.stem}.npy", depth.astype(np.float32))
        else:
            Image.fromarray((depth * 1e4).astype(np.uint16)).save(root / f"depths/{old.stem}.png")
    (root / "transforms.json").write_text(json.dumps(content))


# Gaussians of other tools


def model(
    file: str,
    made: Callable[[Gaussians], bytes],
    degree: int = 1,
    beside: dict[str, str] | None = None,
    trained_by: str = "splat-landscape",
    guarded: str = "",
) -> Reader:
    """Gaussians that are the photographs' own, and what their tool lays beside them, opened on their scene as by a probe."""

    def write(root: Path) -> None:
        found = synthetic_scene(SyntheticSettings(gaussians=50, views=4, width=24, height=16))
        write_transforms_scene(found.scene, root / "scene")
        (root / file).parent.mkdir(parents=True, exist_ok=True)
        (root / file).write_bytes(made(found.truth.select(torch.arange(len(found.truth)), degree)))
        for name, text in (beside or {}).items():
            (root / name).write_text(text)

    def use(root: Path, chance: Random) -> Read:
        listed = root / "list.txt" if "list.txt" in (beside or {}) else None
        ask = Foreign(trained_by=trained_by, scene=root / "scene", train_list=listed, guess_views=True)
        subject = open_subject(root / file, ask)
        flat, names = subject.checkpoint.training.gaussians.flat, subject.checkpoint.scene.train
        assert torch.isfinite(flat).all() and set(names) <= {*subject.scene.names}, "a scene that cannot be"
        return [flat]

    return Reader(write, use, " ".join([file, *(beside or {})]), guarded)


def _compressed(gaussians: Gaussians) -> bytes:
    import gsply  # pyright: ignore[reportMissingImports]

    a = written.parts(gaussians)
    columns = (a["means"], a["log_scales"], a["quats"], a["opacity_logits"], a["sh"][:, 0], a["sh"][:, 1:])
    return gsply.compress_to_bytes(gsply.GSData.from_arrays(*columns, format="ply"))


CFG_ARGS = (
    "Namespace(sh_degree=3, eval=True, images='images', resolution=-1, white_background=False, antialiasing=False)"
)
CAMERAS = json.dumps([{"id": i, "img_name": f"view_{i:03d}", "width": 24} for i in range(4)])
FRAME = '{"transform": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]], "scale": 1.0}'
LIST = "images/view_000.png\nimages/view_001.png\n"
PLY = "model/point_cloud/iteration_7/point_cloud.ply"
READERS = {
    "COLMAP, binary": scene(folders.write_colmap, "sparse/0/*"),
    "COLMAP, text": scene(lambda root: folders.write_colmap(root, text=True), "sparse/0/*"),
    "poses_bounds.npy": scene(folders.write_llff, "poses_bounds.npy"),
    "transforms.json": scene(_transforms, "transforms.json"),
    "transforms_train.json, transforms_test.json": scene(
        lambda root: folders.write_blender(root, (0, 1), (2,)), "transforms_t*.json"
    ),
    "DTU's pos_NNN.txt": scene(
        lambda root: write_dtu(root, views=3), "Calibration/cal18/pos_00[123].txt", at="Rectified/scan8"
    ),
    "points.ply": scene(lambda root: _points(root, text=False), "points.ply"),
    "points.ply, text": scene(lambda root: _points(root, text=True), "points.ply"),
    "PNG, JPEG, WebP, mask, depth": scene(
        _pictures, "images/* masks/* depths/*", depths="depths", guarded="images/a.png"
    ),
    "point_cloud.ply, cfg_args, cameras.json": model(
        PLY,
        lambda made: written.ply(written.columns(made)),
        beside={"model/cfg_args": CFG_ARGS, "model/cameras.json": CAMERAS},
    ),
    "Gaussians as text": model("text.ply", lambda made: written.ply(written.columns(made), order="")),
    ".splat, --train-list": model("scene.splat", written.dot_splat, 0, {"list.txt": LIST}),
    "chkpntN.pth": model("chkpnt7.pth", lambda made: written.graphdeco_pth(made, 1), guarded="*.pth"),
    "ckpt_STEP_rankR.pt": model("ckpt_6_rank0.pt", written.gsplat_pt, guarded="*.pt"),
    "step-STEP.ckpt, dataparser_transforms.json": model(
        "step-9.ckpt", written.splatfacto, 1, {"dataparser_transforms.json": FRAME}, "nerfstudio", "*.ckpt"
    ),
    **RECORDS,
}
if find_spec("gsply"):  # an optional package
    READERS |= {
        ".spz": model("scene.spz", written.spz),
        "compressed PLY": model("compressed.ply", _compressed),
        ".sog": model("scene.sog", lambda made: written.zipped(sog(made)), 0),
    }
