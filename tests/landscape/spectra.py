"""Dense symmetric matrices with the spectra that curvature has: the cases of the tests of eigenvalues and densities."""

import numpy as np
import torch

from landscape.operators.operator import DenseOperator
from tests.oracles import symmetric_matrix

N = 120
ROUNDING = 1e-14  # of a quotient of eigenvalues, where a bracket has no width but that
_index = np.arange(N)
SPECTRA = {
    "power law": 1 / (1 + _index) ** 1.5,
    "indefinite": np.linspace(-1, 1.5, N) ** 3,
    "both tails": np.where(_index % 3 > 0, 1.0, -0.1) / (1 + _index),
    "clustered": np.where(_index < 5, 1 - 1e-5 * _index, np.where(_index >= N - 4, -0.3, 0.3 * _index / N)),
    "rank-deficient": np.where(_index < 10, 1.0 + _index, 0.0),
    "negative": -np.linspace(1, 2, N),
    "multiple": np.where(_index < 40, 2.0, -1.0),
    "zero": np.zeros(N),
}


def operator(name, dtype=torch.float64):
    matrix = torch.from_numpy(symmetric_matrix(SPECTRA[name], seed=sum(map(ord, name))))
    return DenseOperator(matrix.to(dtype))


def eigenvalues(dense):
    """Ascending; those of the matrix as it is stored, in float64."""
    return torch.linalg.eigvalsh(dense.matrix.double())


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


class Noisy(DenseOperator):
    """Products that are off by so much, for a unit vector, and never twice alike."""

    def __init__(self, matrix, noise, seed=1):
        super().__init__(matrix)
        self.noise, self.source = noise, generator(seed)

    def apply(self, V):
        off = torch.randn(V.shape, generator=self.source, dtype=V.dtype) * V.norm(dim=0)
        return super().apply(V) + self.noise / self.dim**0.5 * off


class Broken(DenseOperator):
    """Products that are not finite."""

    def apply(self, V):
        return V / 0


class Buffered(DenseOperator):
    """Gives every product of as many vectors in the same memory."""

    def __init__(self, matrix):
        super().__init__(matrix)
        self.buffers = {}

    def apply(self, V):
        return torch.mm(self.matrix, V, out=self.buffers.setdefault(V.shape[1], torch.empty_like(V)))
