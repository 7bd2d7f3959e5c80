"""The losses of `losses.py` as kernels: value, gradient and Hessian-vector product of one view's image against its target.

Per pixel and channel, with x the image, y the target (its own blurs are constants) and m, p, q the window's means of x, x^2
and x y, SSIM is

    S(m, p, q) = A1 A2 / (B1 B2)      A1 = 2 m mu_y + C1     B1 = m^2 + mu_y^2 + C1
                                      A2 = 2 (q - m mu_y) + C2     B2 = p - m^2 + var_y + C2

The window's blur is its own adjoint, so with S_m, S_p, S_q the partial derivatives

    gradient of sum S      blur(S_m) + 2 x blur(S_p) + y blur(S_q)
    its tangent for v      the same of S_m', S_p', S_q', plus 2 v blur(S_p), a dash the second derivative of S applied to
                           m' = blur(v), p' = 2 blur(x v), q' = blur(y v)

Six separable blurs a channel each.  Planes are padded as in `raster/cpu.py`; only the first three are read, and the padding
of an output is 0.  A `row` counts the rows of the three channels, one after the other.
"""

from collections.abc import Callable
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float
from scipy.ndimage import correlate1d
from torch import Tensor

from splat.losses import C1, C2, WINDOW, LossSettings, window
from splat.raster.compositing import TILE_ROWS, formula, kernel, scratch
from splat.raster.cpu import aligned
from splat.raster.functions import last_derivative
from splat.raster.simd import broadcast, lanes, lanes_of, load, maximum, select, sqrt, store
from splat.raster.threads import over_range

BORDER = 16  # floats before a row in scratch, so that the window may look past its ends
REACH = WINDOW // 2
L1, CHARBONNIER, L2 = range(3)
KINDS = {"l1": L1, "charbonnier": CHARBONNIER, "l2": L2}


@formula
def blur_row(buffer, i, taps):
    """The window over the lanes at i of a bordered row."""
    total = load(buffer, BORDER + i) * taps[REACH]
    for k in range(1, REACH + 1):
        total += (load(buffer, BORDER + i - k) + load(buffer, BORDER + i + k)) * taps[REACH + k]
    return total


@formula
def blur_column(plane, corner, y, height, stride, taps):
    """The window over the rows round y, at the lanes at `corner` of row 0."""
    total = load(plane, corner + y * stride) * taps[REACH]
    for k in range(max(-REACH, -y), min(REACH, height - 1 - y) + 1):
        if k != 0:
            total += load(plane, corner + (y + k) * stride) * taps[REACH + k]
    return total


@formula
def clear_ends(buffer, width):
    for i in range(BORDER):
        buffer[i] = 0
    for i in range(BORDER + width, buffer.size):
        buffer[i] = 0


@formula
def row_buffer(like, stride):
    return scratch(like, stride + 2 * BORDER + 16)


@kernel
def blur_products_along_rows(start, stop, shape, taps, v, x, y, blurred):
    """Rows of blur(v), blur(x v), blur(y v), along x only, to the three planes sets of `blurred`."""
    height, width, plane_rows, stride = shape
    L, size = lanes(v), 3 * plane_rows * stride
    b0, b1, b2 = row_buffer(v, stride), row_buffer(v, stride), row_buffer(v, stride)
    for row in range(start, stop):
        at = ((row // height) * plane_rows + row % height) * stride
        for i in range(0, stride, L):
            value = load(v, at + i)
            store(b0, BORDER + i, value)
            store(b1, BORDER + i, value * load(x, at + i))
            store(b2, BORDER + i, value * load(y, at + i))
        clear_ends(b0, width)
        clear_ends(b1, width)
        clear_ends(b2, width)
        for i in range(0, stride, L):
            store(blurred, at + i, blur_row(b0, i, taps))
            store(blurred, size + at + i, blur_row(b1, i, taps))
            store(blurred, 2 * size + at + i, blur_row(b2, i, taps))


@formula
def similarity(m, p, q, mu, var):
    """S and its partial derivatives in (m, p, q), with what the second derivatives need."""
    A1, B1 = 2.0 * m * mu + C1, m * m + mu * mu + C1
    A2, B2 = 2.0 * (q - m * mu) + C2, p - m * m + var + C2
    r1, r2 = 1.0 / B1, 1.0 / B2
    l, s = A1 * r1, A2 * r2  # S = l s; l depends on m alone
    dl = (2.0 * mu - 2.0 * m * l) * r1
    ds = (2.0 * m * s - 2.0 * mu) * r2  # ds/dm; ds/dp = -s r2, ds/dq = 2 r2
    return l, s, dl, ds, r1, r2


@kernel
def ssim_gradient_rows(start, stop, shape, taps, blurred, target, second, partials, sums):
    """S_m, S_p, S_q of each row, blurred along x, to `partials`; the second derivatives to `second`; S to sums[row].

    target: mu_y and var_y (2 plane sets); second: S_mm, S_mp, S_mq, S_pp, S_pq (5 plane sets), or empty (S_qq is 0).
    """
    height, width, plane_rows, stride = shape
    L, size = lanes(blurred), 3 * plane_rows * stride
    b0, b1, b2 = row_buffer(blurred, stride), row_buffer(blurred, stride), row_buffer(blurred, stride)
    values = row_buffer(blurred, stride)
    for row in range(start, stop):
        top, y = (row // height) * plane_rows * stride, row % height
        at = top + y * stride
        for i in range(0, stride, L):
            m = blur_column(blurred, top + i, y, height, stride, taps)
            p = blur_column(blurred, size + top + i, y, height, stride, taps)
            q = blur_column(blurred, 2 * size + top + i, y, height, stride, taps)
            l, s, dl, ds, r1, r2 = similarity(m, p, q, load(target, at + i), load(target, size + at + i))
            sp, sq = -(s * r2), 2.0 * r2
            store(values, BORDER + i, l * s)
            store(b0, BORDER + i, dl * s + l * ds)
            store(b1, BORDER + i, l * sp)
            store(b2, BORDER + i, l * sq)
            if second.size:
                ddl = (-2.0 * l - 4.0 * m * dl) * r1
                dds = (2.0 * s + 4.0 * m * ds) * r2
                smp, smq = (2.0 * m * sp - ds) * r2, 2.0 * m * sq * r2
                store(second, at + i, ddl * s + 2.0 * dl * ds + l * dds)
                store(second, size + at + i, dl * sp + l * smp)
                store(second, 2 * size + at + i, dl * sq + l * smq)
                store(second, 3 * size + at + i, -2.0 * l * sp * r2)
                store(second, 4 * size + at + i, -(l * sq * r2))
        total = 0.0
        for i in range(width):
            total += values[BORDER + i]
        sums[row] = total
        blur_partials(b0, b1, b2, width, stride, taps, partials, at, size)


@formula
def blur_partials(b0, b1, b2, width, stride, taps, partials, at, size):
    clear_ends(b0, width)
    clear_ends(b1, width)
    clear_ends(b2, width)
    for i in range(0, stride, lanes(b0)):
        store(partials, at + i, blur_row(b0, i, taps))
        store(partials, size + at + i, blur_row(b1, i, taps))
        store(partials, 2 * size + at + i, blur_row(b2, i, taps))


@kernel
def ssim_tangent_rows(start, stop, shape, taps, blurred, second, partials):
    """S_m', S_p', S_q' of each row, blurred along x, from the tangents' products blurred along x."""
    height, width, plane_rows, stride = shape
    L, size = lanes(blurred), 3 * plane_rows * stride
    b0, b1, b2 = row_buffer(blurred, stride), row_buffer(blurred, stride), row_buffer(blurred, stride)
    for row in range(start, stop):
        top, y = (row // height) * plane_rows * stride, row % height
        at = top + y * stride
        for i in range(0, stride, L):
            dm = blur_column(blurred, top + i, y, height, stride, taps)
            dp = 2.0 * blur_column(blurred, size + top + i, y, height, stride, taps)
            dq = blur_column(blurred, 2 * size + top + i, y, height, stride, taps)
            mm, mp, mq = load(second, at + i), load(second, size + at + i), load(second, 2 * size + at + i)
            pp, pq = load(second, 3 * size + at + i), load(second, 4 * size + at + i)
            store(b0, BORDER + i, mm * dm + mp * dp + mq * dq)
            store(b1, BORDER + i, mp * dm + pp * dp + pq * dq)
            store(b2, BORDER + i, mq * dm + pq * dp)
        blur_partials(b0, b1, b2, width, stride, taps, partials, at, size)


@formula
def pixel_slope(residual, kind, eps):
    """The pixel loss of a residual and its derivative."""
    if kind == L1:
        return maximum(residual, -residual), select(residual > 0.0, 1.0, select(residual < 0.0, -1.0, residual * 0.0))
    if kind == L2:
        return residual * residual, 2.0 * residual
    length = sqrt(residual * residual + eps * eps)
    return length, residual / length


@formula
def pixel_curvature(residual, kind, eps, weight):
    """The second derivative of the pixel loss, times weight; 0 for L1 (its kink at 0 has none)."""
    if kind == L1:
        return residual * 0.0
    if kind == L2:
        return 2.0 * weight
    squared = residual * residual + eps * eps
    return weight * (eps * eps) / (squared * sqrt(squared))


@kernel
def gradient_rows(start, stop, shape, taps, partials, x, y, kind, eps, pixel, structural, blurred_sp, gradient, sums):
    """The gradient of the loss, and the pixel loss to sums[row].  structural = 0: partials is not read.

    pixel, structural: weights of the two losses over the number of values; blurred_sp: blur(S_p), or empty.
    """
    height, width, plane_rows, stride = shape
    L, size = lanes(x), 3 * plane_rows * stride
    values = row_buffer(x, stride)
    for row in range(start, stop):
        top, line = (row // height) * plane_rows * stride, row % height
        at = top + line * stride
        for i in range(0, stride, L):
            image, aim = load(x, at + i), load(y, at + i)
            value, slope = pixel_slope(image - aim, kind, eps)
            slope = slope * pixel
            store(values, BORDER + i, value)
            if structural != 0:
                bm = blur_column(partials, top + i, line, height, stride, taps)
                bp = blur_column(partials, size + top + i, line, height, stride, taps)
                bq = blur_column(partials, 2 * size + top + i, line, height, stride, taps)
                slope -= structural * (bm + 2.0 * image * bp + aim * bq)
                if blurred_sp.size:
                    store(blurred_sp, at + i, bp)
            store(gradient, at + i, slope)
        total = 0.0
        for i in range(width):
            total += values[BORDER + i]
        sums[row] = total
        for i in range(width, stride):
            gradient[at + i] = 0


@kernel
def product_rows(start, stop, shape, taps, partials, v, x, y, kind, eps, pixel, structural, blurred_sp, product):
    """The Hessian of the loss times v."""
    height, width, plane_rows, stride = shape
    L, size = lanes(x), 3 * plane_rows * stride
    for row in range(start, stop):
        top, line = (row // height) * plane_rows * stride, row % height
        at = top + line * stride
        for i in range(0, stride, L):
            image, aim, tangent = load(x, at + i), load(y, at + i), load(v, at + i)
            total = pixel_curvature(image - aim, kind, eps, broadcast(x, pixel)) * tangent
            if structural != 0:
                bm = blur_column(partials, top + i, line, height, stride, taps)
                bp = blur_column(partials, size + top + i, line, height, stride, taps)
                bq = blur_column(partials, 2 * size + top + i, line, height, stride, taps)
                total -= structural * (bm + 2.0 * image * bp + aim * bq + 2.0 * tangent * load(blurred_sp, at + i))
            store(product, at + i, total)
        for i in range(width, stride):
            product[at + i] = 0


@kernel
def blur_five_along_rows(start, stop, shape, taps, fields, blurred):
    """Rows of five plane sets, blurred along x only."""
    height, width, plane_rows, stride = shape
    L, size = lanes(fields), 3 * plane_rows * stride
    buffer = row_buffer(fields, stride)
    for row in range(start, stop):
        at = ((row // height) * plane_rows + row % height) * stride
        for f in range(5):
            for i in range(0, stride, L):
                store(buffer, BORDER + i, load(fields, f * size + at + i))
            clear_ends(buffer, width)
            for i in range(0, stride, L):
                store(blurred, f * size + at + i, blur_row(buffer, i, taps))


@kernel
def diagonal_rows(start, stop, shape, taps, blurred, x, y, kind, eps, pixel, structural, blurred_sp, diagonal):
    """The diagonal of the loss's Hessian; blurred: S_mm, S_mp, S_mq, S_pp, S_pq blurred along x with the squared window."""
    height, width, plane_rows, stride = shape
    L, size = lanes(x), 3 * plane_rows * stride
    for row in range(start, stop):
        top, line = (row // height) * plane_rows * stride, row % height
        at = top + line * stride
        for i in range(0, stride, L):
            image, aim = load(x, at + i), load(y, at + i)
            total = pixel_curvature(image - aim, kind, eps, broadcast(x, pixel))
            if structural != 0:
                mm = blur_column(blurred, top + i, line, height, stride, taps)
                mp = blur_column(blurred, size + top + i, line, height, stride, taps)
                mq = blur_column(blurred, 2 * size + top + i, line, height, stride, taps)
                pp = blur_column(blurred, 3 * size + top + i, line, height, stride, taps)
                pq = blur_column(blurred, 4 * size + top + i, line, height, stride, taps)
                coupled = mm + 4.0 * image * (mp + image * pp + aim * pq) + 2.0 * aim * mq
                total -= structural * (coupled + 2.0 * load(blurred_sp, at + i))
            store(diagonal, at + i, total)
        for i in range(width, stride):
            diagonal[at + i] = 0


class ViewLoss:
    """The loss of images against one target; what depends on the target alone is computed once."""

    def __init__(self, target: Float[np.ndarray, "3 h w"], settings: LossSettings, dtype: type | np.dtype):
        _, height, width = target.shape
        stride = -(-width // lanes_of(dtype)) * lanes_of(dtype)
        plane_rows = -(-height // TILE_ROWS) * TILE_ROWS
        self.shape, self.settings, self.dtype = (height, width, plane_rows, stride), settings, np.dtype(dtype)
        self.taps = window(torch.float64).numpy().astype(self.dtype)
        self.target = self.planes(1)[0]
        self.target[:] = 0
        self.target[:, :height, :width] = target
        count = 3 * height * width
        self.pixel, self.structural = settings.pixel_weight / count, settings.ssim_weight / count
        if settings.ssim_weight:
            self._target_moments = self._blurs_of_target()

    def planes(self, sets: int) -> np.ndarray:
        """Uninitialised plane sets, (sets, 3, padded height, padded width)."""
        return aligned((sets, 3, self.shape[2], self.shape[3]), self.dtype)

    @classmethod
    def of(cls, target: Float[Tensor, "3 h w"], settings: LossSettings, dtype: torch.dtype) -> "ViewLoss":
        """The loss against a tensor, for images of dtype."""
        return cls(target.numpy(), settings, np.float32 if dtype == torch.float32 else np.float64)

    def padded(self, image: Tensor) -> np.ndarray:
        """Padded planes of an image, 0 outside it."""
        planes = self.planes(1)[0]
        planes[:] = 0
        planes[:, : self.shape[0], : self.shape[1]] = image.detach().numpy()
        return planes

    def cropped(self, planes: np.ndarray) -> Tensor:
        """The first three planes without their padding, as a tensor."""
        return torch.from_numpy(np.ascontiguousarray(planes[:3, : self.shape[0], : self.shape[1]]))

    def _over_rows(self, kernel: Callable, *arguments) -> None:
        over_range(3 * self.shape[0], kernel, self.shape, self.taps, *arguments)

    def _blurs_of_target(self) -> np.ndarray:
        """mu_y and var_y."""
        height, width = self.shape[:2]
        taps = window(torch.float64).numpy()

        def blur(field: np.ndarray) -> np.ndarray:
            for axis in (1, 2):
                field = correlate1d(field, taps, axis=axis, mode="constant")
            return field

        inside = self.target[:, :height, :width].astype(np.float64)
        moments = self.planes(2)
        moments[:] = 0
        mu = blur(inside)
        moments[0, :, :height, :width] = mu
        moments[1, :, :height, :width] = blur(inside * inside) - mu * mu
        return moments

    def _pointwise(self) -> tuple:
        scalar = self.dtype.type
        eps, pixel, structural = scalar(self.settings.eps), scalar(self.pixel), scalar(self.structural)
        return KINDS[self.settings.pixel], eps, pixel, structural

    def value(self, image: np.ndarray) -> float:
        """The loss at padded planes."""
        return self.linearize(image, second_order=False).value

    def linearize(self, image: np.ndarray, second_order: bool = True) -> "LinearLoss":
        """Value and gradient at padded planes (at least three), and what the Hessian's product needs if second_order."""
        x = np.ascontiguousarray(image[:3], self.dtype).reshape(-1)
        y, rows, none = self.target.reshape(-1), 3 * self.shape[0], np.empty(0, self.dtype)
        similarities, pixels = np.zeros(rows), np.zeros(rows)
        partials, second, blurred_sp = none, none, none
        if self.structural:
            blurred, partials = self.planes(3).reshape(-1), self.planes(3).reshape(-1)
            if second_order:
                second, blurred_sp = self.planes(5).reshape(-1), self.planes(1).reshape(-1)
            self._over_rows(blur_products_along_rows, x, x, y, blurred)
            moments = self._target_moments.reshape(-1)
            self._over_rows(ssim_gradient_rows, blurred, moments, second, partials, similarities)
        gradient = aligned((4, *self.shape[2:]), self.dtype)
        gradient[:, self.shape[0] :] = 0
        gradient[3] = 0
        self._over_rows(gradient_rows, partials, x, y, *self._pointwise(), blurred_sp, gradient.reshape(-1), pixels)
        value = self.pixel * pixels.sum() + self.settings.ssim_weight - self.structural * similarities.sum()
        return LinearLoss(self, float(value), gradient, x, second, blurred_sp)


class LinearLoss:
    """A loss held still at an image: value, gradient (4, padded planes; that of alpha is 0) and Hessian-vector products."""

    def __init__(
        self,
        loss: ViewLoss,
        value: float,
        gradient: np.ndarray,
        image: np.ndarray,
        second: np.ndarray,
        blurred: np.ndarray,
    ):
        self.loss, self.value, self.gradient = loss, value, gradient
        self._image, self._second, self._blurred = image, second, blurred

    def hvp(self, tangents: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """l'' v for K padded tangents (K, 4, ...), to out (which may be the tangents themselves)."""
        loss = self.loss
        none, y = np.empty(0, loss.dtype), loss.target.reshape(-1)
        products = aligned((len(tangents), 4, *loss.shape[2:]), loss.dtype) if out is None else out
        partials, blurred = none, none
        if loss.structural:
            blurred, partials = loss.planes(3).reshape(-1), loss.planes(3).reshape(-1)
        for tangent, product in zip(tangents, products, strict=True):
            v = np.ascontiguousarray(tangent[:3], loss.dtype).reshape(-1)
            if loss.structural:
                loss._over_rows(blur_products_along_rows, v, self._image, y, blurred)
                loss._over_rows(ssim_tangent_rows, blurred, self._second, partials)
            loss._over_rows(
                product_rows, partials, v, self._image, y, *loss._pointwise(), self._blurred, product.reshape(-1)
            )
            product[:, loss.shape[0] :] = 0
            product[3] = 0
        return products

    @property
    def bytes(self) -> int:
        """Memory of what is held, the target's included."""
        target = self.loss.target.nbytes + (self.loss._target_moments.nbytes if self.loss.structural else 0)
        return target + self.gradient.nbytes + self._image.nbytes + self._second.nbytes + self._blurred.nbytes

    @cached_property
    def diagonal(self) -> np.ndarray:
        """The pixel-diagonal of l'', padded planes (3, ...): that of SSIM is one blur with the squared window."""
        loss = self.loss
        none, y = np.empty(0, loss.dtype), loss.target.reshape(-1)
        diagonal, blurred = loss.planes(1)[0], none
        diagonal[:, loss.shape[0] :] = 0
        if loss.structural:
            blurred = loss.planes(5).reshape(-1)
            over_range(3 * loss.shape[0], blur_five_along_rows, loss.shape, loss.taps**2, self._second, blurred)
        over_range(
            3 * loss.shape[0], diagonal_rows, loss.shape, loss.taps**2, blurred, self._image, y, *loss._pointwise(),
            self._blurred, diagonal.reshape(-1),
        )  # fmt: skip
        return diagonal


# --- for autograd -----------------------------------------------------------------------------------------------------


class _Photometric(torch.autograd.Function):
    @staticmethod
    def forward(ctx, image: Tensor, loss: ViewLoss) -> Tensor:
        linear = loss.linearize(loss.padded(image), second_order=False)
        ctx.loss, ctx.gradient = loss, loss.cropped(linear.gradient)
        ctx.save_for_backward(image)
        return image.new_tensor(linear.value)

    @staticmethod
    def backward(ctx, *outputs: Tensor):
        return _PhotometricGradient.apply(*ctx.saved_tensors, outputs[0], ctx.loss, ctx.gradient), None


class _PhotometricGradient(torch.autograd.Function):
    @staticmethod
    def forward(ctx, image: Tensor, weight: Tensor, loss: ViewLoss, gradient: Tensor) -> Tensor:
        ctx.loss, ctx.gradient = loss, gradient
        ctx.save_for_backward(image, weight)
        return weight * gradient

    @staticmethod
    def backward(ctx, *outputs: Tensor):
        image, weight = ctx.saved_tensors
        linear = ctx.loss.linearize(ctx.loss.padded(image))
        product = ctx.loss.cropped(linear.hvp(ctx.loss.padded(outputs[0])[None])[0])
        values = (weight.detach() * product, (outputs[0].detach() * ctx.gradient).sum())
        return *last_derivative(values, image, weight, outputs[0]), None, None


def view_loss(image: Float[Tensor, "3 h w"], loss: ViewLoss) -> Float[Tensor, ""]:
    """The loss of an image as a torch scalar, twice differentiable, by the kernels."""
    return _Photometric.apply(image, loss)  # pyright: ignore[reportReturnType]
