"""What a probe does with the time that it has."""

import pytest
import torch

from analysis.measurement import ProbeSettings, _density, _within
from landscape import CountingOperator
from landscape.density import ActiveSpace
from landscape.operator import DenseOperator

DIM = 50


@pytest.mark.parametrize(("seconds", "shape"), [(40.0, (4, 10)), (20.0, (2, 10)), (10.0, None)])
def test_a_density_has_fewer_start_vectors_before_it_has_too_few_steps(seconds, shape, monkeypatch):
    times = iter([0.0, 4.0])  # of a product with four vectors
    monkeypatch.setattr("analysis.measurement.monotonic", lambda: next(times))
    operator = CountingOperator(DenseOperator(torch.diag(torch.linspace(-1, 3, DIM, dtype=torch.float64))))
    everything, notes = ActiveSpace(lambda V: V, DIM), []
    generator, settings = torch.Generator().manual_seed(0), ProbeSettings(density_steps=10)
    density = _density(operator, everything, generator, settings, seconds, lambda *_: None, notes)
    assert (None if density is None else tuple(density.nodes.shape)) == shape
    said = {40.0: "", 20.0: "2 start vectors instead of 4", 10.0: "left out"}[seconds]
    assert said in " ".join(notes) and len(notes) == (seconds < 40)


@pytest.mark.parametrize(("renders", "held_out", "batch"), [(100, 30, 32), (80, 20, 20), (4, 5, 5)])
def test_a_slice_with_little_time_keeps_its_points_and_judges_them_by_fewer(renders, held_out, batch):
    allowed = _within(ProbeSettings(), seconds=0.5 * renders, each=0.5, workers=2)
    assert (allowed.holdout, allowed.batch, allowed.workers) == (held_out, batch, 2)
    assert allowed.max_seconds == 0.5 * renders and allowed.tolerance == ProbeSettings().slice_tolerance
