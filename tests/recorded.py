"""Synthetic records for the tests of what reads records: a quartic valley with known numbers."""

import copy
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from analysis.records.json_files import fitted, plain
from analysis.records.provenance import provenance
from analysis.records.quantities import HARD
from analysis.records.records import ProbeRecord, Record, SliceRecord, read_record, record_folder, write_record
from analysis.records.tables import NEEDS_DENSITY

ATTRIBUTES = ("means", "log_scales", "quats", "opacity_logits", "sh")


def soft(text: str) -> str:
    """Text with spaces within its numbers that are as those between words."""
    return text.replace(HARD, " ")


def long_numbers(text: str) -> list[str]:
    """Numbers of more than three digits, leading zeros not counted; of whole ones, those without the separators of counts."""
    found = re.findall(r"(?<![\w.,×])(?:\d[\d,]*\.\d+|\d{5,})(?![\w.]*\.\d)", text)
    return [each for each in found if len(re.sub(r"[.,]", "", each).lstrip("0")) > 3]


def probe_of(data: dict[str, Any]) -> ProbeRecord:
    """The record of a probe with this data."""
    return fitted(copy.deepcopy(data) | {"arrays": {}}, ProbeRecord, "a record", "")


def slice_of(data: dict[str, Any]) -> SliceRecord:
    return fitted(copy.deepcopy(data) | {"arrays": {}}, SliceRecord, "a record", "")


def written(folder: Path, data: dict[str, Any], arrays: dict[str, dict[str, np.ndarray]]) -> Record[Any]:
    """The record in a folder: of a probe, or of a slice where there are no traces."""
    record = probe_of(data) if "traces" in data else slice_of(data)
    with record_folder(folder, record.FILE) as partial:
        write_record(partial, record, arrays)
    return read_record(folder)


def own(run: Path, **options: Any) -> dict[str, Any]:
    """The fingerprint of a probe with these options of the checkpoint in a run, for a record's provenance."""
    from analysis.probe.command import asked  # slow
    from analysis.probe.options import ProbeOptions
    from splat.training.checkpoint import load_checkpoint

    path = run / "checkpoint.pt"
    return {"fingerprint": plain(asked(ProbeOptions(path, **options), load_checkpoint(path)))}


def written_map(folder: Path, made: dict[str, Any]) -> None:
    """The files of a map that a page reads.  made: its provenance."""
    shade = {"name": "largest", "words": "largest <curvature>", "unit": "1", "scale": "log", "low": 0.0, "high": 1.0}
    swaps = {"lengths": [1.0], "share": [[0.5]], "pairs": [4], "jump": None, "jump_error": None, "sampled": 0}
    axes = {"needles": 0.1, "needles_steepest": {}, "needles_trace": {}, "one_view": 0.2}
    axes |= {"swaps": swaps, "one_view_trace": None, "opacity_one_view": None}
    found = {"gaussians": 5, "seen": 4, "field": "largest", "shades": {"largest": shade}, "fragility": axes}
    found |= {"panels": [{"name": "a.png", "place": 0, "file": "view-000", "psnr": 20.0}], "provenance": made}
    found["shades"]["error"] = shade | {"name": "error", "words": "error"}
    carrier = {
        "gaussian": 3778,
        "share": 0.8,
        "attributes": {"quats": 0.8},
        "sigmas": [0.4, 0.02, 0.01],
        "aspect": 41.0,
    }
    carrier |= {"opacity": 0.7, "views": 1, "one_view": 1.0, "outline": [4.0, 3.0, 2.0, 1.0, 0.0]}
    end = {"name": "e₁", "curvature": 3.0, "participation": 1.5, "carriers": [carrier], "view": "a.png", "step": 0.1}
    end |= {
        "crop": [0, 0, 4, 3],
        "losses": [1.1, 1.0, 1.2],
        "factors": [1.9, 0.5],
        "difference": shade,
        "file": "steepest-e1",
    }
    found["steepest"] = [end | {"sentence": "80% of e₁ turns Gaussian 3,778.", "rendered": "Not confirmed by renders."}]
    found["steepest"].append(found["steepest"][0] | {"name": "e_min", "curvature": -1.0, "factors": [-0.2, -1.9]})
    found["steepest"][1] |= {"sentence": "97% of e_min.", "rendered": "", "file": "steepest-e_min"}
    found["sentences"] = ["80% of e₁ turns Gaussian 3,778.", "97% of e_min.", "Position: half of all pairs."]
    folder.mkdir()
    (folder / "map.json").write_text(json.dumps(found))
    largest, error = np.full((6, 8), 254, np.uint8), np.zeros((6, 8), np.uint8)
    np.savez(folder / "view-000.npz", largest=largest, error=error)
    for name in ("steepest-e1.png", "fragility-000.png"):
        Image.new("RGB", (8, 6)).save(folder / name)


def synthetic(scale: float = 1.0, seed: int = 0) -> tuple[dict[str, Any], dict[str, dict[str, np.ndarray]]]:
    """(data, arrays) of a probe, for `written`; every curvature is multiplied by `scale`."""
    random = np.random.default_rng(seed)
    traces, samples = {}, {}
    for attribute, value in zip(ATTRIBUTES, (4.1e5, 8.3e3, 52.0, -310.0, 12.0), strict=True):
        draws = scale * (value + 0.1 * abs(value) * random.standard_normal(16))
        traces[attribute] = _trace(draws, dim=3000)
        samples[attribute] = draws
    top, second, bottom = 3.1e4 * scale, 1.2e4 * scale, -2.2e2 * scale
    ritz = np.concatenate([-np.geomspace(-bottom, 1e-3 * scale, 20), np.geomspace(1e-3 * scale, top, 40)])
    ritz.sort()
    residuals = np.abs(ritz) * np.minimum(1.0, 1e-4 * np.exp(np.minimum(np.arange(60), 59 - np.arange(60)) / 1.5))
    found = {"matvecs": 60, "method": "lanczos"}
    ends = {
        "max": {"value": top, "residual": 12.0 * scale, **found, "reason": "tolerance"},
        "min": {"value": bottom, "residual": 3.0 * scale, **found, "reason": "matvec budget"},
    }
    indices = {
        "eigenvalue_ratio": {"value": top / bottom, "low": -143.0, "high": -139.0, "note": ""},
        "negative_ratio": {"value": -bottom / top, "low": 1 / 143.0, "high": 1 / 139.0, "note": ""},
        "top_mass": {"value": None, "low": None, "high": None, "note": NEEDS_DENSITY},
    }
    counts = {"gaussians": 10091, "visible_gaussians": 9874, "parameters": 595369, "active_parameters": 136682}
    counts |= {"sh_degree_stored": 3, "sh_degree_active": 0, "views": 3, "products": 140}
    skipped = {"value": None, "bound": 1e-3, "passed": None, "note": "every direction crosses a sort"}
    checks = {
        "symmetry": {"value": 3e-7, "bound": 1e-5, "passed": True},
        "round_off": {"value": 0.0, "bound": 1e-6, "passed": True},
        "finite_difference": skipped,
    }
    loss = {"loss": "0.8 L1 + 0.2 (1 - SSIM)", "value": 0.0832, "gradient_norm": 0.41}
    data = {"objective": loss, "traces": traces, "eigenvalues": ends, "anisotropy": indices, "slice": _plane(scale)}
    data |= {"counts": counts, "checks": checks, "notes": ["SH bands 1 to 3 are not in use and were left out"]}
    data["timing"] = {"load": 0.4, "linearise": 0.9, "traces": 8.2, "eigenvalues": 21.5, "slice": 14.0, "total": 45.0}
    made = provenance(seed, lanes=16, checkpoint="checkpoint.pt", scene="fern", iteration=2000)
    data["provenance"] = plain(made)
    spectrum = {"ritz_values": ritz, "residuals": residuals, "nodes": ritz * random.uniform(0.9, 1.0, (3, 60))}
    spectrum["weights"] = random.dirichlet(np.ones(60), 3)
    return data, {"traces": samples, "spectrum": spectrum, "slice": _grid(top, second)}


def depth_section(ratio: float | None = 0.0068) -> dict[str, Any]:
    """The section of a record that has positions split into depth and lateral."""
    known = {"sign": "positive", "dim": 3000, "probes": 16, "method": "exact"}
    trace = {"value": 3.9e-4, "standard_error": 1e-5, **known}
    rise = {"depth": 1.4e-4, "depth_error": 1e-5, "depth_crossed": 0.75, "lateral": 5e-4, "lateral_error": 2e-6}
    rows = [{"pixels": 0.1, "ratio": 0.28, "ratio_error": 0.02, "lateral_crossed": 0.5, **rise}]
    curvature = {"depth": trace, "lateral": {"value": 20.4, "standard_error": 0.3, **known}}
    quotient = {"value": 3.8e-5, "low": 3.7e-5, "high": 3.9e-5, "note": ""}
    section = {"gradient_ratio": ratio, "gradient_median": ratio, "pairs": 23054, "curvature": curvature}
    return section | {"curvature_ratio": quotient, "rises": rows}


def _trace(draws: np.ndarray, dim: int) -> dict[str, Any]:
    value, error = float(draws.mean()), float(draws.std(ddof=1) / np.sqrt(len(draws)))
    low, high = value - 2.13 * error, value + 2.13 * error
    sign = "undetermined" if low * high <= 0 else "positive" if low > 0 else "negative"
    found = {"value": value, "standard_error": error, "low": low, "high": high, "confidence": 0.95, "sign": sign}
    found |= {"tau": float(np.sqrt(max(value, 0.0) / dim)), "dim": dim, "probes": len(draws)}
    return found | {"method": "rademacher", "reason": "tolerance"}


def _plane(scale: float) -> dict[str, Any]:
    curvatures = {"e₁": 3.1e4 * scale, "e₂": 1.2e4 * scale}
    directions = [
        {"name": name, "curvature": c, "residual": 1e-3 * c, "unit": float(np.sqrt(2 * 8e-4 / c))}
        for name, c in curvatures.items()
    ]
    counts = {"points": 357, "crossed_points": 326, "evaluations": 357}
    return {"directions": directions, "loss_scale": 8e-4, "center_loss": 0.0832, **counts}


def _grid(top: float, second: float) -> dict[str, np.ndarray]:
    """A tilted, slightly quartic valley on 21 x 17 points, three units to either side of the centre."""
    x = np.linspace(-3, 3, 21) * np.sqrt(2 * 8e-4 / top)
    y = np.linspace(-3, 3, 17) * np.sqrt(2 * 8e-4 / second)
    u, v = np.meshgrid(x * np.sqrt(top / 2), y * np.sqrt(second / 2), indexing="ij")
    slope = 0.02 * u - 0.01 * v
    model = 0.0832 + slope + u**2 + v**2
    loss = model + 0.004 * np.abs(u) ** 1.5 - 40 * v**4
    return {"x": x, "y": y, "loss": loss, "model": model, "crossed": np.hypot(u, v) > 0.03}


def synthetic_line(scale: float = 1.0) -> tuple[dict[str, Any], dict[str, dict[str, np.ndarray]]]:
    """(data, arrays) of a slice along a line of curvature 40 scale, with a kink that finite steps see from 1e-4 on."""
    whole, _ = synthetic()
    x, curvature, center = np.linspace(-3, 3, 21) * 1e-3, 40.0 * scale, 0.0832
    model = center + 2e-3 * scale * x + curvature * x**2 / 2
    evaluated = np.arange(21) % 2 == 0
    steps = np.array([1e-6, 1e-5, 1e-4, 1e-3])
    direction = {"name": "gradient", "kind": "gradient", "slope": 2e-3 * scale, "curvature": curvature}
    direction |= {"residual": None, "unit": 2e-3, "scale": "units of the parameters"}
    line = {"directions": [direction], "loss_scale": 8e-5 * scale, "center_loss": center, "points": 21}
    line |= {"evaluated_points": 11, "crossed_points": 6, "evaluations": 12, "interpolation_error": 0.004}
    probe = {"steps": steps.tolist(), "curvatures": [c * scale for c in (-3e4, 41.0, 55.0, 70.0)]}
    probe |= {"round_off": [error * scale for error in (4e4, 4.0, 0.04, 4e-4)]}
    probe |= {"crossed": [False, False, True, True], "infinitesimal": curvature}
    data = {"objective": whole["objective"], "slice": line | {"holdout_points": 3}, "finite_probe": probe}
    data |= {name: whole[name] for name in ("counts", "timing", "notes", "provenance")}
    loss = model + 15.0 * scale * x * np.abs(x)
    arrays = {"x": x, "loss": loss, "model": model, "crossed": evaluated & (x > 0), "evaluated": evaluated}
    return data, {"slice": arrays}
