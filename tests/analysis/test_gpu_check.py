"""The checks for a machine with a GPU, at toy size: without one, by Triton's interpreter."""

from math import isfinite

import pytest
import torch

pytest.importorskip("triton", reason="the kernels for GPUs need triton")

from analysis.gpu_check import Check, agreement, main, ratios, table
from analysis.workloads import Workload
from splat.losses import LossSettings
from tests.splat.held_scenes import two_views
from tests.splat.random_scenes import random_gaussians


def toy() -> Workload:
    gaussians = random_gaussians(6, 0, logit=1.0, spread=0.7).to(torch.float32)
    return Workload("toy", gaussians, tuple(two_views(18, 12)[:1]), torch.zeros(3), LossSettings("charbonnier"))


def test_a_device_agrees_with_the_cpu_and_its_ratios_are_measured(device, monkeypatch):
    if device.type == "cpu":  # the second of the two devices that are compared is the interpreter's
        calls = iter([False, True])
        monkeypatch.setattr(
            "analysis.gpu_check.placed",
            lambda workload, at: monkeypatch.setattr("splat.device.INTERPRETED", next(calls, True)) or workload,
        )
    checks = agreement(toy(), device)
    assert [check.name for check in checks][:3] == ["loss", "gradient", "H v"] and len(checks) == 8
    assert all(check.holds for check in checks), checks
    found = ratios(toy(), device, repetitions=1)
    assert len(found) == 4 and all(
        check.value is None or (isfinite(check.value) and check.value > 0) for check in found
    )


def test_what_does_not_hold_is_said_and_what_has_no_peer_too(capsys):
    from rich.console import Console

    Console(width=100).print(table("x", [Check("a", 2.0, 1.0), Check("b", None, 1.2), Check("c", 0.5, 1.0)]))
    text = capsys.readouterr().out
    assert "does not hold" in text and "gsplat is not installed" in text


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_the_checks_are_refused_in_one_sentence():
    with pytest.raises(ValueError, match=r"expected an NVIDIA GPU for the device cuda, got .*; "):
        main(["10@20x20"])
