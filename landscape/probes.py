"""Random probe vectors z with E z z^T = I, the source of all randomness in the estimators.

Vectors are drawn one after the other on the generator's device.  The first m are therefore the same vectors however many are
drawn at a time.
"""

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

Distribution = Literal["rademacher", "gaussian"]


def draw_probes(
    n: int, count: int, generator: torch.Generator, dtype: torch.dtype, distribution: Distribution = "gaussian"
) -> Float[Tensor, "n count"]:
    """count independent probe vectors: entries +-1 ("rademacher") or standard normal ("gaussian")."""
    rows = torch.empty(count, n, dtype=dtype, device=generator.device)
    for row in rows:
        if distribution == "gaussian":
            row.normal_(generator=generator)
        else:
            row.bernoulli_(0.5, generator=generator).mul_(2).sub_(1)
    return rows.T.contiguous()


def spawn(generator: torch.Generator) -> torch.Generator:
    """A new generator on the same device, seeded from the given one.

    Two parts of a computation that each draw from a spawned generator do not depend on how many numbers the other draws.
    """
    seed = torch.randint(2**62, (), generator=generator, device=generator.device)
    return torch.Generator(generator.device).manual_seed(int(seed))
