"""The subspace of a (block) Lanczos recurrence with thick restarts (Wu and Simon 2000), and what is reported of its pairs.

Q is orthonormal and T = Q^T H Q is known as a full matrix, so that nothing is assumed of its shape after a restart.  When the
memory budget of basis vectors is full, the Ritz vectors (`ritz`) next to both ends are kept and the recurrence goes on from
them.  The residual r_i = H v_i - lambda_i v_i is known up to the noise of products: the vectors that come next, times B s_i
with B what couples them to the newest rows of Q and s_i the coordinates of v_i in these.

**What is seen of a product's noise.**  By symmetry a product H q_j has components q_i . H q_j that are known already.  Each
is off by q_i . e_j - e_i . q_j, e the noise of a product: its rounding, or whatever else sets it off.  A recurrence begins at
a random vector, so all m (m - 1) / 2 pairs of m steps see noise as random vectors do, 2 |e|^2 / n in the mean square.  The
|r| reported is widened by MARGIN times this |e|, or times the round-off that a product of this precision has at best,
eps |lambda|_max, where that is more.  No product is spent on the noise where the sum is as small as was asked for, or where
less than this round-off was asked for.

**What is not seen.**  The components are sums in the vectors' precision, whose own round-off may be the larger noise in long
float32 vectors.  Where the sum above misses the goal, one product with all k pairs, signs at random,

    f = H x - sum_i +-(lambda_i v_i + r_i),  x = sum_i +-v_i

shows what the subspace does not know: |f|^2 is on average k times the mean square of one pair's noise, and |r_i +- f| is taken
for the residual.  Where that is more than was asked for, as at the end of a budget, each pair has a product of its own.  The
noise is also measured once before, with one vector more, when a residual that is still above its goal has come near the noise
that is seen: from there on steps might be made in vain.
"""

from math import hypot, inf, isfinite, isnan, log, nan, sqrt

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from landscape.eigen.pairs import EigenEnds, Eigenpairs
from landscape.eigen.ritz import EigenSettings, Goal, Ritz, rayleigh, recombine, turned
from landscape.linalg import is_roundoff, norm, orthogonalise, unit_columns
from landscape.operators.checks import SCALE
from landscape.operators.operator import SymmetricOperator, product, require_finite
from landscape.probes import draw_probes
from landscape.results import StopReason

KEEP = 0.6  # share of the basis that a restart keeps
MARGIN = 4.0  # of the noise that is seen: what it may be in the directions of the wanted vectors
PAIRS = 10  # known components from which it can be told


class Krylov:
    """Rows 0..size of the basis are orthonormal with T = Q^T H Q known; the `width` rows after them come next.

    It grows by what H makes of its newest rows.
    """

    def __init__(
        self, operator: SymmetricOperator, generator: torch.Generator, settings: EigenSettings, start: Tensor | None
    ) -> None:
        first = draw_probes(operator.dim, min(settings.block, operator.dim), generator, operator.dtype)
        self.operator, self.generator, self.settings = operator, generator, settings
        self.capacity = min(settings.basis, operator.dim)  # rows with T known at a time
        rows = self.capacity + settings.block
        self.basis = torch.empty(rows, operator.dim, dtype=operator.dtype, device=generator.device)
        self.T = torch.zeros(self.capacity, self.capacity, dtype=torch.float64)
        self.size, self.width, self.matvecs, self.noise = 0, 0, 0, nan
        self.restarted = self._exhausted = False
        self.scale, self.coupling = 1.0, torch.zeros(0, 0, dtype=torch.float64)
        self.random_share, self.first_cycle = 1.0, 0
        if start is not None:
            first[:, 0] = _mixed(start, first[:, 0], settings.noise)
            self.random_share = settings.noise / (1 + settings.noise)
        self.append(first.T.contiguous())
        # components that symmetry tells, how many were, and the root of the sum of squares that they are off by
        self.foreseen = torch.zeros(0, self.width, dtype=torch.float64)
        self.pairs, self.surprise = 0, 0.0

    def expand(self, near_noise: bool) -> None:
        """Apply H to the rows that come next; near_noise: and measure the noise, if it is not known yet."""
        old, new = self.size, self.size + self.width
        W = self.products(near_noise)
        lengths = [norm(w) for w in W]
        require_finite(self.operator, all(map(isfinite, lengths)))
        self.scale = max(self.scale if old else 0.0, *lengths)
        components = orthogonalise(W, self.basis[:new])
        self.surprise = hypot(self.surprise, norm(components[:old] - self.foreseen))
        self.pairs += self.foreseen.numel()
        self.project(components)
        self.coupling = self.append(W)
        self.foreseen = torch.zeros(new, self.width, dtype=torch.float64)
        self.foreseen[old:] = self.coupling.T
        self.first_cycle += not self.restarted

    def ritz(self) -> Ritz:
        """All pairs of the rows so far; the wanted ones of the upper end descending, of the lower one ascending."""
        m, settings = self.size, self.settings
        values, coordinates = torch.linalg.eigh(self.T[:m, :m])
        residuals = torch.linalg.vector_norm(self.coupling @ coordinates[m - self.coupling.shape[1] :], dim=0)
        descending = list(range(m - 1, m - 1 - settings.largest, -1))
        return Ritz(values, coordinates, residuals, descending, list(range(settings.smallest)))

    def exhausted(self, ritz: Ritz, goal: Goal) -> bool:
        """Whether H has led out of the rows no more, now or before: rows since then are random ones.

        No residual says then that another eigenvector of a wanted value is missing, so a run ends only where one more row has
        moved none.
        """
        # no residual is longer than what H makes of the newest rows is at right angles to all
        self._exhausted |= norm(self.coupling) <= float(goal.of(ritz.values[ritz.wanted]).max())
        return self._exhausted

    def make_room(self, ritz: Ritz) -> None:
        """Restart where there is none for the rows that come next.

        From the share KEEP of the memory, at least the wanted pairs.  Those beyond come from both ends evenly, whichever end is
        still open: those of its own end speed it up where the spectrum is dense there, those of the other end where that one
        reaches far.
        """
        if self.size + self.width <= self.capacity:
            return
        s, following = self.settings, self.basis[self.size : self.size + self.width].clone()
        keep = max(s.wanted, min(int(self.capacity * KEEP), self.capacity - 2 * s.block))
        top = s.largest + (keep - s.wanted) // 2
        kept = list(range(keep - top)) + list(range(self.size - top, self.size))
        combination = ritz.coordinates[:, kept].T
        recombine(self.basis, combination)
        self.basis[keep : keep + self.width] = following
        self.T.zero_()
        self.T[:keep, :keep] = torch.diag(ritz.values[kept])
        self.foreseen = combination[:, self.size - self.coupling.shape[1] :] @ self.coupling.T
        self.size, self.restarted = keep, True

    @property
    def seen_noise(self) -> float:
        """The noise of a product as far as symmetry shows it; nan: not yet."""
        return self.surprise * sqrt(self.operator.dim / (2 * self.pairs)) if self.pairs >= PAIRS else nan

    def floor(self, ritz: Ritz) -> float:
        """The residual that the matvec's noise leaves at least, as far as it was measured."""
        return self.rounding(ritz) if isnan(self.noise) else max(self.noise, self.rounding(ritz))

    def rounding(self, ritz: Ritz) -> float:
        """What rounding leaves of a product at best, independent in every row."""
        return torch.finfo(self.basis.dtype).eps * float(ritz.values.abs().max())

    def products(self, near_noise: bool) -> Float[Tensor, "width n"]:
        """H times the rows that come next, whatever numbers it has."""
        V = self.basis[self.size : self.size + self.width].T
        if near_noise and isnan(self.noise):
            V = torch.cat([V, SCALE * V[:, :1]], dim=1)
        W = product(self.operator, V.contiguous(), finite=False).T.clone(memory_format=torch.contiguous_format)
        self.matvecs += len(W)
        if len(W) > self.width:
            self.noise, W = norm(W[-1].double() / SCALE - W[0].double()), W[:-1]
        return W

    def project(self, components: Float64[Tensor, "new width"]) -> None:
        """T has the rows that came next too, given q_i . H q_j of all rows with these."""
        old, self.size = self.size, len(components)
        new = slice(old, self.size)
        self.T[: self.size, new] = components
        self.T[new, : self.size] = components.T
        self.T[new, new] = (components[old:] + components[old:].T) / 2

    def append(self, W: Float[Tensor, "b n"]) -> Float64[Tensor, "next b"]:
        """Orthonormal rows after the first `size` that span the rows of W, orthogonal to these; B with W^T = next^T B.

        A row that is round-off alone, of vectors of the length `scale` (an invariant subspace is complete), is replaced by a
        random one, with B = 0.
        """
        B = torch.zeros(W.shape[0], W.shape[0], dtype=torch.float64)
        self.width = 0
        for j, w in enumerate(W):
            found = self.basis[self.size : self.size + self.width]
            if self.size + self.width == self.operator.dim:
                break
            before = norm(w)
            B[: self.width, j] = orthogonalise(w[None], found)[:, 0]
            length = norm(w)
            if length < max(before, self.scale) / 10:  # cancellation brought the round-off of earlier passes forward
                orthogonalise(w[None], self.basis[: self.size + self.width])
                length = norm(w)
            if is_roundoff(length, self.scale, w.dtype):
                self._exhausted = True
                w.normal_(generator=self.generator)
                orthogonalise(w[None], self.basis[: self.size + self.width])
                torch.div(w, norm(w), out=self.basis[self.size + self.width])
            else:
                B[self.width, j] = length
                torch.div(w, length, out=self.basis[self.size + self.width])
            self.width += 1
        return B[: self.width]

    def measured(self, ritz: Ritz, budget: StopReason, converged: bool) -> tuple[EigenEnds, bool]:
        """The wanted pairs with residuals by the operator itself, and whether more steps would make them better."""
        s = self.settings
        vectors = self.basis[: self.size].T @ ritz.coordinates[:, ritz.wanted].to(self.basis)
        vectors /= torch.linalg.vector_norm(vectors, dim=0)  # restarts leave a little of their round-off
        known = ritz.residuals[ritz.wanted]
        values, residuals = self._checked(ritz, vectors, converged)
        # a residual far above what the subspace knows of it is the matvec's round-off: more steps cannot lower it
        stuck = (known <= residuals / 4) | (known <= self.floor(ritz))
        reached = residuals <= Goal(s.rtol, s.atol).of(values)
        errors = residuals / ritz.gaps()

        def end(part: slice, descending: bool) -> Eigenpairs:
            reason: StopReason = budget
            if not len(values[part]):
                reason = "not asked for"
            elif (reached | stuck)[part].all():
                reason = "tolerance" if reached[part].all() else "noise floor"
            order = torch.argsort(values[part], descending=descending)
            pairs = [quantity[part][order] for quantity in (values, residuals, errors)]
            return Eigenpairs(pairs[0], turned(vectors[:, part][:, order]), pairs[1], pairs[2], reason)

        largest, smallest = end(slice(0, s.largest), True), end(slice(s.largest, s.wanted), False)
        spectrum = torch.stack([ritz.values, ritz.residuals])
        noise = self.seen_noise if isnan(self.noise) else self.noise
        spread = float(ritz.values[-1] - ritz.values[0])
        beyond = _beyond(self.operator.dim, self.first_cycle, spread, self.random_share)
        ends = EigenEnds(largest, smallest, "lanczos", self.matvecs, beyond, noise, spectrum)
        return ends, not bool((reached | stuck).all())

    def _checked(
        self, ritz: Ritz, vectors: Float[Tensor, "n k"], converged: bool
    ) -> tuple[Float64[Tensor, " k"], Float64[Tensor, " k"]]:
        """Values and residuals of the wanted pairs: the recurrence's with a margin where these do, else from products."""
        values, rounding = ritz.values[ritz.wanted], self.rounding(ritz)
        asked = Goal(self.settings.rtol, self.settings.atol).of(values)
        residuals = ritz.residuals[ritz.wanted] + MARGIN * max(self.seen_noise, rounding)
        out_of_reach = (asked <= rounding) & (self.seen_noise <= MARGIN * rounding)
        if converged and ((residuals <= asked) | out_of_reach).all():
            return values, residuals
        enough = asked.clamp_min(self.floor(ritz))
        if converged and ((residuals := self._together(ritz, vectors)) <= enough).all():
            return values, residuals
        self.matvecs += len(values)
        return rayleigh(self.operator, vectors)

    def _together(self, ritz: Ritz, vectors: Float[Tensor, "n k"]) -> Float64[Tensor, " k"]:
        """Residuals of all pairs from one product; measures the noise."""
        signs = draw_probes(len(ritz.wanted), 1, self.generator, torch.float64, "rademacher")[:, 0]
        unknown = product(self.operator, (vectors @ signs.to(vectors.dtype))[:, None])[:, 0].double()
        self.matvecs += 1
        known = self.remainders(ritz)
        for i, value in enumerate(ritz.values[ritz.wanted]):
            unknown -= signs[i] * (value * vectors[:, i] + known[:, i])
        self.noise = norm(unknown) / len(signs) ** 0.5
        return torch.tensor([norm(signs[i] * known[:, i] + unknown) for i in range(len(signs))], dtype=torch.float64)

    def remainders(self, ritz: Ritz) -> Float[Tensor, "n k"]:
        """r of the wanted pairs."""
        last = ritz.coordinates[self.size - self.coupling.shape[1] : self.size, ritz.wanted]
        return self.basis[self.size : self.size + self.width].T @ (self.coupling @ last).to(self.basis)


def _mixed(start: Tensor, random: Tensor, noise: float) -> Tensor:
    """The normalised sum of the start vectors' directions, with so much of the random vector."""
    total = unit_columns(start.reshape(random.numel(), -1).to(random)).sum(dim=1)
    return total / norm(total) + noise * random / norm(random)


def _beyond(n: int, steps: int, spread: float, share: float) -> float:
    """How far outside the Ritz values the spectrum may reach, with probability 0.99 over a random start.

    Kuczynski and Wozniakowski (1992), Theorem 4.2: after m steps the end is missed by more than the share eps of the
    spectrum's width with probability at most 1.648 sqrt(n) exp(-sqrt(eps) (2 m - 1)).  Beside a random vector of this share of
    the start's length a given one costs a factor of 1 / share: it lengthens the start, and the end's component of the sum is
    no likelier to be small than that of the random vector alone, whose density is symmetric and falls from 0 on.
    """
    if steps >= n:
        return 0.0
    eps = (log(2 * 1.648 * sqrt(n) / (0.01 * share)) / (2 * steps - 1)) ** 2
    return eps / (1 - 2 * eps) * spread if eps < 0.5 else inf
