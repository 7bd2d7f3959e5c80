"""Independent and slow second opinions.  Nothing here imports the source.

opencv_distortion     the radial and tangential lens model, from its textbook formula
distorted_picture     what such a lens makes of a pattern, by inverting the model in every pixel
symmetric_matrix      a dense matrix with a prescribed spectrum
absolute_matrix       |A| by its eigendecomposition
real_harmonics        spherical harmonics from SciPy's Legendre functions
splat_of_gaussian     EWA projection by the textbook, with explicit covariances
composited_picture    splatting, one pixel and one splat after the other
similarity_by_windows SSIM from the statistics of every window
central_difference    a derivative without a formula
splat_in_many_digits  mean and conic of a Gaussian, with as many digits as wanted
hessian_in_many_digits second differences with half of the digits
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import mpmath
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.spatial.transform import Rotation
from scipy.special import factorial, lpmv


def opencv_distortion(x: np.ndarray, y: np.ndarray, terms: Mapping[str, float]) -> tuple[np.ndarray, np.ndarray]:
    """Where the lens sends the ray (x, y, 1): Brown's model with k1, k2, k3, p1, p2, as OpenCV documents it."""
    k1, k2, k3, p1, p2 = (terms.get(name, 0.0) for name in ("k1", "k2", "k3", "p1", "p2"))
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    return (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y)


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


def real_harmonics(directions: np.ndarray, degree: int) -> np.ndarray:
    """Real spherical harmonics with the Condon-Shortley phase, (n, (degree + 1)^2), from SciPy's Legendre functions."""
    x, y, z = directions.T / np.linalg.norm(directions, axis=1)
    azimuth, columns = np.arctan2(y, x), []
    for l in range(degree + 1):
        for m in range(-l, l + 1):
            norm = np.sqrt((2 * l + 1) / (4 * np.pi) * factorial(l - abs(m)) / factorial(l + abs(m)))
            turn = np.sqrt(2) * np.sin(-m * azimuth) if m < 0 else np.sqrt(2) * np.cos(m * azimuth) if m else 1.0
            columns.append(norm * lpmv(abs(m), l, z) * turn)
    return np.stack(columns, axis=1)


def splat_of_gaussian(
    mean: np.ndarray, log_scale: np.ndarray, quat: np.ndarray, sh: np.ndarray, rotation: np.ndarray, centre: np.ndarray,
    pinhole: tuple[float, float, float, float], clamp: tuple[float, float], blur: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:  # fmt: skip
    """One Gaussian by the textbook: 2-D mean, 2 x 2 covariance J W Sigma W^T J^T + blur 1, colour, depth.

    quat: w x y z; pinhole: fx, fy, cx, cy; clamp: limits of |x / z| and |y / z| in J; sh: (k, 3).
    """
    fx, fy, cx, cy = pinhole
    x, y, z = rotation @ (mean - centre)
    turn = Rotation.from_quat(np.roll(quat, -1)).as_matrix()
    sigma = turn @ np.diag(np.exp(2 * log_scale)) @ turn.T
    u, v = np.clip(x / z, -clamp[0], clamp[0]), np.clip(y / z, -clamp[1], clamp[1])
    jacobian = np.array([[fx, 0, -fx * u], [0, fy, -fy * v]]) / z
    covariance = jacobian @ rotation @ sigma @ rotation.T @ jacobian.T + blur * np.eye(2)
    degree = int(np.sqrt(len(sh))) - 1
    colour = np.maximum(real_harmonics((mean - centre)[None], degree)[0] @ sh + 0.5, 0)
    return np.array([fx * x / z + cx, fy * y / z + cy]), covariance, colour, float(z)


def composited_picture(
    splats: list[tuple[np.ndarray, np.ndarray, np.ndarray, float]], opacities: np.ndarray, background: np.ndarray,
    size: tuple[int, int], *, near: float, cap: float, cut: float, floor: float, sigmas: float = np.inf,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Colour (3, h, w), accumulated alpha and expected depth, one pixel and one splat after the other.

    splats: as `splat_of_gaussian` gives them; a splat counts where its alpha is at least cut and its distance at most
    sigmas; a pixel stops before its transmittance would fall under floor.
    """
    width, height = size
    colour, alpha_plane, depth_plane = (
        np.zeros((3, height, width)),
        np.zeros((height, width)),
        np.zeros((height, width)),
    )
    order = sorted((i for i in range(len(splats)) if splats[i][3] > near), key=lambda i: splats[i][3])
    inverses = [np.linalg.inv(splat[1]) for splat in splats]
    for row in range(height):
        for column in range(width):
            left = 1.0
            for i in order:
                offset = np.array([column + 0.5, row + 0.5]) - splats[i][0]
                squared = offset @ inverses[i] @ offset
                alpha = min(cap, opacities[i] * np.exp(-squared / 2))
                if opacities[i] * np.exp(-squared / 2) < cut or squared > sigmas**2:
                    continue
                if left * (1 - alpha) < floor:
                    break
                colour[:, row, column] += left * alpha * splats[i][2]
                depth_plane[row, column] += left * alpha * splats[i][3]
                left *= 1 - alpha
            colour[:, row, column] += left * background
            alpha_plane[row, column] = 1 - left
    return colour, alpha_plane, depth_plane


def similarity_by_windows(image: np.ndarray, target: np.ndarray) -> np.ndarray:
    """SSIM of (c, h, w) images in every pixel: weighted statistics of an 11 x 11 window, sigma 1.5, zero outside."""
    offsets = np.arange(-5, 6)
    weight = np.exp(-(offsets[:, None] ** 2 + offsets[None, :] ** 2) / (2 * 1.5**2))
    weight /= weight.sum()
    pads = ((0, 0), (5, 5), (5, 5))
    x, y = (sliding_window_view(np.pad(plane, pads), (11, 11), axis=(1, 2)) for plane in (image, target))
    mean_x, mean_y = (x * weight).sum((-1, -2)), (y * weight).sum((-1, -2))
    dx, dy = x - mean_x[..., None, None], y - mean_y[..., None, None]
    var_x, var_y, cov = ((a * b * weight).sum((-1, -2)) for a, b in ((dx, dx), (dy, dy), (dx, dy)))
    c1, c2 = 0.01**2, 0.03**2
    return (2 * mean_x * mean_y + c1) * (2 * cov + c2) / ((mean_x**2 + mean_y**2 + c1) * (var_x + var_y + c2))


def central_difference(function: Callable[[float], np.ndarray], step: float) -> np.ndarray:
    """function'(0) with an error of order step^4: Richardson's extrapolation of two central differences."""

    def difference(h: float) -> np.ndarray:
        return (function(h) - function(-h)) / (2 * h)

    return (4 * difference(step / 2) - difference(step)) / 3


def splat_in_many_digits(
    point: Sequence[Any], rotation: np.ndarray, centre: np.ndarray, pinhole: tuple[float, float, float, float],
    blur: float,
) -> list[Any]:  # fmt: skip
    """Mean x, y and conic a, b, c of a Gaussian (mean, log-scales, quaternion w x y z), with mpmath's working precision.

    And the square root of the ratio of its covariances' determinants without and with the blur.
    """
    fx, fy, cx, cy = pinhole
    W = mpmath.matrix(rotation.tolist())
    x, y, z = W * mpmath.matrix([m - c for m, c in zip(point[:3], centre.tolist(), strict=True)])
    length = mpmath.sqrt(sum(q * q for q in point[6:]))
    r, i, j, k = (q / length for q in point[6:])
    turn = mpmath.matrix(
        [
            [1 - 2 * (j * j + k * k), 2 * (i * j - r * k), 2 * (i * k + r * j)],
            [2 * (i * j + r * k), 1 - 2 * (i * i + k * k), 2 * (j * k - r * i)],
            [2 * (i * k - r * j), 2 * (j * k + r * i), 1 - 2 * (i * i + j * j)],
        ]
    )
    jacobian = mpmath.matrix([[fx / z, 0, -fx * x / z**2], [0, fy / z, -fy * y / z**2]])
    axes = jacobian * W * turn * mpmath.diag([mpmath.exp(s) for s in point[3:6]])
    sharp, whole = axes * axes.T, axes * axes.T + blur * mpmath.eye(2)
    conic, ratio = mpmath.inverse(whole), mpmath.det(sharp) / mpmath.det(whole)
    return [fx * x / z + cx, fy * y / z + cy, conic[0, 0], conic[0, 1], conic[1, 1], mpmath.sqrt(ratio)]


def hessian_in_many_digits(function: Callable[[list[Any]], Any], point: Sequence[float], digits: int) -> np.ndarray:
    """Second central differences of a scalar function at a quarter of the digits for a step."""
    with mpmath.workdps(digits):
        step, at = mpmath.mpf(10) ** (-digits // 4), [mpmath.mpf(x) for x in point]

        def moved(j: int, s: int, k: int, t: int) -> Any:
            shifted = list(at)
            shifted[j] += s * step
            shifted[k] += t * step
            return function(shifted)

        result = np.empty((len(at), len(at)))
        for j in range(len(at)):
            for k in range(j + 1):
                pairs = sum(s * t * moved(j, s, k, t) for s in (-1, 1) for t in (-1, 1))
                result[j, k] = result[k, j] = float(pairs / (4 * step * step))
        return result
