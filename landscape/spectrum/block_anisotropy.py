"""The anisotropy family of a whole operator and of every block on its diagonal (one attribute of a scene, say).

A block's operator is E^T H E: a product with it costs a product with H.  So the budget of a block is small by default: about a
hundred products.  What it does not resolve shows in the brackets, as `>= ...` where that is the small end.  Runs start from
random vectors unless a `WarmStart` is given.  A start from the whole's eigenvectors would save a tenth of the products, but may
hide the block's own end.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from landscape.eigen.eigen import EigenSettings, extreme_eigenpairs
from landscape.eigen.pairs import EigenEnds
from landscape.errors import InputError
from landscape.operators.operator import LiftedOperator, ProjectedOperator, RestrictedOperator, SymmetricOperator
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
class WarmStart(ShortRepr):
    """Prior knowledge of a part.

    start: vectors in which the search for both ends begins (`extreme_eigenpairs`).  trace: its value and standard error.
    """

    start: Float[Tensor, "n k"] | None = None
    trace: tuple[float, float] | None = None


@dataclass(frozen=True, eq=False, repr=False)
class BlockAnisotropy(ShortRepr):
    """The indices with what they are derived from.  rank: rows of the operator less the dimension of a known null space."""

    rank: int
    ends: EigenEnds
    density: SpectralDensity
    indices: Anisotropy


def block_anisotropies(
    operator: SymmetricOperator,
    generator: torch.Generator,
    settings: BlockAnisotropySettings = BlockAnisotropySettings(),
    parts: Sequence[str] | None = None,
    active: Mapping[str, ActiveSpace] | None = None,
    progress: Progress | None = None,
    leads: Mapping[str, WarmStart] | None = None,
) -> dict[str, BlockAnisotropy]:
    """The family of each part by name: of "all", the whole operator, and every block by default; one without rows is left out.

    active, leads: for each part by name, what its known null space leaves and what else is known of it beforehand; both may
    lack parts.  Every part has random numbers of its own, whatever the others need.  ValueError for an unknown part.

    >>> from landscape.operators.operator import DenseOperator
    >>> H = DenseOperator(torch.diag(torch.tensor([4.0, -1.0, 2.0, 1.0]).double()), {"a": slice(0, 2), "b": slice(2, 4)})
    >>> found = block_anisotropies(H, torch.Generator().manual_seed(0))
    >>> {name: round(family.indices.eigenvalue_ratio.value, 6) for name, family in found.items()}
    {'all': -4.0, 'a': -4.0, 'b': 2.0}
    """
    known = [WHOLE, *(name for name in operator.blocks if name != WHOLE)]
    names = known if parts is None else list(parts)
    if unknown := [name for name in names if name not in known]:
        raise InputError(f"expected parts out of {', '.join(known)}, got {unknown[0]!r}")
    results: dict[str, BlockAnisotropy] = {}
    for name in names:
        stream = spawn(generator)
        part = operator if name == WHOLE else RestrictedOperator(operator, name)
        if part.dim == 0:
            continue
        results[name] = block_anisotropy(
            part,
            stream,
            settings,
            (active or {}).get(name),
            _named(progress, name),
            (leads or {}).get(name, WarmStart()),
        )
    return results


def block_anisotropy(
    operator: SymmetricOperator,
    generator: torch.Generator,
    settings: BlockAnisotropySettings = BlockAnisotropySettings(),
    active: ActiveSpace | None = None,
    progress: Progress | None = None,
    lead: WarmStart = WarmStart(),
) -> BlockAnisotropy:
    """The family of one operator; active: what its known null space leaves; lead: what is known beforehand."""
    rank = operator.dim if active is None else active.rank
    eigen = settings.eigen if rank >= settings.eigen.wanted else EigenSettings(1, 0, rtol=settings.eigen.rtol)
    search = operator
    if active is not None:
        search = LiftedOperator(ProjectedOperator(operator, active.project), active.project, spawn(generator))
    ends = extreme_eigenpairs(search, generator, eigen, lead.start, progress)
    if eigen.smallest == 0:  # one direction: both ends are the same
        ends = EigenEnds(ends.largest, ends.largest, ends.method, ends.matvecs, ends.beyond, ends.noise, ends.ritz)
    starts, steps, batch = settings.starts, settings.steps, settings.batch
    density = spectral_density(
        operator, generator, starts * max(2, steps), starts,
        batch=batch, progress=progress, active=active, ends=ends, trace=lead.trace,
    )  # fmt: skip
    return BlockAnisotropy(rank, ends, density, anisotropy(ends, density))


def _named(progress: Progress | None, name: str) -> Progress | None:
    if progress is None:
        return None
    return lambda done, most, state: progress(done, most, f"{name}: {state}")
