import threading

import numpy as np
import pytest
import torch

from landscape.slices.refinement import SliceSettings
from landscape.slices.slices import evaluate_slice, symmetric_axis
from splat.model.untrusted import KeptArrays
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
    # the centre is evaluated anew; what other workers had finished of the batch behind the one that died is lost
    lost = 16 + SliceSettings.holdout if "workers" in settings else 0
    assert whole.calls - 49 <= rest.calls <= whole.calls - 49 + lost
    again = Objective()
    sliced(again, store, **settings)
    assert again.calls == 1
    assert [path.name for path in store.parent.iterdir()] == ["slice.npz"]


def test_a_slice_that_continues_has_its_evaluations_in_total(tmp_path):
    store = tmp_path / "slice.npz"
    with pytest.raises(KeyboardInterrupt):
        sliced(Objective(dies_after=50), store, max_evaluations=200)
    rest = Objective()
    found = sliced(rest, store, max_evaluations=200)
    # the centre, 21 + 17 - 1 points of the axes, 16 that fill the plane and a hold-out of 64
    assert found.reason == "evaluation budget" and found.evaluations == 118 and rest.calls == 118 - 49


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
def test_another_slice_is_evaluated_anew(tmp_path, changed):
    store = tmp_path / "slice.npz"
    sliced(Objective(), store, tolerance=0.1)
    again = Objective()
    assert sliced(again, store, **changed).evaluations == again.calls


def test_another_objective_is_evaluated_anew(tmp_path):
    """One with another value at the centre, or that names no pieces."""

    def shifted(theta):
        value, signature = Objective()(theta)
        return value + 1e-3, signature

    for other in (shifted, lambda theta: Objective()(theta)[0]):
        store = tmp_path / "slice.npz"
        sliced(Objective(), store, tolerance=0.1)
        found, alone = sliced(other, store), sliced(other, None)
        assert torch.equal(found.loss, alone.loss)
        assert (found.discontinuous is None) == (alone.discontinuous is None)


def test_what_a_damaged_file_holds_is_evaluated_anew(tmp_path):
    store = tmp_path / "slice.npz"
    sliced(Objective(), store, tolerance=0.1)
    whole = store.read_bytes()
    broken = bytearray(whole)
    broken[whole.index(b"evaluations.npy") + 200] ^= 0xFF
    np.savez(other := tmp_path / "other.npz", loss=np.zeros(3))
    for content in (b"", whole[: len(whole) // 2], bytes(broken), b"no archive", other.read_bytes()):
        store.write_bytes(content)
        again = Objective()
        assert sliced(again, store, tolerance=0.1).evaluations == again.calls > 1


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
