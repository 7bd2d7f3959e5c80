"""Record folders: what a probe found, written so that a crash never leaves a mixture, and read back with clear errors.

A record is a folder `RUN/probe/` with `probe.json` (every number), one `.npz` per group of arrays, and whatever
pictures and pages were drawn from them.  `record_folder` makes the whole folder appear at once.  Needs no torch.
Folders of `landscape slice` are made alike, with `slice.json`, whose keys `analysis.slice.record` lists.

Numbers.  `probe.json` is strict JSON.  What is not finite is a string, "NaN", "Infinity" or "-Infinity" (the convention
of protobuf's JSON), and comes back as a float.  `null` means *not determined*, and the `note` beside it says why.
Losses are dimensionless; curvatures are loss per squared parameter unit, with respect to the stored parameters.

Keys (frozen: within a format version keys may be added, none renamed or removed; * marks those that must be there):

format*           name*, version*: see `FORMAT`
objective         loss: its name; sizes: [width, height] of each view; background: [r, g, b];
                  operator: "hessian" or "gauss-newton"; value: L at the checkpoint; gradient_norm: |dL/dTheta|
traces*           one entry per attribute (means, log_scales, quats, opacity_logits, sh):
    value*            trace of the attribute's diagonal block over its active parameters
    standard_error*   of value; 0 where the method is exact
    low, high         the ends of the interval at `confidence`, e.g. 0.95
    confidence
    sign*             "positive", "negative", "zero", or "undetermined" where the interval does not decide it
    tau*              sqrt(max(value, 0) / dim): the attribute's curvature scale
    dim*              parameters over which tau takes the mean
    probes*           probe vectors used; 0 where the method is exact
    matvecs           products H v spent
    method*           "exact", or "exact, the coupling of pixels sampled with random signs"
    reason            why it stopped: "tolerance", "noise floor", "matvec budget", "time budget" or "exact"
    note              why value is null, what was capped, ...
eigenvalues*      max*, second, min* (of the active operator, signed) and power_max, power_min (the paper's power iteration):
    value*            the eigenvalue (Ritz value)
    residual*         |H v - value v| with |v| = 1: a true eigenvalue lies within it
    vector_error      about the sine of the angle between v and the true eigenvector
    method, matvecs, reason, note     as for the traces
    shares            attribute -> share of the eigenvector's squared mass
    lives_on          where the eigenvector lives (`analysis.measures.localization`): attributes: its shares; participation:
    over how
                      many Gaussians; needles, needles_bare: share of mass on Gaussians with kappa > 100, with and without
                      the blur of 0.3 px^2, and needle_count, needle_bare_count: how many those are; heaviest: [index, share]
anisotropy*       literal, saddle, share, effective_rank, mass_quantile, each with:
    value*, low*, high*   the index and its bracket; null where undefined (see note) or unbounded
    note*             why, or ""
quantiles         null, or share -> the eigenvalue that this share of all active ones does not exceed: value, low, high, note
finite_probe      null, or the second difference (L(+d v) + L(-d v) - 2 L) / d^2 along the direction named, for all of:
    steps, curvatures, round_off, truncation    d, the second difference, bounds of its errors
    crossed           at which steps the order of the splats or the set of visible ones changed
    infinitesimal     v.H v;  center_loss, noise: L and the standard deviation of one evaluation's error
    best              index of the step with the least error of those that cross nothing; null without any
    evaluations       renders of all views
depth             absent, null, or the positions along the rays against one direction across them (`analysis.measures.depth`):
    gradient_ratio, gradient_median    of the root mean square gradients; the median over `pairs` of a Gaussian and a view
    curvature         depth, lateral: traces, as above without tau
    curvature_ratio   of the mean curvatures: value, low, high, note
    rises             a row a length of finite steps: pixels; depth, lateral: rises of the loss, with _error and _crossed, the
                      share of the renders with another order of the splats or set of visible ones; ratio, ratio_error
families          absent, or rows of the anisotropy families (`analysis.measures.families`), each with: operator ("hessian" or
                  "gauss-newton"), block ("all" or an attribute), metric and unit, split (whether of the split scene),
                  gaussians, dim, rank (dim without the exact null space); lambda_max, lambda_min: value, residual,
                  ...;
                  beyond: how far outside an end that ran out of its budget may lie (see
                  `landscape.eigen.eigen.pairs.EigenEnds`);
                  indices: as anisotropy; starts, steps of the density; matvecs
split_control     absent, or gaussians; rms, largest, psnr of the images' change; effects: operator, block, index, and value,
                  low, high, note of the split scene's index over the trained scene's
slice             null, or:
    directions*       two of {name*, curvature*, residual, unit*}: the unit vectors of the x and the y axis, the
                      curvature along each, and `unit` = sqrt(2 loss_scale / |curvature|), in parameter units
    loss_scale*       a change of loss: along a direction the curvature alone makes it within one `unit`
    center_loss*      L at the centre, a render of the slice's own
    points, evaluated_points, crossed_points    of the grid: all, and those that `evaluated` and `crossed` (below) mark
    evaluations       renders of all views that the slice took
    interpolation_error       the largest error of predictions at random points, as a share of the range of the evaluated
                      losses; 0 where all points are evaluated, null where a prediction met a loss that is not finite
    holdout_points, share_beyond    how many random points; with 95% confidence at most this share of the points that were
                      not evaluated before them is off by more than interpolation_error
    reason            why no more points were evaluated: "tolerance", "evaluation budget", "time budget" or "exact"
    note
counts*           gaussians*, visible_gaussians*, parameters*, active_parameters*, sh_degree_stored*,
sh_degree_active*,
                  views*; any further integer under a name that says what was counted
skipped           what the scene did not need (`analysis.probe.skips`) -> count, seconds_saved (measured, not
reproducible; null: not)
checks*           symmetry, round_off, finiteness, finite_difference, each with:
    value*, bound*    what was measured and what it must not exceed
    passed*           true, false, or null where the check could not run (see note)

    note
timing*           stage -> seconds, in the order run; total*
notes             sentences: what was skipped, capped, or not reached
provenance*       created*, seed*, versions*, machine* (see `analysis.records.provenance`); checkpoint, scene,
scene_folder, views,
                  iteration, dtype, threads, command, settings; families: the settings of these, where they were measured
arrays*           written by `write_record`: group -> name -> shape, one file `group.npz` each

Arrays (all optional):

spectrum          ritz_values [k], residuals [k]: approximate eigenvalues, the two ends among them; and, where the
                  density was estimated, nodes, weights [starts, steps + known]: a quadrature for each start vector, the
                  eigenvalues that are known among the nodes of all
eigenvectors      largest [parameters, k]: unit vectors of the k largest eigenvalues, of the Gaussians in sight
traces            attribute -> [probes]: the samples whose mean is the trace
families          SCENE.OPERATOR.BLOCK.nodes and .weights [starts, steps + known]: the quadrature of each family's density
slice             x [nx], y [ny]: steps along the two directions in parameter units; loss [nx, ny]: L at each point;
                  evaluated [nx, ny]: true where it is a true render, false where it is interpolated (absent: all are
                  renders); where known, model [nx, ny]: the quadratic model there, and crossed [nx, ny]: true where a
                  render's order of the splats or set of visible ones is not that of the centre (false and not known
                  where interpolated)
"""

import json
import math
import os
import secrets
import shutil
import time
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Kind:
    """The records of one subcommand.  sections: objects that must be there; axes: how many directions a slice may have."""

    command: str
    version: int
    sections: tuple[str, ...]
    axes: tuple[int, ...]

    @property
    def file(self) -> str:
        return f"{self.command}.json"

    @property
    def format(self) -> dict[str, str | int]:
        return {"name": f"landscape {self.command}", "version": self.version}


_EVERY = ("counts", "timing", "provenance", "arrays")
PROBE = Kind("probe", 1, ("traces", "eigenvalues", "anisotropy", "checks", *_EVERY), axes=(2,))
SLICE = Kind("slice", 1, ("objective", "slice", *_EVERY), axes=(1, 2))
FILE, FORMAT = PROBE.file, PROBE.format

_REQUIRED = {
    "traces": ("value", "standard_error", "tau", "dim", "probes", "sign", "method"),
    "eigenvalues": ("value", "residual"),
    "anisotropy": ("value", "low", "high", "note"),
    "checks": ("value", "bound", "passed"),
}
_REQUIRED_KEYS = {
    "eigenvalues": ("max", "min"),
    "counts": (
        "gaussians",
        "visible_gaussians",
        "parameters",
        "active_parameters",
        "sh_degree_stored",
        "sh_degree_active",
        "views",
    ),
    "timing": ("total",),
    "provenance": ("created", "seed", "versions", "machine"),
}
_POINTS = ("points", "evaluated_points", "crossed_points", "holdout_points")
_NOT_FINITE = {"NaN": math.nan, "Infinity": math.inf, "-Infinity": -math.inf}
_ABANDONED_AFTER = 3600.0  # seconds; filling a folder takes seconds: an older partial one is a killed process's


@dataclass(frozen=True)
class Record:
    """A record as read: `data` is its JSON with non-finite numbers as floats, `arrays` is group -> name -> array."""

    folder: Path
    data: dict[str, Any]
    arrays: dict[str, dict[str, np.ndarray]]


@contextmanager
def record_folder(folder: str | Path, kind: Kind = PROBE) -> Iterator[Path]:
    """A new, empty folder that becomes `folder` when the block ends, all at once; nothing changes if the block fails.

    An old record at `folder` is replaced.  Killed at any point, `folder` is the old record, the new one, or (between
    two renames) absent with the old record complete in `.NAME.previous` beside it, from where the next use restores it.
    """
    folder = Path(folder).absolute()
    require_replaceable(folder, kind)
    folder.parent.mkdir(parents=True, exist_ok=True)
    previous = folder.with_name(f".{folder.name}.previous")
    _clean_up_after_kills(folder, previous)
    partial = folder.with_name(f".{folder.name}.partial-{secrets.token_hex(4)}")
    partial.mkdir()
    try:
        yield partial
        for file in (path for path in partial.rglob("*") if path.is_file()):
            with file.open("rb") as stream:
                os.fsync(stream.fileno())
        if folder.exists():
            folder.rename(previous)
        partial.rename(folder)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        if previous.exists() and not folder.exists():
            previous.rename(folder)
        raise
    shutil.rmtree(previous, ignore_errors=True)


def write_record(
    folder: str | Path, data: Mapping[str, Any], arrays: Mapping[str, Mapping[str, np.ndarray]], kind: Kind = PROBE
) -> Path:
    """Write the JSON and the arrays into `folder` (which `record_folder` gave); returns the path of the JSON.

    `data` holds the keys of the module's glossary save `format` and `arrays`, which are added here.
    Raises ValueError where a required key is missing or a value has no place in JSON.
    """
    for group, names in arrays.items():
        numeric: dict[str, Any] = {name: np.asarray(array) for name, array in names.items()}
        if objects := [name for name, array in numeric.items() if array.dtype.hasobject]:
            raise ValueError(f"expected numbers in the array {group}.{objects[0]}, got objects")
        # not compressed: eigenvectors, by far the largest, would take a tenth of a second for 2% less
        np.savez(Path(folder) / f"{group}.npz", **numeric)
    return write_data(folder, data, arrays, kind)


def write_data(
    folder: str | Path, data: Mapping[str, Any], arrays: Mapping[str, Mapping[str, np.ndarray]], kind: Kind = PROBE
) -> Path:
    """The JSON alone, anew, of a record whose arrays are in `folder`; else as `write_record`."""
    shapes = {group: {name: list(np.shape(array)) for name, array in names.items()} for group, names in arrays.items()}
    whole = {"format": kind.format, **data, "arrays": shapes}
    check_layout(whole, kind)
    text = json.dumps(_encoded(whole, ""), indent=2, allow_nan=False, ensure_ascii=False) + "\n"
    path = Path(folder) / kind.file
    temporary = path.with_suffix(".json.tmp")
    temporary.write_text(text, encoding="utf-8")
    temporary.replace(path)
    return path


def read_record(folder: str | Path) -> Record:
    """Read the record in `folder` (or the JSON given).  FileNotFoundError or ValueError say what is wrong."""
    folder = Path(folder)
    folder = folder.parent if folder.name in (PROBE.file, SLICE.file) else folder
    kind = SLICE if (folder / SLICE.file).is_file() else PROBE
    path = folder / kind.file
    if not path.is_file():
        raise FileNotFoundError(_why_not_found(folder))
    again = f"{kind.command} again"
    try:
        raw = json.loads(path.read_text(encoding="utf-8"), parse_constant=_refuse_constant)
    except ValueError as error:
        raise ValueError(
            f"expected JSON in {path}, got a file that is damaged or truncated ({error}); {again}"
        ) from None
    match raw:
        case {"format": {"name": name, "version": version}} if name == kind.format["name"]:
            pass
        case _:
            raise ValueError(
                f'expected a record of `landscape {kind.command}` in {path}, got JSON without "format": {kind.format}'
            )
    if not isinstance(version, int) or version > kind.version:
        raise ValueError(
            f"expected a record of format version {kind.version} or older in {path}, got version {version}; "
            f"update splat-landscape or {kind.command} the checkpoint again"
        )
    try:
        check_layout(raw, kind)
    except ValueError as error:
        raise ValueError(f"{path}: {error}; {again}") from None
    arrays = {group: _read_arrays(folder / f"{group}.npz", shapes, kind) for group, shapes in raw["arrays"].items()}
    return Record(folder, decoded(raw), arrays)


def check_layout(data: Mapping[str, Any], kind: Kind = PROBE) -> None:
    """Raise ValueError naming the first required key of the module's glossary that `data` lacks."""
    for section in kind.sections:
        entries = data.get(section)
        if not isinstance(entries, Mapping):
            raise ValueError(f'expected an object "{section}", got {type(entries).__name__}')
        missing = [f"{section}.{key}" for key in _REQUIRED_KEYS.get(section, ()) if key not in entries]
        for name, entry in entries.items():
            required = _REQUIRED.get(section, ())
            if required and not isinstance(entry, Mapping):
                raise ValueError(f'expected an object "{section}.{name}", got {type(entry).__name__}')
            missing += [f"{section}.{name}.{key}" for key in required if key not in entry]
        if missing:
            raise ValueError(f'expected the key "{missing[0]}", got none')
    _require_numbers(data["counts"], "counts", _REQUIRED_KEYS["counts"])
    notes = data.get("notes", [])
    if not isinstance(notes, list | tuple) or not all(isinstance(note, str) for note in notes):
        raise ValueError(f'expected a list of sentences "notes", got {notes!r}')
    for group, shapes in data["arrays"].items():
        if not isinstance(shapes, Mapping):
            raise ValueError(f'expected shapes by name at "arrays.{group}", got {type(shapes).__name__}')
    if data.get("slice") is not None:
        _check_slice(data["slice"], kind)


def _require_numbers(entries: Mapping[str, Any], section: str, keys: Iterable[str]) -> None:
    """Those of the keys that are there."""
    for key in keys:
        if not isinstance(entries.get(key, 0), Real):
            raise ValueError(f'expected a number "{section}.{key}", got {entries[key]!r}')


def _check_slice(plane: Any, kind: Kind) -> None:
    if not isinstance(plane, Mapping):
        raise ValueError(f'expected an object "slice", got {type(plane).__name__}')
    found = plane.get("directions")
    directions = found if isinstance(found, list | tuple) else ()
    if not {"loss_scale", "center_loss"} <= set(plane) or len(directions) not in kind.axes:
        axes = " or ".join(map(str, kind.axes))
        raise ValueError(f'expected "slice" to hold "loss_scale", "center_loss" and {axes} "directions"')
    _require_numbers(plane, "slice", _POINTS)
    for direction in directions:
        if not isinstance(direction, Mapping):
            raise ValueError(f'expected objects in "slice.directions", got {type(direction).__name__}')
        if missing := {"name", "curvature", "unit"} - set(direction):
            raise ValueError(f'expected the key "slice.directions.{min(missing)}", got none')


def _encoded(value: Any, where: str) -> Any:
    """`value` as plain JSON types; ValueError names the key of what is none."""
    match value:
        case None | bool() | int():
            return value
        case np.bool_() | np.integer():
            return value.item()
        case float() | np.floating():
            number = float(value)
            return (
                number if math.isfinite(number) else ("NaN" if math.isnan(number) else f"{'-' * (number < 0)}Infinity")
            )
        case str():
            if value in _NOT_FINITE:
                raise ValueError(f'expected text at "{where}", got "{value}", which would be read back as a number')
            return value
        case Path():
            return str(value)
        case Mapping():
            if wrong := [key for key in value if not isinstance(key, str)]:
                raise ValueError(f'expected text as keys of "{where}", got {wrong[0]!r}')
            return {key: _encoded(item, f"{where}.{key}".lstrip(".")) for key, item in value.items()}
        case list() | tuple():
            return [_encoded(item, f"{where}[{i}]") for i, item in enumerate(value)]
    raise ValueError(
        f'expected a number, text, list or mapping at "{where}", got {type(value).__name__}; arrays belong in an .npz'
    )


def decoded(value: Any) -> Any:
    """JSON with non-finite numbers as floats."""
    match value:
        case str():
            return _NOT_FINITE.get(value, value)
        case dict():
            return {key: decoded(item) for key, item in value.items()}
        case list():
            return [decoded(item) for item in value]
    return value


def _read_arrays(path: Path, shapes: Mapping[str, list[int]], kind: Kind) -> dict[str, np.ndarray]:
    again = f"{kind.command} again"
    if not path.is_file():
        raise FileNotFoundError(f"expected the arrays of {kind.file} in {path}, got no such file; {again}")
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except (ValueError, OSError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(f"expected arrays in {path}, got a damaged or truncated file ({error}); {again}") from None
    for name, shape in shapes.items():
        got = list(arrays[name].shape) if name in arrays else None
        if got != shape:
            raise ValueError(f"expected {name} of shape {shape} in {path}, got {got}; {again}")
    return arrays


def _why_not_found(folder: Path) -> str:
    expected = f"expected a folder written by `landscape probe` (with {FILE}), got {folder}, "
    if (folder / "probe" / FILE).is_file():
        return f"{expected}which is a run; name {folder / 'probe'}"
    if (previous := folder.with_name(f".{folder.name}.previous")).is_dir():
        return f"{expected}whose replacement was interrupted; rename {previous} to {folder.name}, or probe again"
    state = "which has none" if folder.is_dir() else "which is a file" if folder.exists() else "which does not exist"
    return f"{expected}{state}; run `landscape probe CHECKPOINT` first"


def require_replaceable(folder: Path, kind: Kind = PROBE) -> None:
    """Replacing deletes: raise ValueError unless folder is absent, empty or an older record of this kind."""
    if folder.is_dir() and any(folder.iterdir()) and not (folder / kind.file).is_file():
        raise ValueError(
            f"expected an empty folder or an older record to replace, got {folder} without {kind.file}; move it away"
        )
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"expected a folder to write a record to, got the file {folder}; move it away")


def _clean_up_after_kills(folder: Path, previous: Path) -> None:
    if folder.exists():  # else `previous` is the only record there is
        shutil.rmtree(previous, ignore_errors=True)
    for partial in folder.parent.glob(f".{folder.name}.partial-*"):
        if time.time() - partial.stat().st_mtime > _ABANDONED_AFTER:
            shutil.rmtree(partial, ignore_errors=True)


def _refuse_constant(constant: str) -> float:
    raise ValueError(f"{constant} is not JSON")
