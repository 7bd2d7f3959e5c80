"""The checks for a machine with a GPU, at toy size: without one, by Triton's interpreter."""

import pytest
import torch
from rich.console import Console

pytest.importorskip("triton", reason="the kernels for GPUs need triton")

from analysis.gpu_check import Check, agreement, checks_of, main, table
from analysis.workloads import Workload
from splat.losses import LossSettings
from tests.splat.held_scenes import two_views
from tests.splat.random_scenes import random_gaussians


def toy(dtype: torch.dtype = torch.float32) -> Workload:
    """For an interpreter: one tile, and a loss without SSIM, whose kernels are slow there."""
    gaussians = random_gaussians(4, 0, logit=1.0, spread=0.4).to(dtype)
    return Workload("toy", gaussians, tuple(two_views(16, 12)[:1]), torch.zeros(3), LossSettings("charbonnier", 0.0))


def test_a_device_agrees_with_the_cpu(device, monkeypatch):
    if device.type == "cpu":  # the second of the two devices that are compared is the interpreter's
        interpreted = iter([False, True])

        def stay(workload: Workload, at: torch.device) -> Workload:
            monkeypatch.setattr("splat.device.INTERPRETED", next(interpreted))
            return workload

        monkeypatch.setattr(Workload, "to", stay)
    checks = agreement(toy(torch.float64), device)  # in single precision so few Gaussians' traces cancel
    assert [check.name for check in checks][:3] == ["loss", "gradient", "H v"] and len(checks) == 8
    assert all(check.holds for check in checks), checks


def test_times_are_held_against_what_is_asked_of_them_and_what_has_no_peer_is_said(capsys):
    seconds = {"gradient": 1.0, "gradient, autograd": 1.5, "gradient, atomic": 1.0, "H v 1": 2.5, "H v 8": 1.1}
    seconds |= {"block diagonal": 2.0, "linearize": 3.0}
    alone = {check.name: check for check in checks_of(seconds, "gsplat cannot be imported")}
    assert alone["H v 1 / gradient"] == Check("H v 1 / gradient", 2.5, 2.0, "gsplat cannot be imported")
    assert [check.holds for check in alone.values()] == [None, None, False, True, True, True]
    beside = {check.name: check.value for check in checks_of(seconds | {"gsplat": 0.5}, None)}
    assert (beside["gradient, atomic / gsplat"], beside["gradient, autograd / gsplat"]) == (2.0, 3.0)
    Console(width=100).print(table("x", list(alone.values())))
    text = capsys.readouterr().out
    assert "does not hold" in text and text.count("gsplat cannot be imported") == 2


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_the_checks_are_refused_in_one_sentence():
    with pytest.raises(ValueError, match=r"expected an NVIDIA GPU for the device cuda, got .*; "):
        main(["10@20x20"])
