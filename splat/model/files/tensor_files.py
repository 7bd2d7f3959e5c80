"""Checkpoints that other tools wrote with `torch.save`: graphdeco, gsplat, nerfstudio's splatfacto.

    graphdeco   chkpntN.pth: (captured, iteration); captured[0:7]: active SH degree, means, f_dc (n, 1, 3), f_rest (n, k, 3),
                log-scales, quaternions, logits (n, 1).  Bands above the active degree were not rendered
    gsplat      ckpt_STEP_rankR.pt: {"step", "splats": {means, scales, quats, opacities, sh0 (n, 1, 3), shN (n, k, 3)}}; the
                ranks of one training have a share of the Gaussians each
    splatfacto  step-STEP.ckpt: {"step", "pipeline": {"_model.gauss_params.means": ...}}, in older files "_model.means";
                features_dc (n, 3), features_rest (n, k, 3).  At SH degree 0 features_dc are logits of colours.  Trained on
                several GPUs or compiled, the names have "module." or "_orig_mod." in between

Nothing in such a file can run code: `weights_only=True`, with the NumPy scalars that the tools leave in them allowed by name.
"""

import io
import re
import warnings
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch
from torch import Tensor

from landscape.errors import InputError, lacks_memory
from splat.model.files.splat_file import SplatFile, finite_logits, names_of, packed
from splat.model.gaussians import Gaussians
from splat.model.harmonics import Y00
from splat.model.untrusted import is_of_the_system, require_whole

UNAPPLIED = "{}, which changed its images in training, is not applied"
RANK = re.compile(r"(.*_rank)(\d+)(\.pt)")
OWN = b"splat-landscape checkpoint"
WRAPPED = r"(?:(?:module|_orig_mod)\.)*"
ZIP_MAGIC = b"PK\x03\x04"
NERFSTUDIO = re.compile(rf"({WRAPPED}_model\.{WRAPPED}(?:gauss_params\.)?)means")
MOVED = re.compile(r"camera_opt|bil_grid|appearance|exposure")  # in names of further parameters that splatfacto fits
NUMPY_TYPES = ("Float64DType", "Float32DType", "Int64DType", "Int32DType", "BoolDType")


def is_own(archive: zipfile.ZipFile) -> bool:
    """Whether `splat.training.checkpoint` wrote it."""
    return any(OWN in archive.read(name) for name in pickles_of(archive))


def pickles_of(archive: zipfile.ZipFile) -> list[str]:
    found = archive.infolist()
    return [info.filename for info in found if info.filename.endswith("/data.pkl") and info.file_size < 1 << 26]


def read_tensor_file(path: Path, content: bytes) -> SplatFile:
    """InputError where it is of no tool that is known, or damaged."""
    found = load_tensors(content)
    if isinstance(found, tuple | list) and len(found) == 2 and isinstance(found[0], tuple | list) and len(found[0]) > 6:
        return _graphdeco(found[0], found[1])
    if isinstance(found, dict) and isinstance(found.get("splats"), Mapping):
        return _gsplat([found, *(load_tensors(rank.read_bytes()) for rank in _other_ranks(path))])
    if isinstance(found, dict) and isinstance(found.get("pipeline"), Mapping):
        return _splatfacto(found)
    raise InputError("it holds no Gaussians of graphdeco, gsplat or nerfstudio")


def load_tensors(content: bytes) -> Any:
    """As `loaded`, with NumPy's numbers."""
    with torch.serialization.safe_globals(_numpy_scalars()):
        return loaded(io.BytesIO(content))


def loaded(file: BinaryIO) -> Any:
    """Content that `torch.save` wrote, on the CPU.  InputError that says why there is none.

    Its members are as large as in the file, and their checksums right, which torch does not test.
    """
    try:
        with zipfile.ZipFile(file) as archive:
            require_whole(archive)
            if any(info.compress_type != zipfile.ZIP_STORED for info in archive.infolist()):
                raise InputError("its members are compressed, which torch.save does not do")
        file.seek(0)
        with warnings.catch_warnings(action="ignore"):  # torch warns of other kinds of pickle before it refuses them
            return torch.load(file, map_location="cpu", weights_only=True)
    except Exception as error:  # a damaged file, or one of another kind, fails in torch in many ways
        if isinstance(error, InputError) or lacks_memory(error) or is_of_the_system(error):
            raise
        if isinstance(error, zipfile.BadZipFile) and is_archive(file):
            raise InputError("it is cut off: its end, with the list of what it holds, is missing") from error
        raise InputError(f"torch does not load it: {torch_reason(error)}") from error


def is_archive(file: BinaryIO) -> bool:
    """Whether a file begins as an archive does, though its end may be missing."""
    file.seek(0)
    return file.read(len(ZIP_MAGIC)) == ZIP_MAGIC


def torch_reason(error: Exception) -> str:
    """Why torch did not load a file, in its words, without its advice.

    >>> torch_reason(RuntimeError("record is short. Do this"))
    'record is short'
    """
    words = "".join(letter if letter.isprintable() else " " for letter in str(error))
    sentence = re.split(r"\. |  ", words.strip() or type(error).__name__)[0]
    return "objects of Python that could run code" if "weights" in sentence.lower() else sentence[:200]


def _numpy_scalars() -> list[Any]:
    """Types that a NumPy number in a checkpoint consists of, under the names of NumPy 1 and 2."""
    from numpy._core import multiarray  # numpy.core in NumPy 1

    scalar: Any = multiarray.scalar
    kinds = [getattr(np.dtypes, name) for name in NUMPY_TYPES]
    return [np.dtype, *kinds, scalar, (scalar, "numpy.core.multiarray.scalar")]


def _array(values: Any, key: Any, *shape: int | None) -> np.ndarray:
    """A tensor of finite size as float32; None in the shape: any length."""
    value = values[key] if not isinstance(values, Mapping) or key in values else None
    if (
        not isinstance(value, Tensor)
        or value.layout is not torch.strided
        or value.is_nested
        or value.device.type != "cpu"
        or not value.dtype.is_floating_point
    ):
        raise InputError(f"it has no tensor of numbers {key!r}")
    if value.ndim != len(shape) or any(want not in (None, got) for want, got in zip(shape, value.shape)):
        raise InputError(f"its {key!r} has the shape {tuple(value.shape)}, expected {shape} (None: any)")
    if value.numel() * value.element_size() > value.untyped_storage().nbytes():
        raise InputError(f"its {key!r} repeats its numbers instead of holding them")
    return value.detach().resolve_neg().float().numpy()


def _step(value: Any) -> int | None:
    return int(value) if isinstance(value, int | np.integer) and 0 <= int(value) < 2**31 else None


def _graphdeco(captured: Any, iteration: Any) -> SplatFile:
    constant, rest = _array(captured, 2, None, 1, 3), _array(captured, 3, None, None, 3)
    active = captured[0]
    logits, notes = finite_logits(_array(captured, 6, None, 1)[:, 0])
    sh = _joined(constant, rest)
    if isinstance(active, int) and 0 <= active < 4 and (active + 1) ** 2 < sh.shape[1]:
        notes += (f"SH bands above degree {active}, which the training had not reached, were left out",)
        sh = sh[:, : (active + 1) ** 2]
    gaussians = packed(
        {
            "means": _array(captured, 1, None, 3),
            "log_scales": _array(captured, 4, None, 3),
            "quats": _array(captured, 5, None, 4),
            "opacity_logits": logits,
            "sh": sh,
        }
    )
    return SplatFile(gaussians, "graphdeco checkpoint", "graphdeco", _step(iteration), notes=notes)


def _joined(constant: np.ndarray, rest: np.ndarray) -> np.ndarray:
    if len(constant) != len(rest):
        raise InputError(f"it has {len(constant)} colours and {len(rest)} of their higher harmonics")
    return np.concatenate([constant, rest], axis=1)


def _other_ranks(path: Path) -> list[Path]:
    """The files of the other ranks, in their order.  InputError where one is missing, or one named that is not the first."""
    match = RANK.fullmatch(path.name)
    if not match:
        return []
    if match[2] != "0":
        raise InputError(f"it is one share of a training; name the first, {match[1]}0{match[3]}, all are then read")
    named = [(m, file) for file in path.parent.iterdir() if (m := RANK.fullmatch(file.name)) and m[1] == match[1]]
    found = {int(m[2]): file for m, file in named}
    missing = [str(rank) for rank in range(max(found) + 1) if rank not in found]
    if missing or len(found) < len(named):
        what = f"without {', '.join(missing[:5])}: a share of the scene is missing" if missing else "one of them twice"
        raise InputError(f"its ranks are {', '.join(map(str, sorted(found)))}, {what}")
    return [found[rank] for rank in sorted(found) if rank]


def _gsplat(ranks: list[Any]) -> SplatFile:
    parts: list[dict[str, np.ndarray]] = []
    for content in ranks:
        splats = content.get("splats") if isinstance(content, dict) else None
        if not isinstance(splats, Mapping) or _step(content.get("step")) != _step(ranks[0].get("step")):
            raise InputError("a rank beside it is of another kind or of another step")
        if "sh0" not in splats and ("features" in splats or "colors" in splats):
            raise InputError(
                "its colours come from a network (--app_opt), which this program does not have; train without"
            )
        parts.append(
            {
                "means": _array(splats, "means", None, 3),
                "log_scales": _array(splats, "scales", None, 3),
                "quats": _array(splats, "quats", None, 4),
                "opacity_logits": _array(splats, "opacities", None),
                "sh": _joined(_array(splats, "sh0", None, 1, 3), _array(splats, "shN", None, None, 3)),
            }
        )
    if len({part["sh"].shape[1] for part in parts}) > 1:
        raise InputError("its ranks have different SH degrees")
    whole = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    whole["opacity_logits"], notes = finite_logits(whole["opacity_logits"])
    first = ranks[0]
    if kinds := [key for key in ("pose_adjust", "app_module", "post_processing") if key in first]:
        notes += (UNAPPLIED.format(", ".join(kinds)),)
    tool = first.get("trained_by")
    extra = {key: _array(first["extra"], key, len(whole["means"])) for key in first.get("extra") or {}}
    return SplatFile(
        packed(whole),
        "gsplat checkpoint",
        tool if isinstance(tool, str) else "gsplat",
        _step(first.get("step")),
        antialiased=first.get("antialiased") is True,
        extra=extra,
        train=names_of(first.get("training_views")),
        width=_step(first.get("training_width")) or None,
        notes=notes,
    )


def gsplat_bytes(
    gaussians: Gaussians,
    step: int,
    extra: Mapping[str, np.ndarray] | None = None,
    tool: str | None = None,
    *,
    antialiased: bool = False,
    train: Sequence[str] = (),
    width: int | None = None,
) -> bytes:
    """A checkpoint as gsplat's `simple_trainer` writes it; beside that lie extra, (n,) each by name, tool, antialiased, train,
    the names of the training views, and width, px of their pictures."""
    values = {name: value.detach().cpu().float().clone() for name, value in gaussians.attributes.items()}
    splats = {
        "means": values["means"],
        "scales": values["log_scales"],
        "quats": values["quats"],
        "opacities": values["opacity_logits"],
        "sh0": values["sh"][:, :1].clone(),
        "shN": values["sh"][:, 1:].clone(),
    }
    columns = {name: torch.from_numpy(np.array(column, np.float32)) for name, column in (extra or {}).items()}
    said = {"extra": columns, "trained_by": tool, "antialiased": antialiased, "training_views": list(train)}
    said["training_width"] = width
    buffer = io.BytesIO()
    torch.save({"step": step, "splats": splats} | {name: each for name, each in said.items() if each}, buffer)
    return buffer.getvalue()


def _splatfacto(content: Mapping[str, Any]) -> SplatFile:
    state = content["pipeline"]
    names = [name for name in state if isinstance(name, str)]
    prefix = next((found[1] for name in names if (found := NERFSTUDIO.fullmatch(name))), None)
    if prefix is None:
        raise InputError("its pipeline has no Gaussians; expected a checkpoint of splatfacto")
    constant = _array(state, f"{prefix}features_dc", None, 3)
    rest = _array(state, f"{prefix}features_rest", None, None, 3)
    logits, notes = finite_logits(_array(state, f"{prefix}opacities", None, 1)[:, 0])
    if moved := [
        name for name in names if MOVED.search(name) and isinstance(state[name], Tensor) and state[name].any()
    ]:
        notes += (UNAPPLIED.format(", ".join(name.rpartition("_model.")[2] for name in moved[:3])),)
    if not rest.shape[1]:
        constant = (1 / (1 + np.exp(-constant.astype(np.float64))) - 0.5) / Y00
        notes += ("splatfacto's colours of SH degree 0 are logits; curvature is in the colours' harmonics instead",)
    gaussians = packed(
        {
            "means": _array(state, f"{prefix}means", None, 3),
            "log_scales": _array(state, f"{prefix}scales", None, 3),
            "quats": _array(state, f"{prefix}quats", None, 4),
            "opacity_logits": logits,
            "sh": _joined(constant[:, None], rest),
        }
    )
    return SplatFile(gaussians, "splatfacto checkpoint", "nerfstudio", _step(content.get("step")), notes=notes)
