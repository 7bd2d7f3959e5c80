"""Fields of the Gaussians as map and view show them: of the blocks and the views, and shares of a probe's eigenvectors."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from msgspec import structs

from analysis.measures.localization import masses
from analysis.measures.steepest import End
from analysis.records.quantities import Shade, percent, quantity
from analysis.records.records import recorded_probe
from landscape.results import Progress
from splat.curvature.fields import FIELDS, Field, Values, scene_fields
from splat.curvature.objective import SceneObjective
from splat.render.sight import Sight
from splat.training.origin.fingerprint import Fingerprint

ENDS = {"e1": "e₁", "e_min": "eₘᵢₙ"}  # fields of a probe's eigenvectors: the share of each in a Gaussian
PROBE = "probe"


@dataclass(frozen=True, eq=False)
class Fields:
    """Fields of the Gaussians in sight, with their kinds.  ends: of the spectrum that a probe recorded, by field."""

    values: Values
    kinds: Mapping[str, Field]
    ends: Mapping[str, End]
    sights: Sequence[Sight]

    @property
    def weight(self) -> np.ndarray:
        return self.values["weight"].numpy()

    def shade(self, name: str) -> Shade:
        """The scale of a field; of `one_view` from 1 / views, equal weights, to 1."""
        kind, views = self.kinds[name], len(self.sights)
        shade = Shade.of(name, kind.words, kind.unit, kind.scale, self.values[name].numpy(), self.weight)
        return structs.replace(shade, low=1 / views, high=1.0) if name == "one_view" and views > 1 else shade


def in_words(kind: Field, value: float) -> str:
    """A value of a field with its unit: whole numbers as such, shares in percent.

    >>> [in_words(FIELDS[name], x) for name, x in (("views", 2.0), ("one_view", 1.0), ("weight", 2.5))]
    ['2', '100%', '2.50 px']
    """
    whole = f"{value:,.0f}" if value.is_integer() else quantity(value)
    return f"{percent(value) if kind.words.startswith('share') else whole} {kind.unit}".rstrip()


def measured_fields(
    objective: SceneObjective, probe: Path, made: Fingerprint, notes: list[str], report: Progress
) -> Fields:
    """Fields of the blocks and the views, and masses in the eigenvectors of the probe, where that has the same subject."""
    values, sights = scene_fields(objective, report)
    ends, kinds, recorded = {}, dict(FIELDS), recorded_probe(probe, made, notes)
    if recorded is not None:
        about, vectors = recorded.data.eigenvalues, recorded.arrays["eigenvectors"]
        known = {
            "e1": ("largest", about.max, "the steepest direction"),
            "e_min": ("smallest", about.min, "the flattest direction"),
        }
        for name, (group, end, title) in known.items():
            if group in vectors and vectors[group].shape[1] and end.value and end.renders:
                title = "the most negative direction" if end.value < 0 else title
                ends[name] = End(ENDS[name], title, torch.from_numpy(vectors[group][:, 0]), end.value, end.renders)
                values[name] = masses(ends[name].vector, objective.active)
                kinds[name] = Field(f"share of {ENDS[name]}", "", "log")
    return Fields(values, kinds, ends, sights)
