"""The Hessian of the loss of any renderer with a gradient, even where its backward pass cannot be differentiated again.

    L(theta) = 1/M sum_m l(I_m(theta))       I_m: image of view m, differentiable once; l: its loss, twice by torch
    g = l'(I),   J = dI/dtheta,   w = l'' J v
    H_m v = J^T w + d/dh J(theta + h v)^T g  at h = 0; the first term is Gauss-Newton, G v; in the second g stands still

**Differences.**  With I+ and J+ at theta + h v, I- and J- at theta - h v, each derivative has two one-sided estimates:

    J v               (I+ - I) / h            and  (I - I-) / h
    the second term   (J+^T g - J^T g) / h    and  (J^T g - J-^T g) / h

Differences of gradients of the loss, which public tools take, see the kinks of the loss as well: under an L1 loss they are
wrong by more than the length of H v.

**Jumps.**  An image jumps where a splat falls under a threshold or two splats change their order.  A jump within reach of one
step adds jump / h to one estimate.  `one_sided` takes the mean of the two where they agree, the central difference, and the
smaller one elsewhere: the jump lies on the other side.

**The step h.**  |.| is the root mean square, dI the image's change in a step.  Rounding the image, by u = eps / 4 of its size
on average, makes a relative error u |I| / |dI| in J v.  Jumps make differences one-sided in pixels whose share grows with the
step, an error like |dI| / |I|.  The two are equal at |dI| = sqrt(u) |I|.  The noise of a renderer that does not repeat itself
takes the place of u where it is larger.  TRIALS renders find h, in the first view that v
changes; each before it costs as many.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass
from math import isfinite, sqrt
from typing import Any

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from landscape.errors import InputError
from landscape.linalg import column_lengths
from landscape.operators.operator import require_finite, require_vectors
from landscape.operators.renderer.parameters import Parameters
from landscape.results import ShortRepr

TRIALS = 2  # renders that find a step
FACTOR = 1e4  # the largest by which a trial changes h
ROUNDING = 1 / 4  # mean error of a rounded number, in units of eps
KEPT = 1 << 30  # bytes for J^T g of the first views; each other view costs one backward pass more in a product
SEEN = 3  # times the noise: a smaller change of an image may be noise alone, as two renders differ by sqrt(2) times it


@dataclass(frozen=True, eq=False, repr=False)
class ProductErrors(ShortRepr):
    """Errors of the products with k vectors.

    step: length of the difference to the product at twice the step.  An error in proportion to h or a higher power changes by
    at least its own size when h doubles; those of rounding and jumps differ at random.
    noise: length of the difference to the same product repeated, over sqrt(2); 0 for a renderer that repeats itself.
    kinks: no length, but the share of |J v|^2 in pixels whose one-sided differences disagree.

    J^T, from the renderer's own backward pass, is taken as exact: `check_renderer` compares it with J.
    """

    step: Float64[Tensor, " k"]
    noise: Float64[Tensor, " k"]
    kinks: Float64[Tensor, " k"]

    @property
    def total(self) -> Float64[Tensor, " k"]:
        """2 sqrt(step^2 + noise^2): twice the error that two products show.  On splats it covers 9 in 10 errors or more."""
        return 2 * torch.hypot(self.step, self.noise)


@dataclass(frozen=True, eq=False)
class LinearView:
    """A view at the point: its image with its graph, the loss and g, whose graph begins at `free`, a copy of the image."""

    image: Tensor
    free: Tensor
    loss: float
    gradient: Tensor

    def curvature(self, u: Tensor) -> Tensor:
        """l'' u, a tensor like the image."""
        if not self.gradient.requires_grad:  # the loss is linear in the image
            return torch.zeros_like(u)
        (product,) = torch.autograd.grad(
            self.gradient, self.free, u.to(self.free), retain_graph=True, allow_unused=True, materialize_grads=True
        )
        return product


def one_sided(forward: Tensor, backward: Tensor) -> tuple[Tensor, Bool[Tensor, "..."]]:
    """A derivative from its two one-sided estimates, and where these differ by more than their mean.

    >>> one_sided(torch.tensor([1.0, 1.0]), torch.tensor([1.5, 70.0]))
    (tensor([1.2500, 1.0000]), tensor([False,  True]))
    """
    mean = (forward + backward) / 2
    apart = (forward - backward).abs() > mean.abs()
    smaller = torch.where(forward.abs() < backward.abs(), forward, backward)
    return torch.where(apart, smaller, mean), apart


def rms(x: Tensor) -> float:
    """Root mean square, in float64."""
    return float(x.detach().double().square().mean().sqrt())


class RendererHessian:
    """The Hessian of the mean loss over views, from a renderer that need be differentiable only once.

    render: from a view to its image, a tensor of any shape that depends on the parameters as they are at the call.
    parameters: the leaf tensors by name, of one type on one device; each is a block, in this order; neighbours whose names
        agree before a slash, as sh/dc and sh/rest, are one.
    loss: from (image, view) to a scalar tensor, by torch operations that are differentiable twice in the image.
    views: two graphs at most are held, whatever their number.
    noise: standard deviation of the renderer's noise, relative to the image's root mean square; raised to what two renders of
        the first view show.

    value, gradient: of the mean loss.  gauss_newton: the operator J^T l'' J.  deterministic: whether the two renders are equal.
    curved: whether products have the second term; point: the parameters when it was made; kept: J^T g of the first views.
    Products move the parameters in place, and bring them back to the bit, after an exception too.  Approximations: see `error`.

    >>> x = torch.tensor([0.5, 2.0], dtype=torch.float64, requires_grad=True)
    >>> H = RendererHessian(lambda t: torch.exp(t * x), {"x": x}, lambda image, t: image.square().sum() / 2, [1.0, 1.0])
    >>> H.apply(torch.eye(2, dtype=torch.float64)).diagonal() / (2 * torch.exp(2 * x.detach()))  # (e^2x / 2)''
    tensor([1.0000, 1.0000], dtype=torch.float64)
    >>> H.passes(vectors=1), H.gauss_newton.passes(vectors=1)
    ((8, 6), (8, 2))
    """

    def __init__(
        self,
        render: Callable[[Any], Tensor],
        parameters: Mapping[str, Tensor],
        loss: Callable[[Tensor, Any], Tensor],
        views: Sequence[Any],
        noise: float = 0.0,
    ) -> None:
        if not len(views):
            raise InputError("expected at least one view, got none")
        if not (noise >= 0 and isfinite(noise)):
            raise InputError(f"expected a noise of 0 or more, as a share of the image's size, got {noise}")
        self.render, self.loss, self.views, self.curved = render, loss, views, True
        self.parameters = Parameters(parameters)
        self.dim, self.dtype, self.blocks = self.parameters.dim, self.parameters.dtype, self.parameters.blocks
        self.point = self.parameters.flat
        gradient = torch.zeros(self.dim, dtype=torch.float64, device=self.point.device)
        room = int(KEPT / (self.point.numel() * self.point.element_size()))
        losses, seen, self.kept = [], 0.0, []  # J^T g of the first views
        for index in range(len(views)):
            linear = self.linear(index)
            Jg = self.parameters.vjp(linear.image, linear.gradient.detach())
            gradient += Jg
            losses.append(linear.loss)
            if index < room:
                self.kept.append(Jg)
            if index == 0:
                seen = rms(self.image(0, linear.image) - linear.image) / sqrt(2) / (rms(linear.image) or 1.0)
        self.value, self.gradient = sum(losses) / len(losses), (gradient / len(views)).to(self.dtype)
        self.deterministic, self.noise = seen == 0, max(seen, noise)

    @property
    def gauss_newton(self) -> "RendererHessian":
        """The operator G of the same views."""
        found = copy(self)
        found.curved = False
        return found

    @property
    def change(self) -> float:
        """|dI| / |I| of a step."""
        return sqrt(max(self.noise, ROUNDING * torch.finfo(self.dtype).eps))

    def passes(self, vectors: int) -> tuple[int, int]:
        """Renders and backward passes of a product with so many vectors, if every view sees them; else at most."""
        views, pulled = len(self.views), (3 if self.curved else 1) * vectors
        more = views - len(self.kept) if self.curved else 0
        return views * (1 + 2 * vectors) + TRIALS * vectors, views * pulled + more

    def apply(self, V: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
        """H V, or G V."""
        require_vectors(V, self.dim, self.dtype)
        return self.products(V)[0]

    def error(self, V: Float[Tensor, "n k"]) -> ProductErrors:
        """Errors of the products with these vectors; takes two products with each, and a third where there is noise."""
        return self.measured(V)[1]

    def measured(self, V: Float[Tensor, "n k"]) -> tuple[Float[Tensor, "n k"], ProductErrors]:
        """H V and its errors."""
        column_lengths(V, "vectors")
        HV, kinks, _ = self.products(V)
        once = HV.double()
        longer = torch.linalg.vector_norm(once - self.products(V, factor=2.0)[0], dim=0)
        noise = torch.zeros_like(longer)
        if self.noise:
            noise = torch.linalg.vector_norm(once - self.products(V)[0], dim=0) / sqrt(2)
        require_finite(self, bool(torch.isfinite(longer + noise).all()))
        return HV, ProductErrors(longer, noise, kinks)

    def loss_at(self, theta: Float[Tensor, " n"]) -> Float64[Tensor, ""]:
        """The mean loss at other parameters, for slices and finite steps: one render of each view.

        It may not be called from several threads.
        """
        with self.parameters.restored(), torch.no_grad():
            self.parameters.write(theta)
            losses = [self.loss(self.render(view), view) for view in self.views]
        return torch.stack(losses).double().mean()

    def image(self, index: int, like: Tensor) -> Tensor:
        """The image of a view at the present parameters, without a graph.  InputError where it is unlike that at the point."""
        with torch.no_grad():
            image = self.render(self.views[index])
        return _alike(image, like, index)

    def linear(self, index: int) -> LinearView:
        """A view at the present parameters.  InputError where image or loss cannot be used."""
        with torch.enable_grad():
            image = self.render(self.views[index])
            _require_image(image, index)
            free = image.detach().clone().requires_grad_()
            value = self.loss(free, self.views[index])
            if not isinstance(value, Tensor) or value.ndim or not torch.isfinite(value) or not value.requires_grad:
                raise InputError(
                    f"expected a finite scalar tensor that depends on the image as loss of view {index}, got {value}; keep to "
                    "torch, without .item() and .detach()"
                )
            (gradient,) = torch.autograd.grad(value, free, create_graph=True)
        return LinearView(image, free, float(value.detach()), gradient)

    def products(
        self, V: Float[Tensor, "n k"], factor: float = 1.0
    ) -> tuple[Float[Tensor, "n k"], Float64[Tensor, " k"], Float64[Tensor, " k"]]:
        """H V, the share of |J v|^2 in kinked pixels, and the steps h: `factor` times those of `step`, 0 if no view sees v."""
        total, kinks = torch.zeros_like(V), torch.zeros(2, V.shape[1], dtype=torch.float64)
        steps = [0.0] * V.shape[1]
        with self.at_point():
            for index in range(len(self.views)):
                view = self.linear(index)
                Jg = self.kept[index] if index < len(self.kept) else None  # J^T g
                if self.curved and Jg is None:
                    Jg = self.parameters.vjp(view.image, view.gradient.detach(), keep=True)
                for j, v in enumerate(V.unbind(dim=1)):
                    steps[j] = steps[j] or self.step(index, view, v)
                    if steps[j]:  # else the view does not see v
                        Hv, Jv, apart = self._product(index, view, Jg, v, factor * steps[j])
                        total[:, j] += Hv
                        squares = Jv.double().square()
                        kinks[:, j] += torch.stack([squares[apart].sum(), squares.sum()]).cpu()
        lengths = factor * torch.tensor(steps, dtype=torch.float64)
        return total / len(self.views), kinks[0] / kinks[1].clamp_min(1e-300), lengths

    @contextmanager
    def at_point(self) -> Iterator[None]:
        """Bring the parameters back in the end.  InputError where they are not those that the operator was made at."""
        with self.parameters.restored() as here:
            if not torch.equal(here, self.point):
                raise InputError(
                    "expected the parameters that the operator was made at, got others; make one after each step"
                )
            yield

    def step(self, index: int, view: LinearView, v: Tensor) -> float:
        """The step h along v; 0 where the image changes by no more than SEEN times its noise."""
        largest, size, seen = float(v.abs().max()), rms(view.image) or 1.0, False
        noise = SEEN * self.noise * size
        # at first the largest entry of h v is `change` times the largest parameter
        h = self.change * (float(self.point.abs().max()) or 1.0) / largest if largest else 0.0
        for _ in range(TRIALS if largest else 0):
            self.parameters.write(self.point.double() + h * v.double())
            moved = rms(self.image(index, view.image) - view.image)
            seen, moved = moved > noise, max(moved, noise)
            # the image's change grows like h
            h *= min(max(self.change * size / moved, 1 / FACTOR), FACTOR) if moved else 0.0
        self.parameters.write(self.point)
        return h if seen else 0.0

    def change_of_image(
        self, index: int, view: LinearView, v: Tensor, h: float, cotangent: Tensor | None = None
    ) -> tuple[Tensor, Bool[Tensor, "..."], list[Tensor]]:
        """Three results, from two renders: J v of one view; a mask of where its one-sided differences disagree; and J+^T c and
        J-^T c of a cotangent c, or nothing without one.
        """
        images, pulled = [], []
        for step in (h, -h):
            self.parameters.write(self.point.double() + step * v.double())
            with torch.set_grad_enabled(cotangent is not None):
                image = self.render(self.views[index])
            images.append(_alike(image, view.image, index))
            if cotangent is not None:
                pulled.append(self.parameters.vjp(image, cotangent))
        self.parameters.write(self.point)
        middle = view.image.detach()
        return *one_sided((images[0] - middle) / h, (middle - images[1]) / h), pulled

    def _product(
        self, index: int, view: LinearView, Jg: Tensor | None, v: Tensor, h: float
    ) -> tuple[Tensor, Tensor, Bool[Tensor, "..."]]:
        """H_m v of one view; J v; a mask of where its one-sided differences disagree.  Jg: J^T g."""
        Jv, apart, pulled = self.change_of_image(index, view, v, h, view.gradient.detach() if self.curved else None)
        product = self.parameters.vjp(view.image, view.curvature(Jv), keep=True)
        if self.curved and Jg is not None:
            product += one_sided((pulled[0] - Jg) / h, (Jg - pulled[1]) / h)[0]
        return product, Jv, apart


def _require_image(image: object, index: int) -> None:
    """InputError unless render gave a finite tensor with a graph."""
    if not isinstance(image, Tensor) or not image.requires_grad:
        kind = "a tensor without a gradient" if isinstance(image, Tensor) else type(image).__name__
        raise InputError(
            f"expected render(view) to give a tensor that depends on the parameters, got {kind} for view {index}; leave out "
            "torch.no_grad, .detach() and .numpy()"
        )
    if bad := int((~torch.isfinite(image.detach())).sum()):
        raise InputError(
            f"expected a finite image of view {index}, got NaN or infinity in {bad} of its {image.numel()} numbers"
        )


def _alike(image: Tensor, like: Tensor, index: int) -> Tensor:
    """The image without its graph.  InputError unless it is finite and has the shape of another render of the view."""
    if image.shape != like.shape:
        raise InputError(
            f"expected images of one size for view {index}, got {tuple(like.shape)}, then {tuple(image.shape)}; fix the size"
        )
    if not torch.isfinite(image).all():
        raise InputError(f"expected a finite image of view {index} in every render, got NaN or infinity")
    return image.detach()
