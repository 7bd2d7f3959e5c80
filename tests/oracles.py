"""Independent and slow second opinions.  Nothing here imports the source.

opencv_distortion     the radial and tangential lens model, from its textbook formula
distorted_picture     what such a lens makes of a pattern, by inverting the model in every pixel
symmetric_matrix      a dense matrix with a prescribed spectrum
absolute_matrix       |A| by its eigendecomposition
"""

from collections.abc import Callable, Mapping

import numpy as np


def opencv_distortion(x: np.ndarray, y: np.ndarray, terms: Mapping[str, float]) -> tuple[np.ndarray, np.ndarray]:
    """Where the lens sends the ray (x, y, 1): Brown's model with k1, k2, k3, p1, p2, as OpenCV documents it."""
    k1, k2, k3, p1, p2 = (terms.get(name, 0.0) for name in ("k1", "k2", "k3", "p1", "p2"))
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )


def distorted_picture(
    pattern: Callable[[np.ndarray, np.ndarray], np.ndarray],
    intrinsics: tuple[float, float, float, float],
    size: tuple[int, int],
    terms: Mapping[str, float],
) -> np.ndarray:
    """pattern(x, y) of the rays that meet the centre of each pixel of a distorted image of size (w, h)."""
    fx, fy, cx, cy = intrinsics
    column, row = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    seen_x, seen_y = (column - cx) / fx, (row - cy) / fy
    x, y = seen_x.copy(), seen_y.copy()
    for _ in range(200):  # fixed point; contracts for lenses of moderate distortion
        there_x, there_y = opencv_distortion(x, y, terms)
        x, y = x + seen_x - there_x, y + seen_y - there_y
    there_x, there_y = opencv_distortion(x, y, terms)
    assert np.abs(there_x - seen_x).max() < 1e-12 and np.abs(there_y - seen_y).max() < 1e-12
    return pattern(x, y)


def symmetric_matrix(eigenvalues: np.ndarray, seed: int) -> np.ndarray:
    """A dense symmetric matrix with these eigenvalues and a random orthonormal set of eigenvectors."""
    n = len(eigenvalues)
    vectors, _ = np.linalg.qr(np.random.default_rng(seed).standard_normal((n, n)))
    matrix = (vectors * eigenvalues) @ vectors.T
    return (matrix + matrix.T) / 2


def absolute_matrix(matrix: np.ndarray) -> np.ndarray:
    """|A| = sum_i |lambda_i| v_i v_i^T."""
    values, vectors = np.linalg.eigh(matrix)
    return (vectors * np.abs(values)) @ vectors.T
