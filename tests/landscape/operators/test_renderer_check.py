"""Each fault of a renderer has its sentence, and a good one has none."""

import pytest
import torch

from landscape.operators.checks import check_renderer, require_resolved
from tests.landscape.foreign import Bumps
from tests.refusals import refused


def sentences(bumps: Bumps, noise: float = 0.0) -> list[str]:
    return check_renderer(bumps.hessian(noise=noise), torch.Generator().manual_seed(0)).sentences


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_good_renderer_passes(dtype):
    found = check_renderer(Bumps(dtype).hessian(), torch.Generator().manual_seed(0))
    assert not found.sentences and found.error < 0.05
    assert all(abs(off) < 2e-3 for off, _ in found.gradients.values()) and list(found.gradients) == list(Bumps().named)


@pytest.mark.parametrize("name", Bumps().named)
@pytest.mark.parametrize("factor", [1.1, 0.9, 0.0, -1.0])
def test_a_wrong_gradient_is_found_and_named(name, factor):
    bumps = Bumps(torch.float32)
    bumps.named[name].register_hook(lambda gradient: factor * gradient)
    (found,) = [words for words in sentences(bumps) if "expected the gradient" in words]
    assert f"gradient in '{name}'" in found and f"got {factor:.1g}" in found.replace("1.1", "1")


def test_noise_is_found():
    bumps, generator = Bumps(), torch.Generator().manual_seed(0)
    bumps.change = lambda image: image + 1e-4 * torch.randn(40, generator=generator, dtype=torch.float64)
    (found,) = sentences(bumps)
    assert "equal images from equal renders" in found


def test_jumps_are_found():
    """Pixels jump by a hundredth between steps of brightness."""
    found = sentences(Bumps(change=lambda image: image + (100 * image).floor() / 100), noise=1e-5)
    assert any("of its change in pixels that jump" in words for words in found)


def test_a_parameter_that_changes_nothing_is_named():
    bumps = Bumps()
    bumps.named["idle"] = torch.ones(3, dtype=torch.float64, requires_grad=True)
    assert sentences(bumps) == ["expected images that depend on 'idle', got none that changes; leave it out"]


def test_products_that_are_all_noise_stop_estimators():
    bumps, generator = Bumps(), torch.Generator().manual_seed(0)
    bumps.change = lambda image: image * (1 + 0.5 * torch.randn(40, generator=generator, dtype=torch.float64))
    H = bumps.hessian()
    refused("products that steps resolve, got an error of", require_resolved, H, torch.Generator().manual_seed(0))
    assert any("products that steps resolve" in words for words in sentences(bumps))
