"""The Hessian of the loss of any renderer with a gradient, even where its backward pass cannot be differentiated again.

    L(theta) = 1/M sum_m l(I_m(theta))       I_m: image of view m, differentiable once; l: its loss, twice by torch
    g = l'(I),   J = dI/dtheta
    H_m v = J^T l'' J v + d/dh J(theta + h v)^T g  at h = 0; the first term is Gauss-Newton, G v; in the second g stands still

**Differences.**  With I+ and J+ at theta + h v, I- and J- at theta - h v, each derivative has two one-sided estimates:

    J v               (I+ - I) / h            and  (I - I-) / h
    the second term   (J+^T g - J^T g) / h    and  (J^T g - J-^T g) / h

Differences of gradients of the loss, which public tools take, see its kinks as well: under an L1 loss they are wrong by more
than the length of H v.  An image jumps where a splat falls under a threshold or two splats change their order, which adds
jump / h to one estimate: `one_sided` takes the smaller one where the two disagree, else their mean.

**The step h.**  |.| is the root mean square, dI the image's change in a step.  Rounding the image, by u = eps / 4 of its size
on average, or noise u between equal renders, makes a relative error u |I| / |dI| in J v; jumps make differences one-sided in a
share of pixels like |dI| / |I|.  The two are equal at |dI| = sqrt(u) |I|.  TRIALS renders of the first view that v changes find
h; each view before it costs as many.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import copy
from math import isfinite, sqrt
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from landscape.errors import InputError
from landscape.linalg import column_lengths
from landscape.operators.operator import require_blocks, require_finite, require_vectors

Render = Callable[[Any], Tensor]
Loss = Callable[[Tensor, Any], Tensor]
TRIALS = 2  # renders that find a step
FACTOR = 1e4  # the largest by which a trial changes h
ROUNDING = 1 / 4  # mean error of a rounded number, in units of eps
KEPT = 1 << 30  # bytes for J^T g of the first views; each other view costs one backward pass more in a product
SEEN = 3  # times the noise: a smaller change of an image may be noise alone, as two renders differ by sqrt(2) times it


class Parameters:
    """Named leaf tensors as one vector, moved in place.  blocks: their rows; neighbours such as sh/dc and sh/rest are one."""

    def __init__(self, named: Mapping[str, Tensor]) -> None:
        if not isinstance(named, Mapping) or not named:
            raise InputError(f"expected a dict of named tensors as parameters, got {type(named).__name__} without any")
        self.tensors, self.blocks, self.dim = list(named.values()), dict[str, slice](), 0
        for name, tensor in named.items():
            if not (isinstance(tensor, Tensor) and tensor.is_leaf and tensor.requires_grad):
                raise InputError(
                    f"expected leaf tensors that require a gradient as parameters, got another as {name!r}; "
                    "name the tensors that the optimiser updates"
                )
            if not torch.isfinite(tensor).all():
                raise InputError(f"expected finite parameters, got NaN or infinity in {name!r}")
            block, start = name.split("/")[0], self.dim
            self.dim += tensor.numel()
            self.blocks[block] = slice(self.blocks.get(block, slice(start, start)).start, self.dim)
        require_blocks(self.blocks, self.dim)
        if len(kinds := {(tensor.dtype, tensor.device) for tensor in self.tensors}) > 1:
            raise InputError(f"expected parameters of one type on one device, got {sorted(map(str, kinds))}")

    def vector(self, parts: Sequence[Tensor] | None = None) -> Float[Tensor, " n"]:
        """A copy of tensors of the parameters' shapes, of these as they are now by default, as one vector."""
        return torch.cat([part.detach().reshape(-1) for part in parts or self.tensors])

    def write(self, flat: Float[Tensor, " n"]) -> None:
        """Set the parameters, rounded to their type, unseen by autograd: a graph can be used when its numbers are back."""
        for tensor, part in zip(self.tensors, flat.split([each.numel() for each in self.tensors]), strict=True):
            tensor.data.copy_(part.view_as(tensor))

    @contextmanager
    def restored(self, point: Tensor | None = None) -> Iterator[Tensor]:
        """Yield the vector, and bring it back to the bit, after an exception too.  InputError where it is not `point`."""
        before = self.vector()
        if point is not None and not torch.equal(before, point):
            raise InputError("expected the parameters that the operator was made at, got others; make another one")
        try:
            yield before
        finally:
            self.write(before)

    def vjp(self, image: Tensor, cotangent: Tensor, keep: bool = False) -> Float[Tensor, " n"]:
        """J^T times the cotangent, for an image with a graph.  keep: the graph."""
        parts = torch.autograd.grad(
            image, self.tensors, cotangent.to(image), retain_graph=keep, allow_unused=True, materialize_grads=True
        )
        return self.vector(parts)


class ProductErrors(NamedTuple):
    """Errors of the products with k vectors; J^T, the renderer's own backward pass, is taken as exact (`check_renderer`).

    step: length of the difference to the product at twice the step.  An error in proportion to h or a higher power changes by
        at least its own size when h doubles; those of rounding and jumps differ at random.
    noise: length of the difference to the same product repeated, over sqrt(2); 0 for a renderer that repeats itself.
    kinks: no length, but the share of |J v|^2 in pixels whose one-sided differences disagree.
    """

    step: Float64[Tensor, " k"]
    noise: Float64[Tensor, " k"]
    kinks: Float64[Tensor, " k"]

    @property
    def total(self) -> Float64[Tensor, " k"]:
        """2 sqrt(step^2 + noise^2): twice the error that two products show.  On splats it covers 9 in 10 errors or more."""
        return 2 * torch.hypot(self.step, self.noise)


class LinearView(NamedTuple):
    """A view at the point, by its number: image with its graph, loss, and g, whose graph begins at `free`, an equal image."""

    index: int
    image: Tensor
    free: Tensor
    loss: float
    gradient: Tensor

    def curvature(self, u: Tensor) -> Tensor:
        """l'' u, a tensor like the image."""
        if not self.gradient.requires_grad:  # the loss is linear in the image
            return torch.zeros_like(u)
        return torch.autograd.grad(
            self.gradient, self.free, u.to(self.free), retain_graph=True, allow_unused=True, materialize_grads=True
        )[0]


def one_sided(forward: Tensor, backward: Tensor) -> tuple[Tensor, Bool[Tensor, "..."]]:
    """A derivative from its two one-sided estimates, and where these differ by more than their mean."""
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
    parameters: the leaf tensors by name, of one type on one device; each is a block (`Parameters`).
    loss: from (image, view) to a scalar tensor, by torch operations that are differentiable twice in the image.
    noise: standard deviation of the renderer's noise, relative to the image's root mean square; raised to what two renders of
        the first view show.  deterministic: whether these are equal.  value, gradient: of the mean loss.

    Products hold two graphs at most.  They move the parameters, and bring them back to the bit, after an exception too.

    >>> x = torch.tensor([0.5, 2.0], dtype=torch.float64, requires_grad=True)
    >>> H = RendererHessian(lambda t: torch.exp(t * x), {"x": x}, lambda image, t: image.square().sum() / 2, [1.0, 1.0])
    >>> H.apply(torch.eye(2, dtype=torch.float64)).diagonal() / (2 * torch.exp(2 * x.detach()))  # (e^2x / 2)''
    tensor([1.0000, 1.0000], dtype=torch.float64)
    >>> H.passes(vectors=1), H.gauss_newton.passes(vectors=1)
    ((8, 6), (8, 2))
    """

    def __init__(
        self, render: Render, parameters: Mapping[str, Tensor], loss: Loss, views: Sequence[Any], noise: float = 0.0
    ) -> None:
        if not len(views):
            raise InputError("expected at least one view, got none")
        if not (noise >= 0 and isfinite(noise)):
            raise InputError(f"expected a noise of 0 or more, as a share of the image's size, got {noise}")
        self.render, self.loss, self.views, self.curved = render, loss, views, True
        self.parameters = Parameters(parameters)
        self.point = self.parameters.vector()
        self.dim, self.dtype, self.blocks = self.parameters.dim, self.point.dtype, self.parameters.blocks
        gradient = torch.zeros_like(self.point, dtype=torch.float64)
        total, seen, self.kept = 0.0, 0.0, {}  # J^T g of the first views
        for index in range(len(views)):
            view = self.linear(index)
            Jg = self.parameters.vjp(view.image, view.gradient.detach())
            total, gradient = total + view.loss, gradient + Jg
            if (index + 1) * Jg.nbytes <= KEPT:
                self.kept[index] = Jg
            if index == 0:
                seen = rms(self.image(0, view.image) - view.image) / sqrt(2) / (rms(view.image) or 1.0)
        self.value, self.gradient = total / len(views), (gradient / len(views)).to(self.dtype)
        self.deterministic, self.noise = seen == 0, max(seen, noise)
        self.change = sqrt(max(self.noise, ROUNDING * torch.finfo(self.dtype).eps))  # |dI| / |I| of a step

    @property
    def gauss_newton(self) -> "RendererHessian":
        """The operator G = J^T l'' J of the same views."""
        found = copy(self)
        found.curved = False
        return found

    def passes(self, vectors: int) -> tuple[int, int]:
        """Renders and backward passes of a product with so many vectors, if every view sees them; else at most."""
        views, back = len(self.views), len(self.views) * vectors
        back += 2 * back + views - len(self.kept) if self.curved else 0
        return views * (1 + 2 * vectors) + TRIALS * vectors, back

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
        others = self.products(V, factor=2.0)[0], self.products(V)[0] if self.noise else HV
        longer, again = (torch.linalg.vector_norm(HV.double() - other, dim=0) for other in others)
        require_finite(self, bool(torch.isfinite(longer + again).all()))
        return HV, ProductErrors(longer, again / sqrt(2), kinks)

    def loss_at(self, theta: Float[Tensor, " n"]) -> Float64[Tensor, ""]:
        """The mean loss at other parameters, for slices and finite steps, from one thread alone: a render of each view."""
        with self.parameters.restored(), torch.no_grad():
            self.parameters.write(theta)
            losses = [self.loss(self.render(view), view) for view in self.views]
        return torch.stack(losses).double().mean()

    def products(self, V: Float[Tensor, "n k"], factor: float = 1.0) -> tuple[Tensor, Tensor, Tensor]:
        """H V, the share of |J v|^2 in kinked pixels, and the steps h: `factor` times those of `step`, 0 if no view sees v."""
        total, kinks = torch.zeros_like(V), torch.zeros(2, V.shape[1], dtype=torch.float64)
        steps = torch.zeros_like(kinks[0])
        with self.parameters.restored(self.point):
            for index in range(len(self.views)):
                view, Jg = self.linear(index), self.kept.get(index) if self.curved else None
                if self.curved and Jg is None:
                    Jg = self.parameters.vjp(view.image, view.gradient.detach(), keep=True)
                for j, v in enumerate(V.unbind(dim=1)):
                    steps[j] = steps[j] or factor * self.step(view, v)
                    if h := float(steps[j]):  # else the view does not see v
                        Jv, apart, second = self.differences(view, v, h, Jg)
                        total[:, j] += self.parameters.vjp(view.image, view.curvature(Jv), keep=True) + second
                        squares = Jv.double().square()
                        kinks[:, j] += torch.stack([squares[apart].sum(), squares.sum()]).cpu()
        return total / len(self.views), kinks[0] / kinks[1].clamp_min(1e-300), steps

    @torch.enable_grad()
    def linear(self, index: int) -> LinearView:
        """A view at the present parameters.  InputError where image or loss cannot be used."""
        image = self.image(index, graph=True)
        free = image.detach().clone().requires_grad_()
        value = self.loss(free, self.views[index])
        if not isinstance(value, Tensor) or value.ndim or not torch.isfinite(value) or not value.requires_grad:
            raise InputError(
                f"expected a finite scalar tensor that depends on the image as loss of view {index}, got {value}; keep to torch"
            )
        (gradient,) = torch.autograd.grad(value, free, create_graph=True)
        return LinearView(index, image, free, float(value.detach()), gradient)

    def image(self, index: int, like: Tensor | None = None, graph: bool = False) -> Tensor:
        """A view at the present parameters.  InputError unless finite, with a graph if asked for, of the size of `like`."""
        with torch.set_grad_enabled(graph):
            image = self.render(self.views[index])
        if not isinstance(image, Tensor) or image.requires_grad < graph:
            kind = "a tensor without a gradient" if isinstance(image, Tensor) else type(image).__name__
            raise InputError(
                f"expected an image that depends on the parameters, got {kind} for view {index}; leave out no_grad and detach"
            )
        if like is not None and image.shape != like.shape:
            raise InputError(
                f"expected images of one size for view {index}, got {tuple(like.shape)}, then {tuple(image.shape)}; fix it"
            )
        if bad := int((~torch.isfinite(image.detach())).sum()):
            every = "" if like is None else " in every render"
            raise InputError(
                f"expected a finite image of view {index}{every}, got NaN or infinity in {bad} of its {image.numel()} numbers"
            )
        return image

    def step(self, view: LinearView, v: Tensor) -> float:
        """The step h along v; 0 where the image changes by no more than SEEN times its noise."""
        if not (largest := float(v.abs().max())):
            return 0.0
        size, moved = rms(view.image) or 1.0, 0.0
        noise = SEEN * self.noise * size
        # at first the largest entry of h v is `change` times the largest parameter; the image's change grows like h
        h = self.change * (float(self.point.abs().max()) or 1.0) / largest
        for _ in range(TRIALS):
            self.parameters.write(self.point.double() + h * v.double())
            moved = rms(self.image(view.index, view.image) - view.image)
            if reached := max(moved, noise):
                h *= min(max(self.change * size / reached, 1 / FACTOR), FACTOR)
        self.parameters.write(self.point)
        return h if moved > noise else 0.0

    def differences(self, view: LinearView, v: Tensor, h: float, Jg: Tensor | None) -> tuple[Tensor, Tensor, Any]:
        """J v; a mask of where its one-sided estimates disagree; and the second term, given J^T g.  From two renders."""
        images, pulled = [], []
        for step in (h, -h):
            self.parameters.write(self.point.double() + step * v.double())
            image = self.image(view.index, view.image, graph=Jg is not None)
            images.append(image.detach())
            if Jg is not None:
                pulled.append(self.parameters.vjp(image, view.gradient.detach()))
        self.parameters.write(self.point)
        here = view.image.detach()
        Jv, apart = one_sided((images[0] - here) / h, (here - images[1]) / h)
        return Jv, apart, 0.0 if Jg is None else one_sided((pulled[0] - Jg) / h, (Jg - pulled[1]) / h)[0]
