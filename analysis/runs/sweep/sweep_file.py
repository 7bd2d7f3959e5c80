"""The file of a sweep: methods x seeds x scenes in TOML, and the cells that follow from it.

    out = "../runs/sweep"                    # folder of the results
    seeds = [0, 1, 2]
    iterations = 3000                        # any option of `landscape train`, for every cell
    start = "triangulated"

    [probe]                                  # probe every cell after its training
    loss = "3dgs"                            # and any option of `landscape probe`
    split_control = true

    [scenes.fern]
    path = "../data/fern"                    # and any option of `landscape train`, for this scene
    views = 3

    [methods.3dgs]                           # the method 3dgs at its published settings
    [methods."asp-only"]
    method = "stablegs"                      # and any option of `landscape train`, for this method
    set = { vsp_weight = 0, probe.attributes = ["means"] }

Paths are relative to the file; {seed} in `from`, a checkpoint to start from, stands for the cell's seed.  An option of a method
goes before one of a scene, and that before one of the top.  A cell is one run of `landscape train` in OUT/SCENE/METHOD/SEED;
all of the first seed come before those of the second, so that a sweep that is stopped has compared like with like.
"""

from collections.abc import Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, get_type_hints

from analysis.console.overrides import leaves, read_value
from analysis.probe.options import ProbeOptions
from analysis.train.options import TrainOptions
from landscape.errors import InputError
from splat.model.untrusted import read_toml, require_name
from splat.training.methods.methods import METHODS, presets
from splat.training.origin.options import Trainer

OF_THE_SWEEP = {"scene", "out", "seed", "resume", "method", "set"}  # options of train that have a place of their own
OF_THE_CELL = {"checkpoint", "out", "foreign"}  # options of probe that the cell decides
TRAINER = get_type_hints(Trainer)
TRAINING = {
    name.strip("_"): hint
    for name, hint in (get_type_hints(TrainOptions) | TRAINER).items()
    if name not in OF_THE_SWEEP | {"foreign"}
}
PROBING = {name: hint for name, hint in get_type_hints(ProbeOptions).items() if name not in OF_THE_CELL}
TOP = {"out": Path, "seeds": tuple[int, ...]}
SCENE, METHOD = {"path": Path}, {"method": str}


@dataclass(frozen=True)
class Cell:
    """One training: the names of its scene and method, and its options, with the seed and the folder."""

    scene: str
    method: str
    training: TrainOptions

    @property
    def steps(self) -> int:
        usual = METHODS[self.training.method].ITERATIONS
        preset = presets(self.training.method, self.training.protocol).get("iterations", usual)
        return int(preset if self.training.iterations is None else self.training.iterations)

    @property
    def seed(self) -> int:
        return self.training.seed

    @property
    def out(self) -> Path:
        assert self.training.out is not None
        return self.training.out

    @property
    def name(self) -> str:
        return f"{self.scene}/{self.method}/{self.seed}"


@dataclass(frozen=True)
class Sweep:
    """Cells in the order in which they run; probe: how each is probed, None for not at all.  scenes: in the file's order."""

    file: Path
    out: Path
    cells: tuple[Cell, ...]
    probe: ProbeOptions | None

    @property
    def scenes(self) -> list[str]:
        return list(dict.fromkeys(cell.scene for cell in self.cells))


def read_sweep(file: Path, out: Path | None = None) -> Sweep:
    """The sweep in a file; out goes before what the file says.  ValueError names the key that is wrong."""
    if not file.is_file():
        raise FileNotFoundError(
            f"expected a sweep in TOML at {file}, found no such file; landscape sweep --help has an example"
        )
    content = read_toml(file, "a sweep in TOML")
    try:
        return _sweep(content, file, out)
    except ValueError as error:
        raise InputError(f"{file}: {error}") from None


def _sweep(content: dict[str, Any], file: Path, out: Path | None) -> Sweep:
    tables = {name: _tables(content.pop(name, None), name) for name in ("scenes", "methods")}
    table = content.pop("probe", None)
    top = _values(content, TOP | TRAINING, "", file.parent)
    seeds = top.pop("seeds", (0,))
    if not seeds or len(set(seeds)) < len(seeds):
        raise InputError(f"expected different seeds, at least one, got seeds = {list(seeds)}")
    if (folder := out or top.pop("out", None)) is None:
        raise InputError(
            'expected the folder of the results, as in out = "sweeps/fern", got no out; add it or give --out'
        )
    shared = {name: value for name, value in top.items() if name in TRAINING}
    pairs = {
        (scene, method): shared | _scene(scene_table, scene, file) | _method(method_table, method, file)
        for scene, scene_table in tables["scenes"].items()
        for method, method_table in tables["methods"].items()
    }
    cells = tuple(
        Cell(scene, method, _options(options, seed, folder / scene / method / str(seed)))
        for seed in seeds
        for (scene, method), options in pairs.items()
    )
    return Sweep(file, folder, cells, None if table is None else _probe(table, file))


def _options(options: Mapping[str, Any], seed: int, out: Path) -> TrainOptions:
    """Options of a cell; {seed} in its start checkpoint is its seed."""
    start = options.get("from")
    foreign = Trainer(**{name: value for name, value in options.items() if name in TRAINER})
    rest = {name: value for name, value in options.items() if name not in {"from", *TRAINER}}
    source = start and Path(str(start).replace("{seed}", str(seed)))
    return TrainOptions(**rest, foreign=foreign, seed=seed, out=out, from_=source)


def _probe(table: Any, file: Path) -> ProbeOptions:
    """The options of every cell's probe; its checkpoint is the cell's."""
    if not isinstance(table, dict):
        raise InputError(
            f"expected a table [probe] of options of landscape probe, empty for its defaults, got {table!r}"
        )
    return ProbeOptions(Path(), **_values(table, PROBING, "probe.", file.parent))


def _tables(found: Any, name: str) -> dict[str, dict[str, Any]]:
    """The tables [name.X], at least one, each X fit for a folder."""
    if not isinstance(found, dict) or not found:
        raise InputError(f"expected at least one table [{name}.NAME], got {'none' if not found else repr(found)}")
    for key, table in found.items():
        if not isinstance(table, dict):
            raise InputError(f"expected a table [{name}.{key}], got {key} = {table!r}")
        require_name(key)
    return found


def _scene(table: Mapping[str, Any], name: str, file: Path) -> dict[str, Any]:
    values = _values(table, SCENE | TRAINING, f"scenes.{name}.", file.parent)
    if "path" not in values:
        raise InputError(f"expected the folder of the scene as scenes.{name}.path, got none")
    return {"scene": values.pop("path"), **values}


def _method(table: Mapping[str, Any], name: str, file: Path) -> dict[str, Any]:
    where = f"methods.{name}."
    changes = table.get("set", {})
    if not isinstance(changes, dict):
        raise InputError(f"expected a table {where}set of settings, as in set = {{ gamma = 0.5 }}, got {changes!r}")
    rest = {key: value for key, value in table.items() if key != "set"}
    values = _values(rest, METHOD | TRAINING, where, file.parent)
    texts = tuple(f"{key}={_text(value)}" for key, value in leaves(changes).items())
    return {"method": name, **values, "set": texts}


def _values(table: Mapping[str, Any], hints: Mapping[str, Any], where: str, folder: Path) -> dict[str, Any]:
    """The values of a table by the types that are expected; paths from the folder."""
    values = {}
    for key, value in table.items():
        if key not in hints:
            raise InputError(f"expected a key among {', '.join(hints)}, got {where}{key}")
        read = read_value(value, hints[key], where + key)
        values[key] = folder / read if isinstance(read, Path) else read
    return values


def _text(value: Any) -> str:
    """A value as `--set` reads it.

    >>> _text(True), _text(["means", "sh"]), _text(0.5)
    ('true', 'means,sh', '0.5')
    """
    if isinstance(value, list):
        return ",".join(map(_text, value))
    return str(value).lower() if isinstance(value, bool) else str(value)


def arguments(command: str, options: TrainOptions | ProbeOptions) -> list[str]:
    """The words of the command line that say the same as the options.

    >>> arguments("train", TrainOptions(Path("fern"), densify=False, set=("gamma=0.5",), save_at_psnr=(30, 33)))
    ['train', 'fern', '--set', 'gamma=0.5', '--no-densify', '--save-at-psnr', '30', '33']
    """
    positional, *named = fields(options)
    return [command, str(getattr(options, positional.name)), *_words(options, named)]


def _words(options: Any, named: Sequence[Field]) -> list[str]:
    words = []
    for field in named:
        value = getattr(options, field.name)
        option = field.name.strip("_").replace("_", "-")
        if is_dataclass(value):
            words += _words(value, fields(value))
            continue
        if value == (field.default if field.default_factory is MISSING else field.default_factory()):
            continue
        if isinstance(value, bool):
            words.append(f"--{option}" if value else f"--no-{option}")
        elif option == "set":
            words += [word for each in value for word in (f"--{option}", each)]
        else:
            words += [f"--{option}", *map(str, value if isinstance(value, tuple) else [value])]
    return words
