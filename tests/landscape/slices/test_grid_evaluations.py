import threading

import numpy as np
import pytest
import torch

from landscape.slices.refinement import SliceSettings
from landscape.slices.slices import evaluate_slice, symmetric_axis
from splat.model.untrusted import KeptArrays
from tests.refusals import misused
from tests.waiting import PATIENCE

CENTER = torch.linspace(-1, 1, 6, dtype=torch.float64)
SPANS = torch.linalg.qr(torch.randn(6, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1)))[0]
AXES = [symmetric_axis(1.0, 21), symmetric_axis(2.0, 17)]


class Objective:
    """A rough loss with a signature, which counts its calls and may die after so many."""

    def __init__(self, dies_after=None, factor=1.0):
        self.calls, self.dies_after, self.factor, self.lock = 0, dies_after, factor, threading.Lock()

    def __call__(self, theta):
        with self.lock:
            self.calls += 1
            if self.dies_after is not None and self.calls > self.dies_after:
                raise KeyboardInterrupt
        return self.factor * float((theta - CENTER).abs().sum()), bool(theta[0] > CENTER[0])


def sliced(objective, store, center=CENTER, axes=AXES, **settings):
    generator, kept = torch.Generator().manual_seed(3), None if store is None else KeptArrays(store)
    return evaluate_slice(
        objective, center, SPANS, axes, settings=SliceSettings(**settings), generator=generator, store=kept
    )


@pytest.mark.parametrize("settings", [{"tolerance": None}, {}, {"workers": 3}], ids=str)
def test_a_killed_slice_continues_and_ends_as_if_it_had_not_been(tmp_path, settings):
    store, whole = tmp_path / "new folder" / "slice.npz", Objective()
    expected = sliced(whole, None, **settings)
    with pytest.raises(KeyboardInterrupt):
        sliced(Objective(dies_after=50), store, **settings)
    rest = Objective()
    found = sliced(rest, store, **settings)
    for name in ("loss", "evaluated", "holdout", "discontinuous"):
        assert torch.equal(getattr(found, name), getattr(expected, name)), name
    assert found.evaluations == expected.evaluations == whole.calls
    # the centre and one point are evaluated anew; what other workers had finished of the batch behind the one that died is lost
    lost = 16 + SliceSettings.holdout if "workers" in settings else 0
    assert whole.calls - 48 <= rest.calls <= whole.calls - 48 + lost
    again = Objective()
    sliced(again, store, **settings)
    assert again.calls == 2
    assert [path.name for path in store.parent.iterdir()] == ["slice.npz"]


def test_a_slice_that_continues_has_its_evaluations_in_total(tmp_path):
    store = tmp_path / "slice.npz"
    with pytest.raises(KeyboardInterrupt):
        sliced(Objective(dies_after=50), store, max_evaluations=200)
    rest = Objective()
    found = sliced(rest, store, max_evaluations=200)
    # the centre, 21 + 17 - 1 points of the axes, 16 that fill the plane and a hold-out of 64
    assert found.reason == "evaluation budget" and found.evaluations == 118 and rest.calls == 118 - 48


def test_a_finer_tolerance_starts_from_what_a_coarser_one_found(tmp_path):
    store = tmp_path / "slice.npz"
    coarse = sliced(Objective(), store, tolerance=0.5)
    objective = Objective()
    fine = sliced(objective, store, tolerance=0.01)
    assert objective.calls < fine.evaluations and coarse.evaluations < fine.evaluations


@pytest.mark.parametrize(
    "changed",
    [
        {"center": CENTER + 1e-12},
        {"center": CENTER.float()},
        {"axes": [AXES[0] * 2, AXES[1]]},
        {"axes": [AXES[1], AXES[0]]},
    ],
    ids=["center", "dtype", "range", "shape"],
)
def test_the_evaluations_of_another_slice_are_refused(tmp_path, changed):
    store = tmp_path / "slice.npz"
    sliced(Objective(), store, tolerance=0.1)
    before = store.read_bytes()
    misused(r"another center, other directions.*delete this one", sliced, Objective(), store, **changed)
    assert store.read_bytes() == before


def test_the_evaluations_of_another_objective_are_refused(tmp_path):
    def shifted(theta):
        value, signature = Objective()(theta)
        return value + 1e-3, signature

    store = tmp_path / "slice.npz"
    sliced(Objective(), store, tolerance=0.1)
    misused(r"evaluations of this objective.*0\.001 at the centre, got one that is 0\.0", sliced, shifted, store)
    misused("evaluations of this objective", sliced, lambda theta: Objective()(theta)[0], store)


@pytest.mark.parametrize("offset", [0.0, 3.0])
def test_an_objective_that_is_another_one_but_for_the_centre_is_refused(tmp_path, offset):
    """One that is least at the centre, say, times a factor."""
    store = tmp_path / "slice.npz"
    sliced(lambda theta: offset + Objective()(theta)[0], store, tolerance=0.1)
    before = store.read_bytes()
    with pytest.raises(ValueError, match=r"evaluations of this objective.*at point [0-9]+, got one that is.*delete"):
        sliced(lambda theta: offset + Objective(factor=1.001)(theta)[0], store)
    assert store.read_bytes() == before


def test_a_damaged_file_is_refused(tmp_path):
    store = tmp_path / "slice.npz"
    sliced(Objective(), store, tolerance=0.1)
    whole = store.read_bytes()
    broken = bytearray(whole)
    broken[whole.index(b"values.npy") + 200] ^= 0xFF
    for content in (b"", whole[: len(whole) // 2], bytes(broken), b"no archive"):
        store.write_bytes(content)
        misused(r"got a damaged file.*delete this one", sliced, Objective(), store)
    np.savez(store, loss=np.zeros(3))
    misused("damaged file", sliced, Objective(), store)


def test_workers_evaluate_at_the_same_time():
    barrier = threading.Barrier(3, timeout=PATIENCE)
    first = threading.Event()

    def together(theta):
        if first.is_set():
            barrier.wait()  # passes when three threads have come
        first.set()
        return 0.0

    evaluate_slice(
        together, CENTER, SPANS[:, :1], [symmetric_axis(1.0, 9)], settings=SliceSettings(tolerance=None, workers=3)
    )


def test_an_objective_that_fails_is_not_hidden():
    def failing(theta):
        if theta[0] > CENTER[0]:
            raise RuntimeError("no memory")
        return 1.0

    for workers in (1, 2):
        with pytest.raises(RuntimeError, match="no memory"):
            sliced(failing, None, workers=workers)
