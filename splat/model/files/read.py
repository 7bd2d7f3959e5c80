"""Read Gaussians from a file of any tool, recognised by what is in it."""

import ast
import io
import re
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from math import isfinite
from pathlib import Path
from typing import Any

from landscape.errors import InputError
from splat.model.files import quantised, tensor_files
from splat.model.files.ply import MAGIC, read_header
from splat.model.files.splat_file import SplatFile
from splat.model.files.splat_ply import read_splat_ply
from splat.model.files.tensor_files import ZIP_MAGIC
from splat.model.plugins import added
from splat.model.untrusted import require_content, require_modest

LICHTFELD = (b"LFKP", b"PKFL")
LONGEST_SETTINGS = 1 << 16
SETTINGS = {  # of gsplat and nerfstudio: names in the file in the folder above that of the checkpoint, and here
    "cfg.yml": {name: name for name in ("antialiased", "ssim_lambda", "opacity_reg", "scale_reg")},
    "config.yml": {
        "rasterize_mode": "antialiased",
        "ssim_lambda": "ssim_lambda",
        "mcmc_opacity_reg": "opacity_reg",
        "mcmc_scale_reg": "scale_reg",
        "strategy": "strategy",
        "use_scale_regularization": "use_scale_regularization",
    },
}
LINE = re.compile(r"^( *)(\w+): ([\w.+-]+) *$", re.M)
WORDS: dict[str, Any] = {"true": True, "false": False, "antialiased": True, "classic": False}
KINDS = "PLY, a checkpoint of graphdeco, gsplat or nerfstudio, .splat, compressed PLY, .spz or .sog"


def is_foreign(path: Path) -> bool:
    """Whether a file is for `read_splats`: recognised, and not of `splat.training.checkpoint`."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        start = file.read(4)
        if not start.startswith(ZIP_MAGIC):
            known = (MAGIC, quantised.GZIP_MAGIC, quantised.SPZ_MAGIC, *LICHTFELD)
            return start.startswith(known) or path.suffix.lower() == ".splat" or _suffix(path) in _others()
        try:
            with zipfile.ZipFile(file) as archive:
                require_modest(archive)
                theirs = tensor_files.pickles_of(archive) or quantised.is_sog(archive)
                return bool(theirs) and not tensor_files.is_own(archive)
        except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error, RuntimeError):
            return False  # `load_checkpoint` says what is wrong with it


def read_splats(path: Path) -> SplatFile:
    """The Gaussians of a file that `is_foreign`.  InputError that says what is wrong with it.

    >>> read_splats(Path(getfixture("tmp_path") / "none.ply"))
    Traceback (most recent call last):
        ...
    FileNotFoundError: expected a file of Gaussians at ...none.ply, found none
    """
    if not path.is_file():
        raise FileNotFoundError(f"expected a file of Gaussians at {path}, found none")
    require_content(path)
    try:
        return _with_settings(_read(path, path.read_bytes()), path)
    except InputError as error:
        raise InputError(f"expected Gaussians in {path} ({KINDS}): {error}") from error


def _read(path: Path, content: bytes) -> SplatFile:
    if content.startswith(LICHTFELD):
        raise InputError("it is LichtFeld's own format, which changes often: export a PLY there")
    if content.startswith(MAGIC):
        compressed = any(element.name == "chunk" for element in read_header(content).elements)
        return quantised.read_compressed_ply(content) if compressed else read_splat_ply(content)
    if content.startswith((quantised.GZIP_MAGIC, quantised.SPZ_MAGIC)):
        return quantised.read_spz(content)
    if content.startswith(ZIP_MAGIC):
        try:
            with zipfile.ZipFile(io.BytesIO(content)) as archive:
                sog = quantised.is_sog(archive)
        except (OSError, ValueError, EOFError, zipfile.BadZipFile, RuntimeError) as error:
            raise InputError(f"it is a damaged zip file ({error})") from error
        return quantised.read_sog(content) if sog else tensor_files.read_tensor_file(path, content)
    if path.suffix.lower() == ".splat" and content and len(content) % quantised.SPLAT.itemsize == 0:
        return quantised.read_dot_splat(content)  # which has no mark of its own
    if reader := _others().get(_suffix(path)):
        found = reader(content)
        if not isinstance(found, SplatFile):
            raise InputError(f"its reader gave {type(found).__name__}, not a SplatFile: mend the package that has it")
        return found
    raise InputError("it is none of them")


def _suffix(path: Path) -> str:
    return path.suffix.lower().removeprefix(".")


@cache
def _others() -> dict[str, Callable[[bytes], SplatFile]]:
    """Readers of installed packages, by suffix."""
    return added("landscape.files", ("ply", "splat", "spz", "sog", "pt", "pth", "ckpt"))


def _with_settings(found: SplatFile, path: Path) -> SplatFile:
    """The file with the settings in graphdeco's `cfg_args` beside the model, if it comes from graphdeco or a fork of it."""
    of_graphdeco = found.format in ("PLY", "graphdeco checkpoint")
    settings = read_cfg_args(model_folder(path) / "cfg_args") if of_graphdeco else {}
    if not settings:
        settings = read_yaml_lines(path.resolve().parents[1])
        return replace(found, antialiased=found.antialiased or settings.get("antialiased") is True, settings=settings)
    step, counted = found.step, path.resolve().parent.name.removeprefix("iteration_")
    if step is None and counted.isdigit():
        step = int(counted[:9])
    return replace(
        found,
        tool=found.tool or "graphdeco",
        step=step,
        antialiased=found.antialiased or settings.get("antialiasing") is True,
        settings=settings,
    )


def model_folder(path: Path) -> Path:
    """The folder of a file's model, where graphdeco writes `cfg_args` and `cameras.json`."""
    path = path.resolve()
    return path.parents[2] if path.parts[-3:-2] == ("point_cloud",) else path.parent


def read_yaml_lines(folder: Path) -> dict[str, Any]:
    """Settings that SETTINGS names in the files of a folder: numbers, true or false, and words.

    They are YAML with tags that would make Python objects, so that single lines are read and nothing is parsed; those of gsplat
    are not indented.
    """
    found: dict[str, Any] = {}
    for name, known in SETTINGS.items():
        path = folder / name
        if not path.is_file() or path.stat().st_size > LONGEST_SETTINGS:
            continue
        for indent, key, value in LINE.findall(path.read_text(encoding="utf-8", errors="replace")):
            if key in known and bool(indent) == (name == "config.yml"):
                found[known[key]] = WORDS.get(value, number(value))
    if found.get("strategy", "mcmc") != "mcmc":  # splatfacto has them in its file all the same
        found |= {"opacity_reg": 0.0, "scale_reg": 0.0}
    return found


def number(text: str) -> float | str:
    """A number that is finite, else the text."""
    try:
        value = float(text)
    except ValueError:
        return text
    return value if isfinite(value) else text


def read_cfg_args(path: Path) -> dict[str, Any]:
    """The keywords of `Namespace(...)` that are literals; empty where there is no such file.  Nothing in it is run."""
    if not path.is_file() or path.stat().st_size > LONGEST_SETTINGS:
        return {}
    try:
        call = ast.parse(path.read_text(encoding="utf-8").strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return {}
    if not (isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id == "Namespace"):
        return {}
    found = {}
    for keyword in call.keywords:
        try:
            found[keyword.arg] = ast.literal_eval(keyword.value)
        except (ValueError, TypeError, RecursionError, MemoryError):
            continue
    return {name: value for name, value in found.items() if name is not None}
