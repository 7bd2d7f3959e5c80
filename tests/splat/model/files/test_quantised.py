"""Rounded files come back within their rounding, labelled; what they promise is compared with what they hold."""

import gzip
import io
import json
import struct

import numpy as np
import pytest
import torch

from splat.model.files.read import read_splats
from splat.model.gaussians import Gaussians
from tests.refusals import refused
from tests.splat.model.files import written
from tests.splat.model.files.written import scene, zipped

HALF_BYTE = 0.5 / 255
BANDS = {"bands": 3, "count": 65536, "codebook": [0.0] * 256, "files": ["quats.webp", "quats.webp"]}


def read(folder, content: bytes, name: str = "scene"):
    (folder / name).write_bytes(content)
    return read_splats(folder / name)


def require_same_rotations(found: torch.Tensor, true: torch.Tensor, cosine: float) -> None:
    """Of half the angle between them; q and -q are the same."""
    unit = torch.nn.functional.normalize
    assert (unit(found, dim=1) * unit(true, dim=1)).sum(dim=1).abs().min() > cosine


def test_dot_splat_comes_back_within_its_bytes(tmp_path):
    found, true = read(tmp_path, written.dot_splat(scene(0)), "a.splat"), scene(0)
    g = found.gaussians
    assert found.lossy and torch.equal(g.means, true.means)
    torch.testing.assert_close(g.log_scales, true.log_scales, rtol=0, atol=1e-6)
    torch.testing.assert_close(g.opacity_logits.sigmoid(), true.opacity_logits.sigmoid(), rtol=0, atol=1.01 * HALF_BYTE)
    require_same_rotations(g.quats, true.quats, 0.9998)


def test_opacities_of_0_and_255_are_moved_inside_and_counted(tmp_path):
    extreme = scene(0)
    extreme.opacity_logits[:3], extreme.opacity_logits[3] = 20.0, -20.0
    found = read(tmp_path, written.dot_splat(extreme), "a.splat")
    assert found.notes == ("4 opacities of 0 or 255 were moved to 0.5 or 254.5",)
    assert torch.isfinite(found.gaussians.flat).all()


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_spz_comes_back_in_the_axes_of_a_ply(tmp_path, degree):
    pytest.importorskip("gsply")
    true = scene(degree)
    true.sh.mul_(0.4)
    found = read(tmp_path, written.spz(true, flags=1))
    g = found.gaussians
    assert found.lossy and found.antialiased
    torch.testing.assert_close(g.means, true.means, rtol=0, atol=0.51 / 4096)
    torch.testing.assert_close(g.log_scales, true.log_scales, rtol=0, atol=0.51 / 16)
    torch.testing.assert_close(g.sh[:, 0], true.sh[:, 0], rtol=0, atol=0.51 / 255 / 0.15)
    torch.testing.assert_close(g.sh[:, 1:], true.sh[:, 1:], rtol=0, atol=0.51 / 128)
    require_same_rotations(g.quats, true.quats, 0.99)
    unturned = found.other_axes  # what a converter that leaves the axes as they are has meant by the same bytes
    assert unturned is not None and torch.equal(unturned.means, g.means * torch.tensor([1.0, -1.0, -1.0]))


def test_compressed_ply_comes_back_in_its_own_order(tmp_path):
    gsply = pytest.importorskip("gsply")
    true = scene(1, 300)
    a = {name: value.numpy() for name, value in true.attributes.items()}
    sh = a.pop("sh")
    content = gsply.compress_to_bytes(gsply.GSData.from_arrays(*a.values(), sh[:, 0], sh[:, 1:], format="ply"))
    found = read(tmp_path, content)
    assert found.lossy and found.format == "compressed PLY" and found.gaussians.sh_degree == 1
    nearest = torch.cdist(found.gaussians.means, true.means).min(dim=1)  # it sorts them along a curve
    assert nearest.values.max() < 0.01 and len(nearest.indices.unique()) == 300
    torch.testing.assert_close(found.gaussians.log_scales, true.log_scales[nearest.indices], rtol=0, atol=0.01)
    refused("cut short", read, tmp_path, content[:-5000])
    refused("PlayCanvas", read, tmp_path, content.replace(b"element chunk 2", b"element chunk 1"))


def sog(true: Gaussians) -> dict[str, bytes]:
    """Version 2 of the bundle's members, with tables that hold 256 even steps."""
    pytest.importorskip("gsply")
    pytest.importorskip("imagecodecs")
    from PIL import Image

    a, n = {name: value.numpy().astype(np.float64) for name, value in true.attributes.items()}, len(true)

    def texture(values: np.ndarray) -> bytes:
        pixels, buffer = np.full((n, 4), 255, np.uint8), io.BytesIO()
        pixels[:, : values.shape[1]] = values
        Image.fromarray(pixels.reshape(1, n, 4)).save(buffer, "WEBP", lossless=True, exact=True)
        return buffer.getvalue()

    logs = np.sign(a["means"]) * np.log1p(np.abs(a["means"]))
    low, high = logs.min(axis=0), logs.max(axis=0)
    fixed = np.round((logs - low) / (high - low) * 65535).astype(np.int64)
    unit = a["quats"] / np.linalg.norm(a["quats"], axis=1, keepdims=True)
    largest = np.abs(unit).argmax(axis=1)
    rest = np.stack([np.delete(q * np.sign(q[i]), i) for q, i in zip(unit, largest)])
    quats = np.column_stack([np.round((rest * 2**0.5 * 0.5 + 0.5) * 255), 252 + largest])
    scales, colours = np.linspace(-4, 2, 256), np.linspace(-3, 3, 256)
    index = np.abs(a["log_scales"][..., None] - scales).argmin(axis=-1)
    dc = np.abs(a["sh"][:, 0, :, None] - colours).argmin(axis=-1)
    alpha = np.round(255 / (1 + np.exp(-a["opacity_logits"])))
    textures = {"means_l": fixed & 255, "means_u": fixed >> 8, "scales": index, "quats": quats}
    textures["sh0"] = np.column_stack([dc, alpha])
    means = {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]}
    meta = {"version": 2, "count": n, "means": means, "quats": {"files": ["quats.webp"]}}
    meta |= {"scales": {"codebook": scales.tolist(), "files": ["scales.webp"]}}
    meta |= {"sh0": {"codebook": colours.tolist(), "files": ["sh0.webp"]}}
    members = {f"{name}.webp": texture(values) for name, values in textures.items()}
    return {"meta.json": json.dumps(meta).encode(), **members}


def test_sog_comes_back_within_its_tables(tmp_path):
    true = scene(0)
    found = read(tmp_path, zipped(sog(true))).gaussians
    torch.testing.assert_close(found.means, true.means, rtol=1e-4, atol=1e-3)
    torch.testing.assert_close(found.log_scales, true.log_scales, rtol=0, atol=0.51 * 6 / 255)
    opacities = (each.opacity_logits.sigmoid() for each in (found, true))
    torch.testing.assert_close(*opacities, rtol=0, atol=1.01 * HALF_BYTE)
    require_same_rotations(found.quats, true.quats, 0.9998)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda meta: meta.update(count=41), "promises 41 Gaussians"),
        (lambda meta: meta.update(count=True), "promises True"),
        (lambda meta: meta.update(version=1), "splat-transform"),
        (lambda meta: meta["scales"]["codebook"].pop(), "256 numbers"),
        (lambda meta: meta["sh0"]["codebook"].__setitem__(3, float("nan")), "256 numbers"),
        (lambda meta: meta["quats"].update(files=["../quats.webp"]), "no .sog, or damaged"),
        (lambda meta: meta.update(model="2dgs"), "surfels"),
        (lambda meta: meta.update(shN=BANDS), "not in its texture"),
    ],
)
def test_a_sog_whose_tables_or_textures_are_too_small_is_refused(tmp_path, change, message):
    members = sog(scene(0))
    meta = json.loads(members["meta.json"])
    change(meta)
    refused(message, read, tmp_path, zipped({**members, "meta.json": json.dumps(meta).encode()}))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ((b"NGSP", 2, 2**31, 0, 12, 0, 0), "promises 2147483648 Gaussians"),
        ((b"NGSP", 2, 5, 4, 12, 0, 0), "SH degree 4"),
        ((b"NGSP", 2, 5, 0, 12, 0, 0), "holds 16"),
        ((b"NGSP", 9, 5, 0, 12, 0, 0), "no .spz of version 1 to 4"),
    ],
)
def test_an_spz_that_promises_what_it_does_not_hold_is_refused(tmp_path, fields, message):
    refused(message, read, tmp_path, gzip.compress(struct.pack("<4sIIBBBB", *fields)))


def test_without_gsply_the_sentence_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "gsply", None)
    refused(r"pip install 'gsply\[spz,sogs\]'", read, tmp_path, written.spz(scene(0)))
