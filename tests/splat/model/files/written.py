"""Files of Gaussians by the documented layouts of the tools, written without the source: name -> bytes.

References: graphdeco `scene/gaussian_model.py` (save_ply, capture), gsplat `examples/simple_trainer.py` and `exporter.py`,
nerfstudio `models/splatfacto.py`, Brush `brush-serde/src/export.rs`, Mip-Splatting `scene/gaussian_model.py`, antimatter15
`convert.py`, Niantic `load-spz.cc`, PlayCanvas `splat-transform`.
"""

import gzip
import io
import struct
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from splat.model.gaussians import Gaussians
from tests.splat.tiny import tiny_gaussians

N = 40


def scene(sh_degree: int = 3, n: int = N) -> Gaussians:
    return tiny_gaussians(n, seed=5, sh_degree=sh_degree)


def parts(gaussians: Gaussians) -> dict[str, np.ndarray]:
    return {name: value.numpy() for name, value in gaussians.attributes.items()}


def ply(columns: dict[str, np.ndarray], comments: tuple[str, ...] = (), order: str = "<", kind: str = "f4") -> bytes:
    """A vertex element of these columns."""
    n, name = len(next(iter(columns.values()))), {"f4": "float", "f8": "double"}[kind]
    body = np.stack(list(columns.values()), axis=1).astype(order + kind)
    form = {"<": "binary_little_endian", ">": "binary_big_endian", "": "ascii"}[order]
    text = "".join(" ".join(repr(float(x)) for x in row) + "\n" for row in body)
    rows = body.tobytes() if order else text.encode()
    header = f"ply\nformat {form} 1.0\n" + "".join(f"comment {c}\n" for c in comments) + f"element vertex {n}\n"
    return (header + "".join(f"property {name} {c}\n" for c in columns) + "end_header\n").encode() + rows


def columns(gaussians: Gaussians, *, normals: bool = True) -> dict[str, np.ndarray]:
    """graphdeco's, in its order."""
    p, n = parts(gaussians), len(gaussians)
    found = {axis: p["means"][:, i] for i, axis in enumerate("xyz")}
    if normals:
        found |= {f"n{axis}": np.zeros(n) for axis in "xyz"}
    found |= {f"f_dc_{c}": p["sh"][:, 0, c] for c in range(3)}
    bands = p["sh"].shape[1] - 1
    found |= {f"f_rest_{c * bands + k}": p["sh"][:, 1 + k, c] for c in range(3) for k in range(bands)}
    found |= {"opacity": p["opacity_logits"]} | {f"scale_{i}": p["log_scales"][:, i] for i in range(3)}
    return found | {f"rot_{i}": p["quats"][:, i] for i in range(4)}


def brush(gaussians: Gaussians) -> bytes:
    found = columns(gaussians, normals=False)
    rank = {name: i for i, name in enumerate(("scale", "opacity", "rot", "f_dc", "f_rest"))}
    order = sorted(found, key=lambda name: rank.get(name.rpartition("_")[0] or name, -1))
    comments = ("Exported from Brush", "SH degree: 3", "SplatRenderMode: default")
    return ply({name: found[name] for name in order}, comments)


def stored(path: Path, content: bytes) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    return path


def saved(content: object) -> bytes:
    buffer = io.BytesIO()
    torch.save(content, buffer)
    return buffer.getvalue()


def graphdeco_pth(gaussians: Gaussians, active: int = 3) -> bytes:
    a = {name: torch.nn.Parameter(value.clone()) for name, value in gaussians.attributes.items()}
    dc, rest = (torch.nn.Parameter(a["sh"].data[:, s].clone()) for s in (slice(0, 1), slice(1, None)))
    opacity, n = torch.nn.Parameter(a["opacity_logits"].data[:, None].clone()), len(gaussians)
    optimizer = torch.optim.Adam([{"params": [a["means"]], "lr": 1e-4, "name": "xyz"}], lr=0.0, eps=1e-15)
    a["means"].grad = torch.ones_like(a["means"])
    optimizer.step()
    a["means"].data.copy_(gaussians.means)
    captured = (active, a["means"], dc, rest, a["log_scales"], a["quats"], opacity, torch.zeros(n), torch.zeros(n, 1))
    return saved(((*captured, torch.zeros(n, 1), optimizer.state_dict(), np.float64(4.2)), 7000))


def gsplat_pt(gaussians: Gaussians, step: int = 6999) -> bytes:
    g = gaussians
    named = {"means": g.means, "scales": g.log_scales, "quats": g.quats, "opacities": g.opacity_logits}
    named |= {"sh0": g.sh[:, :1], "shN": g.sh[:, 1:]}
    splats = torch.nn.ParameterDict({name: value.clone() for name, value in named.items()})
    return saved({"step": step, "splats": splats.state_dict()})


def splatfacto(gaussians: Gaussians, prefix: str = "_model.gauss_params.") -> bytes:
    g = gaussians
    named = {"means": g.means, "scales": g.log_scales, "quats": g.quats, "opacities": g.opacity_logits[:, None]}
    named |= {"features_dc": g.sh[:, 0], "features_rest": g.sh[:, 1:]}
    pipeline = OrderedDict((prefix + name, value.clone()) for name, value in named.items())
    pipeline["_model.lpips.net.weight"] = torch.zeros(3)
    schedulers = {"means": {"last_lr": [np.float64(1e-6)]}}
    return saved({"step": 29999, "pipeline": pipeline, "schedulers": schedulers, "scalers": {}})


def dot_splat(gaussians: Gaussians) -> bytes:
    """The colours and opacities of 8 bits, linear scales, quaternions as 128 q + 128."""
    p = parts(gaussians)
    opacity = 1 / (1 + np.exp(-p["opacity_logits"]))
    unit = p["quats"] / np.linalg.norm(p["quats"], axis=1, keepdims=True)
    colour = np.clip(0.5 + 0.28209479177387814 * p["sh"][:, 0], 0, 1)
    rgba = np.round(np.concatenate([colour, opacity[:, None]], axis=1) * 255).astype(np.uint8)
    packed = np.clip(np.round(unit * 128 + 128), 0, 255).astype(np.uint8)
    rows = zip(p["means"], np.exp(p["log_scales"]), rgba, packed)
    return b"".join(struct.pack("<6f", *mean, *scale) + bytes(c) + bytes(q) for mean, scale, c, q in rows)


def spz(gaussians: Gaussians, flags: int = 0) -> bytes:
    """Version 2: 24-bit positions (right, up, back), quaternions x y z of 8 bits, colours, harmonics of 8 bits."""
    p, n, degree = parts(gaussians), len(gaussians), gaussians.sh_degree
    fixed = np.round(p["means"] * [1, -1, -1] * 4096).astype(np.int32)
    positions = b"".join(int(v).to_bytes(3, "little", signed=True) for v in fixed.ravel())
    unit = p["quats"] / np.linalg.norm(p["quats"], axis=1, keepdims=True) * np.where(p["quats"][:, :1] < 0, -1, 1)
    unit = unit * [1, 1, -1, -1]
    bands = odd_in_yz()[: p["sh"].shape[1] - 1, None]

    def byte(values: np.ndarray) -> bytes:
        return np.clip(np.round(values), 0, 255).astype(np.uint8).tobytes()

    body = positions + byte(255 / (1 + np.exp(-p["opacity_logits"])))
    body += byte(p["sh"][:, 0] * 0.15 * 255 + 127.5) + byte((p["log_scales"] + 10) * 16)
    body += byte(unit[:, 1:] * 127.5 + 127.5) + byte(p["sh"][:, 1:] * bands * 128 + 128)
    return gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", 2, n, degree, 12, flags, 0) + body)


def odd_in_yz() -> np.ndarray:
    """Sign of each harmonic above the constant one when y and z change theirs, by the number of y and z in its polynomial."""
    polynomials = ["y", "z", "x", "xy", "yz", "zz", "xz", "xx", "yxx", "xyz", "yzz", "zzz", "xzz", "zxx", "xxx"]
    return np.array([(-1.0) ** sum(p.count(axis) for axis in "yz") for p in polynomials])


FILES: dict[str, Callable[[], bytes]] = {
    "point_cloud.ply": lambda: ply(columns(scene())),
    "brush.ply": lambda: brush(scene()),
    "text.ply": lambda: ply(columns(scene(1)), order=""),
    "chkpnt7000.pth": lambda: graphdeco_pth(scene()),
    "ckpt_6999_rank0.pt": lambda: gsplat_pt(scene()),
    "step-000029999.ckpt": lambda: splatfacto(scene()),
    "old.ckpt": lambda: splatfacto(scene(), "_model."),
    "scene.splat": lambda: dot_splat(scene(0)),
}


def zipped(members: dict[str, bytes]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return buffer.getvalue()
