"""The anisotropy family of a whole operator and of every block on its diagonal (one attribute of a scene, say).

A block's operator is E^T H E: a product with it costs a product with H.  So the budget of a block is small by default: about a
hundred products.  What it does not resolve shows in the brackets, as `>= ...` where that is the small end.  Runs start from
random vectors unless others are given.  A start from the whole's eigenvectors would save a tenth of the products, but may
hide the block's own end.
"""

from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from landscape.eigen.eigen import EigenSettings, extreme_eigenpairs
from landscape.eigen.pairs import EigenEnds
from landscape.operators.operator import LiftedOperator, ProjectedOperator, SymmetricOperator
from landscape.probes import spawn
from landscape.results import Progress, ShortRepr
from landscape.spectrum.anisotropy import Anisotropy, anisotropy
from landscape.spectrum.density import ActiveSpace, spectral_density
from landscape.spectrum.rules import SpectralDensity

WHOLE = "all"


@dataclass(frozen=True)
class BlockAnisotropySettings:
    """The budget of the whole and of each block.

    eigen: of the search for both ends.  The density has `starts` runs of `steps` products each, `batch` runs at a time.
    """

    eigen: EigenSettings = field(default_factory=lambda: EigenSettings(rtol=1e-2, max_matvecs=60))
    starts: int = 3
    steps: int = 16
    batch: int = 3


@dataclass(frozen=True, eq=False, repr=False)
class BlockAnisotropy(ShortRepr):
    """The indices with what they are derived from.  rank: rows of the operator less the dimension of a known null space."""

    rank: int
    ends: EigenEnds
    density: SpectralDensity
    indices: Anisotropy


def block_anisotropy(
    operator: SymmetricOperator,
    generator: torch.Generator,
    settings: BlockAnisotropySettings = BlockAnisotropySettings(),
    active: ActiveSpace | None = None,
    progress: Progress | None = None,
    start: Float[Tensor, "n k"] | None = None,
    trace: tuple[float, float] | None = None,
) -> BlockAnisotropy:
    """The family of one operator, the whole or `RestrictedOperator(H, block)`.

    active: what its known null space leaves.  start: vectors in which the search for both ends begins (`extreme_eigenpairs`).
    trace: its value and standard error, where known beforehand.

    >>> from landscape import DenseOperator, RestrictedOperator
    >>> H = DenseOperator(torch.diag(torch.tensor([4.0, -1.0, 2.0, 1.0]).double()), {"a": slice(0, 2), "b": slice(2, 4)})
    >>> parts = {"all": H, **{name: RestrictedOperator(H, name) for name in H.blocks}}
    >>> found = {name: block_anisotropy(part, torch.Generator().manual_seed(0)) for name, part in parts.items()}
    >>> {name: round(family.indices.eigenvalue_ratio.value, 6) for name, family in found.items()}
    {'all': -4.0, 'a': -4.0, 'b': 2.0}
    """
    rank = operator.dim if active is None else active.rank
    eigen = settings.eigen if rank >= settings.eigen.wanted else EigenSettings(1, 0, rtol=settings.eigen.rtol)
    search = operator
    if active is not None:
        search = LiftedOperator(ProjectedOperator(operator, active.project), active.project, spawn(generator))
    ends = extreme_eigenpairs(search, generator, eigen, start, progress)
    if eigen.smallest == 0:  # one direction: both ends are the same
        ends = EigenEnds(ends.largest, ends.largest, ends.method, ends.matvecs, ends.beyond, ends.noise, ends.ritz)
    starts, steps, batch = settings.starts, settings.steps, settings.batch
    density = spectral_density(
        operator, generator, starts * max(2, steps), starts,
        batch=batch, progress=progress, active=active, ends=ends, trace=trace,
    )  # fmt: skip
    return BlockAnisotropy(rank, ends, density, anisotropy(ends, density))
