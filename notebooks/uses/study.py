"""Study of next views: train on few views, pick further ones by each rule, train on, score the held-out views.

    out = "../runs/next-view"       # folder of the results
    rules = ["d", "t", "published", "uniform", "random"]
    seeds = [0, 1, 2]
    start = 2                       # views at first, the first of the scene's protocol
    rounds = 3                      # views added, one a round
    first_steps = 400               # of training before the first is picked
    steps = 200                     # after each of them

    [scenes.fern]
    path = "../data/fern"
    downscale = 4

Paths are relative to the file.  uniform: the camera that is farthest from all that are chosen; random: by the seed.  A rule, a
scene and a seed make a cell, OUT/cells/SCENE-RULE-SEED.json; those that there are stay, so that the same command continues.
OUT/study.csv: a row for each round of each cell; study.png: held-out PSNR by the number of views.
"""

from pathlib import Path
from typing import Annotated

import msgspec
import pandas as pd
import torch
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from rich.console import Console

from analysis.commands.uses.next_view import picked
from analysis.console.plain import say
from analysis.records.json_files import json_text, read_json
from analysis.records.schema import Count
from figures.style import BLACK, BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILION, literal, new_figure, save, style
from landscape.errors import InputError
from splat.curvature.scores.information import GAINS, informations
from splat.model.untrusted import read_toml, require_name, write_atomically
from splat.scenes.scene import Scene, load_scene
from splat.scenes.splits import split_scene
from splat.scenes.view import View
from splat.training.loop import train
from splat.training.origin.frames import posed, shift_to_origin
from splat.training.score.evaluate import evaluate
from splat.training.start import initial_gaussians
from splat.training.state import TrainConfig, Training

RULES = (*GAINS, "uniform", "random")
LOOKS = {
    "d": ("D-optimal, blocks", BLUE),
    "t": ("T-optimal, blocks", SKY),
    "e": ("E-optimal, blocks", PURPLE),
    "d_diagonal": ("D-optimal, diagonal", GREEN),
    "published": ("FisherRF's diagonal", VERMILION),
    "uniform": ("uniform", BLACK),
    "random": ("random", ORANGE),
}


class StudyScene(msgspec.Struct, forbid_unknown_fields=True):
    path: str
    downscale: float = 1.0


class Study(msgspec.Struct, forbid_unknown_fields=True):
    """The file, see the module's docstring."""

    out: str
    scenes: dict[str, StudyScene]
    rules: tuple[str, ...] = ("d", "published", "uniform", "random")
    seeds: tuple[int, ...] = (0, 1, 2)
    start: int = 2
    rounds: int = 3
    first_steps: int = 400
    steps: int = 200


Row = dict[str, str | int | float]


class CellRow(msgspec.Struct):
    """A row of `cell`, and which cell."""

    scene: str
    rule: str
    seed: int
    round: Count
    views: Count
    added: str
    psnr: float
    ssim: float


class Cell(msgspec.Struct):
    """A file of OUT/cells: told, its settings in words, and its rows, one at least."""

    told: str
    rows: Annotated[list[CellRow], msgspec.Meta(min_length=1)]


def run_study(file: Path) -> int:
    """Run the cells that are missing; returns the exit code."""
    study = read_study(file)
    out, console, rows = file.parent / study.out, Console(stderr=True), list[Row]()
    (out / "cells").mkdir(parents=True, exist_ok=True)
    cells = [(name, rule, seed) for seed in study.seeds for name in study.scenes for rule in study.rules]
    for done, (name, rule, seed) in enumerate(cells):
        path = out / "cells" / f"{name}-{rule}-{seed}.json"
        told = repr((study.scenes[name], study.start, study.rounds, study.first_steps, study.steps))
        found = _kept(path, told)
        if found is None:
            scene = load_scene(file.parent / study.scenes[name].path, downscale=study.scenes[name].downscale)
            shift = shift_to_origin(scene)
            scene = posed(scene, None if shift is None else shift.tolist(), centred=False)
            found = [{"scene": name, "rule": rule, "seed": seed, **row} for row in cell(scene, study, rule, seed)]
            write_atomically(path, json_text({"told": told, "rows": found}).encode())
        rows += found
        last = f"{found[-1]['psnr']:.2f} dB on {found[-1]['views']} views"
        say(f"{done + 1} of {len(cells)}: {name}, {rule}, seed {seed}: {last}", console=console)
    table = pd.DataFrame(rows)
    write_atomically(out / "study.csv", table.to_csv(index=False).encode())
    save(draw_study(table), out / "study.png")
    last = table[table["round"] == study.rounds].groupby(["scene", "rule"])["psnr"].agg(["mean", "std", "count"])
    say(last.round(2).to_string(), f"study.csv, study.png in {out}")
    return 0


def read_study(file: Path) -> Study:
    """InputError where the file is none."""
    try:
        study = msgspec.convert(read_toml(file), Study)
        for name in study.scenes:
            require_name(name)
    except (InputError, msgspec.ValidationError) as error:
        raise InputError(f"expected a study of next views in {file}, got: {error}") from None
    if unknown := [rule for rule in study.rules if rule not in RULES]:
        raise InputError(f"expected rules among {', '.join(RULES)} in {file}, got {unknown[0]!r}")
    if any(len(set(each)) < max(len(each), 1) for each in (study.seeds, study.rules)):
        raise InputError(f"expected different seeds and rules, at least one of each, in {file}, got {study}")
    if min(study.start - 1, study.rounds, study.first_steps, study.steps) < 1 or not (study.seeds and study.scenes):
        raise InputError(f"expected start of at least 2, rounds, steps and seeds in {file}, got {study}")
    return study


def _kept(path: Path, told: str) -> list[Row] | None:
    """Earlier result of the cell, under the same settings."""
    if not path.is_file():
        return None
    found = read_json(path, Cell, "a cell of a study", "remove it, and it is measured again")
    if found.told != told:
        raise InputError(f"expected cells of the study's settings {told}, got {found.told} in {path}; name another out")
    return [msgspec.to_builtins(row) for row in found.rows]


def cell(scene: Scene, study: Study, rule: str, seed: int) -> list[Row]:
    """A row for each round, the first before any view is picked: views, PSNR and SSIM held out, and the view that was added."""
    split = split_scene(scene, study.start)
    unused = [frame.name for frame in scene.frames if frame.name not in {*split.train, *split.test}]
    pool = [name for name in unused if scene.select([name])[0].subset in (None, "train")]
    if len(pool) < study.rounds:
        raise InputError(f"expected at least {study.rounds} views of {scene.name} that are not used, got {len(pool)}")
    views = {view.name: view for view in scene.load([*split.train, *pool])}
    held_out, chosen = scene.load(split.test), list(split.train)
    red, green, blue = scene.background.tolist()
    config = TrainConfig(
        iterations=study.first_steps + study.rounds * study.steps, seed=seed, background=(red, green, blue)
    )
    drawn = torch.randperm(len(pool), generator=torch.Generator().manual_seed(seed)).tolist()
    first = [views[name] for name in chosen]
    start = initial_gaussians(scene, first, 0, generator=torch.Generator().manual_seed(seed))
    training, rows, added = Training.start(start, scene.extent([*views]), config), list[Row](), ""
    for turn in range(study.rounds + 1):
        if turn:
            left = [name for name in pool if name not in chosen]
            added = pool[drawn[turn - 1]] if rule == "random" else _pick(training, views, chosen, left, rule)
            chosen.append(added)
        training.order = []
        for done in train(training, [views[name] for name in chosen]):
            if done.step == study.first_steps + turn * study.steps:
                break
        scores = evaluate(training.gaussians, held_out, scene.background)
        row: Row = {"round": turn, "views": len(chosen), "added": added, "psnr": scores.psnr, "ssim": scores.ssim}
        rows.append(row)
    return rows


def _pick(training: Training, views: dict[str, View], chosen: list[str], left: list[str], rule: str) -> str:
    cameras = {name: views[name].camera for name in (*chosen, *left)}
    if rule == "uniform":
        return max(left, key=lambda name: min(float((cameras[name].centre - cameras[c].centre).norm()) for c in chosen))
    config = training.config
    known = informations(training.gaussians, cameras, config.background_colour(torch.float32), config.render)
    return picked([known[name] for name in chosen], known, left, 1, rule)[0]


def draw_study(table: pd.DataFrame) -> Figure:
    """Held-out PSNR by the number of views: means over the seeds, and dots for each of them."""
    scenes = list(dict.fromkeys(table["scene"]))
    with style():
        figure = new_figure(2.6, 3.3 * len(scenes))
        for axes, scene in zip(figure.subplots(1, len(scenes), squeeze=False)[0], scenes, strict=True):
            for place, name in enumerate([name for name in LOOKS if name in {*table["rule"]}]):
                words, colour = LOOKS[name]
                rows = pd.DataFrame(table[(table["scene"] == scene) & (table["rule"] == name)])
                mean = rows.pivot_table(index="views", values="psnr")  # by default the mean
                axes.plot(mean.index, mean["psnr"], color=colour, label=words)
                axes.plot(
                    rows["views"] + 0.03 * place, rows["psnr"], color=colour, marker=".", markersize=3, linestyle="none"
                )
            axes.set(title=literal(scene), xlabel="training views", ylabel="held-out views, PSNR (dB)")
            axes.xaxis.set_major_locator(MaxNLocator(integer=True))
            axes.grid(visible=True)
            axes.legend()
    return figure
