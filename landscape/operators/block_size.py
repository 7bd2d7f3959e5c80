"""How many vectors Lanczos should apply the operator to at once, decided by measurement.

A block of b vectors takes less time a vector, but a block recurrence needs more vectors in all: PRODUCTS[b] times as many as
one vector at a time (the median over spectra with gaps, dense ends and clusters, both ends to 1e-3).  A block pays where

    time(b) / b * PRODUCTS[b]  <  time(1)

by a tenth at least, which single timings may be off by; else the answer is 1.  Multiple eigenvalues are another reason for
blocks, and are not looked for here.
"""

from collections.abc import Callable
from time import perf_counter

import torch

from landscape.operators.operator import SymmetricOperator, finished
from landscape.probes import draw_probes

PRODUCTS = {1: 1.0, 2: 1.6, 4: 2.4}
CLEARLY = 0.9


def fastest_block(
    operator: SymmetricOperator, generator: torch.Generator, clock: Callable[[], float] = perf_counter
) -> int:
    """1, 2 or 4, for `EigenSettings.block`; costs eight products, the first of them untimed.

    1, and no product, where the operator has fewer than eight rows.  clock: in seconds.

    >>> from landscape.operators.operator import DenseOperator
    >>> fastest_block(DenseOperator(torch.eye(2)), torch.Generator().manual_seed(0))  # as many rows leave no room
    1
    """
    if operator.dim < 2 * max(PRODUCTS):
        return 1
    V = draw_probes(operator.dim, max(PRODUCTS), generator, operator.dtype)
    finished(operator.apply(V[:, :1].contiguous()))  # what the first product alone has to do
    cost = {}
    for block, products in PRODUCTS.items():
        vectors = finished(V[:, :block].contiguous())
        start = clock()
        finished(operator.apply(vectors))
        cost[block] = (clock() - start) / block * products
    best = min(cost, key=cost.__getitem__)
    return best if cost[best] < CLEARLY * cost[1] else 1
