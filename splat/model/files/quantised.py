"""Gaussians that were rounded to a few bits, for viewers: .splat, compressed PLY, .spz, .sog.

    .splat           32 bytes each: means and scales as float32, colour and opacity, quaternion (128 q + 128) in 8 bits
    compressed PLY   chunks of 256 with their ranges, 11 or 10 bits a number within them (PlayCanvas)
    .spz             Niantic's: gzip, from version 4 on zstd; its axes y and z point against those of a PLY, but many
                     converters leave them as they are (`SplatFile.other_axes`)
    .sog             a zip of WebP textures (PlayCanvas)

.splat is read here, the others with gsply (an optional package); what they promise is compared with what they have before.
The curvature at such Gaussians is that of the rounded scene, not of the trained one.
"""

import io
import struct
import tempfile
import warnings
import zipfile
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from landscape.errors import InputError, lacks_memory
from splat.model.files.ply import read_header, read_rows
from splat.model.files.splat_file import SplatFile, clamped_note, logit, packed
from splat.model.gaussians import Gaussians
from splat.model.harmonics import Y00, harmonics
from splat.model.untrusted import loose_json, open_image, require_modest

SPLAT = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)])
CHUNK = 256  # Gaussians of a compressed PLY's chunk
AXES, COLOURS = ("x", "y", "z"), ("r", "g", "b")
RANGES = tuple(
    f"{end}_{name}"
    for names in (AXES, [f"scale_{axis}" for axis in AXES], COLOURS)
    for end in ("min", "max")
    for name in names
)
PACKED = tuple(f"packed_{name}" for name in ("position", "rotation", "scale", "color"))
SPZ_HEADER = struct.Struct("<4sIIBBBB")  # magic, version, Gaussians, SH degree, bits of a fraction, flags, reserved
SPZ_MAGIC, GZIP_MAGIC = b"NGSP", b"\x1f\x8b"
LARGEST_TEXTURE = 1 << 24  # pixels
SH_COUNTS = (0, 3, 8, 15)  # bands above the constant one, by degree
MEMBERS = ("means", "scales", "quats", "sh0")
QUATERNION_AXES = (1.0, 1.0, -1.0, -1.0)  # half a turn about x: y and z change their signs


def read_dot_splat(content: bytes) -> SplatFile:
    rows = np.frombuffer(content, SPLAT)
    with np.errstate(all="ignore"):  # what is not finite is refused with all else
        log_scales = np.log(rows["scales"])
    logits, clamped = logit(rows["rgba"][:, 3] / 255)
    attributes = {
        "means": rows["means"],
        "log_scales": log_scales,
        "quats": (rows["quats"].astype(np.float32) - 128) / 128,
        "opacity_logits": logits,
        "sh": ((rows["rgba"][:, None, :3] / 255) - 0.5) / Y00,
    }
    return SplatFile(packed(attributes), ".splat", lossy=True, notes=clamped_note(clamped))


def read_compressed_ply(content: bytes) -> SplatFile:
    """InputError where its elements are not those of the format."""
    header = read_header(content)
    chunk, vertex = header.element("chunk"), header.element("vertex")
    names = [element.name for element in header.elements]
    if names not in (["chunk", "vertex"], ["chunk", "vertex", "sh"]) or header.order != "<":
        raise InputError(f"expected a compressed PLY with chunk, vertex and sh in binary, got {', '.join(names)[:80]}")
    columns = [p.name for p in vertex.properties if p.kind == "u4" and p.count is None]
    ranges = [p.name for p in chunk.properties if p.kind == "f4" and p.count is None]
    if tuple(columns) != PACKED or tuple(ranges) != RANGES or chunk.rows != -(-vertex.rows // CHUNK):
        raise InputError("its chunks are not those of a compressed PLY as PlayCanvas writes it")
    if names[-1] == "sh":
        sh = header.element("sh")
        if sh.rows != vertex.rows or len(sh.properties) not in (9, 24, 45) or {p.kind for p in sh.properties} != {"u1"}:
            raise InputError("its element 'sh' is not that of a compressed PLY")
    if not all(np.isfinite(read_rows(content, header, "chunk").numbers[name]).all() for name in ranges):
        raise InputError("one of its chunks has a range that is not finite")
    byte = read_rows(content, header).numbers["packed_color"] & 255
    return _from_gsply(
        "decompress_from_bytes", content, "compressed PLY", clamped=int(((byte == 0) | (byte == 255)).sum())
    )


def read_spz(content: bytes) -> SplatFile:
    """InputError where its header promises what it does not hold."""
    head = content
    if content.startswith(GZIP_MAGIC):
        head = _inflated(content, SPZ_HEADER.size)
    if len(head) < SPZ_HEADER.size:
        raise InputError("it ends within the header of an .spz")
    magic, version, n, degree, _, flags, _ = SPZ_HEADER.unpack_from(head)
    if magic != SPZ_MAGIC or not 1 <= version <= 4:
        raise InputError(f"it is no .spz of version 1 to 4 (it says {magic!r}, {version})")
    if degree > 3:
        raise InputError(
            f"it has SH degree {degree}; this program renders degree 0 to 3: export it with a lower degree"
        )
    if n > len(content):
        raise InputError(f"it promises {n} Gaussians in {len(content)} bytes: it is cut short")
    clamped = 0
    if content.startswith(GZIP_MAGIC):
        size = SPZ_HEADER.size + n * (16 + (4 if version >= 3 else 3) + 3 * SH_COUNTS[degree])
        whole = _inflated(content, size)
        if len(whole) < size:
            raise InputError(f"it promises {size} bytes and holds {len(whole)}: it is cut short")
        alpha = np.frombuffer(whole, np.uint8, n, SPZ_HEADER.size + 9 * n)
        clamped = int(((alpha == 0) | (alpha == 255)).sum())
    found = _from_gsply("read_spz", content, f".spz version {version}", clamped, antialiased=bool(flags & 1))
    return replace(found, gaussians=turned(found.gaussians), other_axes=found.gaussians)


def _inflated(content: bytes, size: int) -> bytes:
    """The first bytes before compression, at most so many."""
    try:
        return zlib.decompressobj(31).decompress(content, size)
    except zlib.error as error:
        raise InputError(f"its compressed bytes are damaged ({error})") from error


def turned(found: Gaussians) -> Gaussians:
    """The same with its axes y and z turned round, from .spz's right, up, back to a PLY's right, down, front."""
    gaussians = found.with_flat(found.flat.clone())
    attributes = gaussians.attributes
    attributes["means"] *= torch.tensor([1.0, -1.0, -1.0])
    attributes["quats"] *= torch.tensor(QUATERNION_AXES)
    direction = torch.tensor([[0.48, 0.6, 0.64]])  # on no plane where a harmonic vanishes
    degree = found.sh_degree
    signs = harmonics(direction * torch.tensor([1.0, -1.0, -1.0]), degree) / harmonics(direction, degree)
    attributes["sh"] *= signs.sign()[..., None]
    return gaussians


def is_sog(archive: zipfile.ZipFile) -> bool:
    return "meta.json" in archive.namelist()


def read_sog(content: bytes) -> SplatFile:
    """InputError where a texture or a table is smaller than the file says."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            require_modest(archive)
            meta = loose_json(archive.read("meta.json"))
            _check_sog(meta, {name: archive.read(name) for name in archive.namelist() if name.endswith(".webp")})
    except InputError:
        raise
    except Exception as error:  # JSON, zip and WebP fail in many ways
        if lacks_memory(error):
            raise
        raise InputError(f"it is no .sog, or damaged ({type(error).__name__}: {str(error)[:120]})") from error
    kind = (meta.get("model") or (meta.get("asset") or {}).get("model") or "") if isinstance(meta, dict) else ""
    if kind == "2dgs":
        raise InputError("it holds surfels (2D Gaussian Splatting), which this program does not render")
    return _from_gsply("sogread", content, ".sog", antialiased=kind == "antialiased")


def _check_sog(meta: Any, textures: dict[str, bytes]) -> None:
    """Every index that a texture may hold is one of a table."""
    if meta.get("version") != 2:
        raise InputError("it is a .sog of version 1; convert it with splat-transform")
    count = meta["count"]
    sizes = {}
    for name, texture in textures.items():
        with warnings.catch_warnings(action="error"), open_image(io.BytesIO(texture), ("WEBP",)) as image:
            sizes[name] = image.size[0] * image.size[1]
    files = [name for key in MEMBERS for name in meta[key]["files"]]
    tables = [meta["scales"]["codebook"], meta["sh0"]["codebook"]]
    if "shN" in meta:
        higher = meta["shN"]
        files.append(higher["files"][1])
        tables.append(higher["codebook"])
        if (
            higher["bands"] not in (1, 2, 3)
            or not 0 < higher["count"] * SH_COUNTS[higher["bands"]] <= sizes[higher["files"][0]]
        ):
            raise InputError("its palette of harmonics is not in its texture")
    if type(count) is not int or not 0 < count <= min(sizes[name] for name in files):
        raise InputError(f"it promises {count} Gaussians and has textures for fewer")
    if max(sizes.values()) > LARGEST_TEXTURE:
        raise InputError(f"it has a texture of more than {LARGEST_TEXTURE} pixels")
    if any(len(table) != 256 or not np.isfinite(np.array(table, dtype=np.float64)).all() for table in tables):
        raise InputError("one of its tables has not the 256 numbers that its textures index")
    if "shN" in meta:
        _check_labels(textures[meta["shN"]["files"][1]], count, meta["shN"]["count"])


def _check_labels(texture: bytes, count: int, palette: int) -> None:
    with open_image(io.BytesIO(texture), ("WEBP",)) as image:
        pixels = np.array(image.convert("RGBA")).reshape(-1, 4)[:count].astype(np.int64)
    if (pixels[:, 0] + 256 * pixels[:, 1]).max() >= palette:
        raise InputError("its labels point beyond its palette of harmonics")


def _from_gsply(reader: str, content: bytes, kind: str, clamped: int = 0, *, antialiased: bool = False) -> SplatFile:
    """Gaussians that gsply's reader of this name finds in the content."""
    try:
        import gsply  # pyright: ignore[reportMissingImports]
        from gsply.sog_reader import sogread  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise InputError(
            f"it is a {kind}, which the optional package gsply reads: pip install 'gsply[spz,sogs]', or convert it to PLY"
        ) from error
    try:
        with np.errstate(all="ignore"):
            if reader == "read_spz":
                with tempfile.NamedTemporaryFile(suffix=".spz") as file:  # it reads files alone
                    file.write(content)
                    file.flush()
                    data = gsply.read_spz(Path(file.name))
            else:
                data = sogread(content) if reader == "sogread" else gsply.decompress_from_bytes(content)
    except Exception as error:  # gsply has no error of its own
        if lacks_memory(error):
            raise
        raise InputError(f"gsply cannot read this {kind}: {str(error)[:160]}") from error
    constant = np.asarray(data.sh0)[:, None]
    attributes = {
        "means": data.means,
        "log_scales": data.scales,
        "quats": data.quats,
        "opacity_logits": data.opacities,
        "sh": constant if data.shN is None else np.concatenate([constant, data.shN], axis=1),
    }
    return SplatFile(packed(attributes), kind, antialiased=antialiased, lossy=True, notes=clamped_note(clamped))
