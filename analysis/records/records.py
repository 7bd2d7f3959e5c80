"""Record folders: results of a probe or a slice, written atomically and checked on reading.

    RUN/probe/probe.json, RUN/slice-.../slice.json    every number: `ProbeRecord`, `SliceRecord`
    GROUP.npz                                         one for each group of arrays: ARRAYS
    view-NNN-photograph.jpg, view-NNN-render.jpg      training views, by their place among them
    *.png, report.html                                drawn from these

`record_folder` makes the whole folder appear at once.  Needs no torch.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar, cast

import numpy as np
from msgspec import UNSET, Struct, field

from analysis.records import schema
from analysis.records.json_files import decoded, encoded, fitted, json_text, plain, plain_json, with_remedy
from analysis.records.provenance import Provenance
from analysis.records.schema import Count, Maybe, Number
from landscape.errors import InputError
from splat.model.untrusted import beside, locked, read_arrays, replacing, write_atomically
from splat.training.origin.fingerprint import Fingerprint

if TYPE_CHECKING:
    from splat.curvature.objective import ActiveCounts, SceneObjective
    from splat.losses.reference import LossSettings

ARRAYS = {
    "spectrum": {"ritz_values": "k", "residuals": "k", "nodes": "starts steps?", "weights": "starts steps?"},
    "eigenvectors": {"largest": "parameters k", "smallest": "parameters m?"},
    "traces": {"*": "probes?"},
    "places": {"positions": "points xyz", "curvature": "points"},
    "slice": {"x": "nx", "y": "ny?", "loss": "grid", "model": "grid?", "evaluated": "grid?", "crossed": "grid?"},
    "directions": {"vectors": "parameters d"},
}
"""Group (file `GROUP.npz`) -> name -> shape.  ?: may be absent, as any group may.

spectrum      ritz_values, residuals: approximate eigenvalues, the two ends among them; where the density was estimated also
              nodes, weights: a quadrature for each start vector; known eigenvalues are among the nodes of each
eigenvectors  unit vectors of the k largest and the m smallest eigenvalues, of the Gaussians in sight
traces        ATTRIBUTE: the samples whose mean is the trace
places        of another renderer: positions, and the largest eigenvalue of each one's own block of Gauss-Newton
slice         x, y: increasing steps along the directions; loss: L on the grid, [nx, ny] or, along a line, [nx]; model: the
              quadratic model there; evaluated (boolean): true where loss is rendered, false where interpolated (absent: all are
              rendered); crossed (boolean): true where the order of the splats or the set of visible ones is not that of the
              centre; false, as not known, where interpolated
directions    of a `landscape slice`: its directions as columns, of the Gaussians in sight or, for a line, of all
"""
BOOLEAN, POSITIVE = {"evaluated", "crossed"}, {"residuals", "weights"}
PHOTOGRAPH, RENDER = "view-{:03d}-photograph.jpg", "view-{:03d}-render.jpg"


class Format(Struct, frozen=True):
    """name: "landscape probe" or "landscape slice"."""

    name: str
    version: int


class Counts(Struct, kw_only=True):
    """Sizes of the problem and of the work.

    visible_gaussians: that touch a pixel.  active_parameters: of these, without unused SH bands and the lengths of quaternions.
    views_of: number of training views, where fewer were measured.  rank: of the active operator.  products: H v computed.
    renders: of single views.
    """

    gaussians: Count
    visible_gaussians: Count
    parameters: Count
    active_parameters: Count
    sh_degree_stored: Count
    sh_degree_active: Count
    views: Count
    views_of: Maybe[Count] = UNSET
    rank: Maybe[Count] = UNSET
    products: Count = 0
    renders: Count = 0


class Check(Struct, kw_only=True):
    """A self-check: value must not exceed bound.  passed: None where the check could not run (see note)."""

    value: Number
    bound: Number
    passed: bool | None
    note: Maybe[str] = UNSET


Shapes = dict[str, dict[str, list[Count]]]


BOTH_ENDS = ("eigenvalue_ratio", "negative_ratio")


class ProbeRecord(Struct, kw_only=True):
    """Results of `landscape probe`.

    traces: by attribute (means, log_scales, quats, opacity_logits, sh).  depth, slice: None where left out.
    steps: length of the optimiser's first step in a parameter, by attribute.  step_rises: of the loss in such steps with random
    signs, rendered, with its error (`analysis.measures.units`).  measures: those of `analysis.probe.measures`, each with its
    error.  checks: symmetry, round_off, finiteness, finite_difference.  timing: stage ->
    seconds, in the order run, and "total".  notes: sentences on what was skipped, capped, or not reached.  arrays: group ->
    name -> shape.
    """

    COMMAND: ClassVar[str] = "probe"
    FILE: ClassVar[str] = "probe.json"
    FORMAT: ClassVar[Format] = Format("landscape probe", 1)

    format: Format = FORMAT
    objective: schema.Objective = field(default_factory=schema.Objective)
    traces: dict[str, schema.Trace]
    eigenvalues: schema.Eigenvalues
    anisotropy: schema.Anisotropy
    concentration: Maybe[schema.Concentration] = UNSET
    depth: schema.Depth | None = None
    steps: Maybe[dict[str, float]] = UNSET
    step_rises: Maybe[dict[str, tuple[float, float]]] = UNSET
    measures: Maybe[dict[str, tuple[schema.Number, schema.Number]]] = UNSET
    slice: schema.Slice | None = None
    counts: Counts
    checks: dict[str, Check]
    notes: list[str] = []
    provenance: Provenance
    per_attribute: Maybe[list[schema.BlockAnisotropy]] = UNSET
    split_control: Maybe[schema.SplitControl] = UNSET
    timing: dict[str, float]
    arrays: Shapes = {}

    def __post_init__(self) -> None:
        if self.slice and len(self.slice.directions) != 2:
            raise ValueError(f"expected 2 slice.directions, got {len(self.slice.directions)}")

    @property
    def indices(self) -> dict[str, schema.Index]:
        """The indices as they are said: a ratio of both ends has no number where renders do not confirm one of them."""
        found, ends = dict(self.anisotropy.items()), {"λ max": self.eigenvalues.max, "λ min": self.eigenvalues.min}
        if not (doubted := " or ".join(name for name, end in ends.items() if end.doubted)):
            return found
        without = schema.Index(value=None, low=None, high=None, note=f"renders do not confirm {doubted}")
        return found | {name: without for name in BOTH_ENDS if name in found}


class SliceRecord(Struct, kw_only=True):
    """Results of `landscape slice`; fields as in `ProbeRecord`.  finite_probe: along a line; None with two directions."""

    COMMAND: ClassVar[str] = "slice"
    FILE: ClassVar[str] = "slice.json"
    FORMAT: ClassVar[Format] = Format("landscape slice", 1)

    format: Format = FORMAT
    objective: schema.Objective
    slice: schema.Slice
    finite_probe: schema.FiniteProbe | None = None
    counts: Counts
    notes: list[str] = []
    provenance: Provenance
    timing: dict[str, float]
    arrays: Shapes = {}


Data = TypeVar("Data", bound=ProbeRecord | SliceRecord)
Arrays = dict[str, dict[str, np.ndarray]]


@dataclass(frozen=True)
class Record(Generic[Data]):
    """A record as read; arrays: group -> name -> array."""

    folder: Path
    data: Data
    arrays: Arrays


@contextmanager
def record_folder(folder: str | Path, mark: str = ProbeRecord.FILE) -> Iterator[Path]:
    """A new, empty folder that becomes `folder` when the block ends, all at once; nothing changes if the block fails.

    mark: the file that every record of this kind has; an old record at `folder` is replaced.
    """
    folder = Path(folder).resolve()  # a link stays one
    require_replaceable(folder, mark)
    folder.parent.mkdir(parents=True, exist_ok=True)
    with locked(beside(folder), f"no other command that writes {folder}"), replacing(folder, folder=True) as partial:
        yield partial


def write_record(folder: str | Path, data: ProbeRecord | SliceRecord, arrays: Mapping[str, Mapping[str, Any]]) -> Path:
    """Write the JSON and the arrays into `folder` (of `record_folder`); returns the path of the JSON.

    Raises InputError where a value is not of the record's type, or an array holds objects.
    """
    data.arrays = {g: {name: list(np.shape(array)) for name, array in names.items()} for g, names in arrays.items()}
    path = write_data(folder, data)
    for group, names in arrays.items():
        numeric: dict[str, Any] = {name: np.asarray(array) for name, array in names.items()}
        if objects := [name for name, array in numeric.items() if array.dtype.hasobject]:
            raise InputError(f"expected numbers in the array {group}.{objects[0]}, got objects")
        # not compressed: eigenvectors, by far the largest, hardly shrink
        np.savez(Path(folder) / f"{group}.npz", **numeric)
    return path


def write_data(folder: str | Path, data: ProbeRecord | SliceRecord) -> Path:
    """Write the JSON again, of a record whose arrays are in `folder`; as `write_record`."""
    content = encoded(plain(data))
    fitted(decoded(content), type(data), "a record that cannot be read again", "")
    path = Path(folder) / data.FILE
    write_atomically(path, json_text(content).encode())
    return path


def read_record(folder: str | Path, kind: type[Data] | None = None) -> Record[Data]:
    """Read the record in `folder` (or the JSON given).  Raises FileNotFoundError or InputError.

    kind: type of the record; None: a slice where its file is there, else a probe.
    """
    folder = Path(folder)
    folder = folder.parent if folder.name in (ProbeRecord.FILE, SliceRecord.FILE) else folder
    found = kind or cast(type[Data], SliceRecord if (folder / SliceRecord.FILE).is_file() else ProbeRecord)
    path, again = folder / found.FILE, f"{found.COMMAND} again"
    if not path.is_file():
        raise FileNotFoundError(_why_not_found(folder, found.COMMAND, found.FILE))
    what = f"a record of `landscape {found.COMMAND}`"
    raw = plain_json(path, what, again)
    if not (isinstance(raw, dict) and raw.get("format") == plain(found.FORMAT)):
        raise InputError(f'expected {what} in {path}, got JSON without "format": {plain(found.FORMAT)}; {again}')
    data = fitted(raw, found, str(path), again)
    arrays = {group: _read_arrays(folder, group, data.arrays[group], again) for group in ARRAYS if group in data.arrays}
    if data.slice and "slice" in arrays and arrays["slice"]["loss"].ndim != len(data.slice.directions):
        raise InputError(
            f"{path}: expected a direction for each axis of the slice, got {len(data.slice.directions)}; {again}"
        )
    return Record(folder, data, arrays)


def _read_arrays(folder: Path, group: str, shapes: Mapping[str, list[int]], again: str) -> dict[str, np.ndarray]:
    """The arrays of a group that the record lists.  FileNotFoundError without the file, InputError where ARRAYS is violated."""
    path = folder / f"{group}.npz"
    shapes = {name: shape for name, shape in shapes.items() if name in ARRAYS[group] or "*" in ARRAYS[group]}
    if not path.is_file():
        raise FileNotFoundError(f"expected the arrays of the record in {path}, got no such file; {again}")
    found = with_remedy(again, read_arrays, path)
    arrays = {name: found[name] for name in shapes if name in found}
    try:
        _require_arrays(group, arrays, shapes)
    except ValueError as error:
        raise InputError(f"expected the arrays of the record in {path}, got {error}; {again}") from None
    return arrays


def _require_arrays(group: str, arrays: Mapping[str, np.ndarray], shapes: Mapping[str, list[int]]) -> None:
    """Raise ValueError where arrays differ from the record's shapes or from ARRAYS."""
    sizes: dict[str, int] = {}
    for name, shape in shapes.items():
        if name not in arrays:
            raise ValueError(f"no {name}")
        array, kind = arrays[name], "boolean" if name in BOOLEAN else "floating"
        if array.shape != tuple(shape):
            raise ValueError(f"{name} of shape {list(array.shape)} instead of {shape}")
        if not np.issubdtype(array.dtype, np.bool_ if name in BOOLEAN else np.floating):
            raise ValueError(f"{name} of {array.dtype} instead of {kind} values")
        if name in POSITIVE and not (array >= 0).all():
            raise ValueError(f"{name} below 0, or not a number")
    for name, axes in ARRAYS[group].items():
        if name == "*" or (name not in arrays and axes.endswith("?")):
            continue
        words = axes.removesuffix("?").replace("grid", "nx ny" if "y" in arrays else "nx").split()
        shape = arrays[name].shape if name in arrays else ()
        if len(shape) != len(words) or any(sizes.setdefault(word, n) != n or not n for word, n in zip(words, shape)):
            raise ValueError(f"{name} of shape {list(shape)} instead of [{', '.join(words)}], with {sizes}")
        if name in ("x", "y") and not (np.diff(arrays[name]) > 0).all():
            raise ValueError(f"steps {name} that do not increase")
    if ("nodes" in arrays) != ("weights" in arrays):
        raise ValueError("nodes without weights, or weights without nodes")


def _why_not_found(folder: Path, command: str, file: str) -> str:
    expected = f"expected a folder written by `landscape {command}` (with {file}), got {folder}, "
    if (folder / "probe" / ProbeRecord.FILE).is_file():
        return f"{expected}which is a run; name {folder / 'probe'}"
    if (previous := folder.with_name(f".{folder.name}.previous")).is_dir():
        return f"{expected}whose replacement was interrupted; rename {previous} to {folder.name}, or {command} again"
    state = "which has none" if folder.is_dir() else "which is a file" if folder.exists() else "which does not exist"
    return f"{expected}{state}; run `landscape {command} CHECKPOINT` first"


def require_replaceable(folder: Path, mark: str = ProbeRecord.FILE) -> None:
    """Raise InputError unless folder is absent, empty or an older record, with the file `mark`: replacing it deletes it."""
    if folder.is_dir() and any(folder.iterdir()) and not (folder / mark).is_file():
        raise InputError(
            f"expected an empty folder or an older record to replace, got {folder} without {mark}; move it away"
        )
    if folder.exists() and not folder.is_dir():
        raise InputError(f"expected a folder to write a record to, got the file {folder}; move it away")


def recorded_probe(folder: Path, asked: Fingerprint, notes: list[str]) -> Record[ProbeRecord] | None:
    """The probe recorded in a folder, if any, where it is of the checkpoint, the views and the loss that are asked for, and has
    its eigenvectors.

    notes: is told where there is a record that cannot be read, or one of another.
    """
    if not (folder / ProbeRecord.FILE).is_file():
        return None
    try:
        record = read_record(folder, ProbeRecord)
    except (FileNotFoundError, InputError) as error:
        notes.append(f"eigenvectors were not taken from the probe: {error}")
        return None
    found = record.data.provenance.fingerprint
    if apart := asked.apart_from(found) if found else "origin":
        notes.append(f"eigenvectors were not taken from {folder}: it is a probe of another {apart}; probe again")
        return None
    return record if "largest" in record.arrays.get("eigenvectors", {}) else None


def loss_name(loss: "LossSettings") -> str:
    """The loss as a formula in words.

    >>> from splat import LossSettings
    >>> loss_name(LossSettings()), loss_name(LossSettings("charbonnier", 0.0, eps=0.001))
    ('0.8 L1 + 0.2 (1 − SSIM)', 'Charbonnier (eps 0.001)')
    >>> loss_name(LossSettings(opacity_reg=0.01, scale_reg=0.02))
    '0.8 L1 + 0.2 (1 − SSIM) + 0.01 mean opacity + 0.02 mean scale'
    """
    pixel = {"l1": "L1", "l2": "L2", "charbonnier": f"Charbonnier (eps {loss.eps:g})"}[loss.pixel]
    terms = [pixel if loss.pixel_weight == 1 else f"{loss.pixel_weight:g} {pixel}"]
    if loss.ssim_weight:
        windows = " of windows within the image" if loss.border == "valid" else ""
        terms.append(f"{loss.ssim_weight:g} (1 − SSIM{windows})")
    regularizers = {"opacity": loss.opacity_reg, "scale": loss.scale_reg}
    terms += [f"{weight:g} mean {name}" for name, weight in regularizers.items() if weight]
    return " + ".join(terms)


def objective_of(
    objective: "SceneObjective", value: float, gradient_norm: float, views_error: Maybe[Number] = UNSET
) -> schema.Objective:
    """What a record says of its loss."""
    return schema.Objective(
        loss=loss_name(objective.loss_settings),
        sizes=[(view.camera.width, view.camera.height) for view in objective.views],
        background=tuple(objective.background.tolist()),
        value=value,
        gradient_norm=gradient_norm,
        views_error=views_error,
    )


def counts_of(active: "ActiveCounts", views_of: int | None, **work: int) -> Counts:
    """Counts of a record.  views_of: None where no views were left out; work: the other fields of `Counts`."""
    return Counts(**vars(active), views_of=UNSET if views_of is None else views_of, **work)
