"""LPIPS with a stand-in for its package, which is not among the requirements."""

import sys
import warnings
from types import ModuleType
from urllib.error import URLError

import pytest
import torch
from torch import Tensor, nn

from splat.training.score.evaluate import MissingPerceptual, load_lpips
from tests.refusals import refused


class Network(nn.Module):
    """Takes what lpips.LPIPS takes, and gives a number that tells the arguments apart."""

    def __init__(self, net: str, verbose: bool) -> None:
        super().__init__()
        assert net == "vgg" and not verbose
        warnings.warn("deprecated", UserWarning, stacklevel=2)
        self.weight = nn.Parameter(torch.ones(()))
        self.drop = nn.Dropout(0.9)

    def forward(self, image: Tensor, target: Tensor) -> Tensor:
        assert image.shape == target.shape
        assert image.shape[:2] == (1, 3) and image.dtype == target.dtype == torch.float32
        assert not torch.is_grad_enabled() and not self.weight.requires_grad
        return self.weight * self.drop(image - 2 * target).mean().view(1, 1, 1, 1)


def install(monkeypatch: pytest.MonkeyPatch, network: object) -> None:
    module = ModuleType("lpips")
    module.LPIPS = network  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "lpips", module)


def test_the_network_sees_both_images_in_0_to_1_as_3dgs_feeds_them(monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch, Network)
    with warnings.catch_warnings(action="error"):
        distance = load_lpips()
    target = torch.rand(3, 16, 20, dtype=torch.float64)
    image = torch.rand(3, 16, 20) * 3 - 1
    value = distance(image, target)
    assert isinstance(value, float)
    assert value == pytest.approx(float((image.clamp(0, 1).double() - 2 * target).mean()), abs=1e-6)


def test_an_image_too_small_for_the_network_has_no_distance(monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch, Network)
    assert load_lpips()(torch.zeros(3, 15, 20), torch.zeros(3, 15, 20)) is None


def test_without_the_package_one_sentence_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "lpips", None)  # an import of it fails
    refused(r"^LPIPS is left out: .*lpips.*pip install -e '\.\[lpips\]'$", load_lpips, error=MissingPerceptual)


@pytest.mark.parametrize("error", [URLError("no route"), RuntimeError("invalid hash value")])
def test_weights_that_cannot_be_fetched_are_said_so(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    def network(**_: object) -> None:
        raise error

    install(monkeypatch, network)
    refused(r"^LPIPS is left out: the weights .*(no route|hash).*; fetch them", load_lpips, error=MissingPerceptual)


def test_a_torchvision_that_does_not_fit_torch_is_a_missing_package(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(name: str) -> ModuleType:
        raise RuntimeError("operator torchvision::nms does not exist")

    monkeypatch.setattr("splat.training.score.evaluate.import_module", fail)
    refused("torchvision::nms does not exist; to have it, install", load_lpips, error=MissingPerceptual)
