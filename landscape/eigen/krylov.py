"""The subspace of a (block) Lanczos recurrence with thick restarts (Wu and Simon 2000), and the errors of its eigenpairs.

The rows of `basis` are an orthonormal Q, and T = Q^T H Q is stored as a full matrix, as a restart fills it.  When the memory
for basis vectors is full, the Ritz vectors (`ritz`) next to both ends are kept and the recurrence goes on from them.  The
residual r_i = H v_i - lambda_i v_i follows from the recurrence without a product: r_i = N^T B s_i with the next rows N of the
basis, the coupling B of N to the newest rows of the basis, and the coordinates s_i of v_i in these.

**Noise from symmetry.**  H is symmetric, so components q_i . H q_j of a new product are known from earlier ones.  They differ
by q_i . e_j - e_i . q_j, where e is the noise of a product: round-off, or any other error.  A recurrence starts at a random
vector, so this difference behaves as for random vectors, with the mean square 2 |e|^2 / n; this gives |e|.  Reported residuals
are widened by MARGIN times the larger of |e| and eps |lambda|_max, the smallest possible round-off of a product.  If the
widened residual meets the goal, or the goal is below that round-off, no further product is made.

**Noise from one more product.**  The components themselves are rounded sums in the vectors' precision, which can hide noise in
long float32 vectors.  Where the widened residual misses the goal, one product with all k pairs, with random signs,

    f = H x - sum_i +-(lambda_i v_i + r_i),  x = sum_i +-v_i

measures it: |f|^2 is on average k times the mean square of one pair's noise, and |r_i +- f| is reported as residual.  Where
that misses the goal as well, or at the end of a budget, each pair gets its own product.  When a residual above its goal comes
near the noise from symmetry, further steps may be useless; the noise is then measured once, by one vector more in a product.
"""

from math import hypot, inf, isfinite, isnan, log, nan, sqrt

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from landscape.eigen.pairs import EigenEnds, Eigenpairs
from landscape.eigen.ritz import EigenSettings, Goal, Ritz, rayleigh, recombine, turned
from landscape.linalg import is_roundoff, norm, orthogonalise, unit_columns
from landscape.operators.checks import SCALE
from landscape.operators.operator import LiftedOperator, SymmetricOperator, product, require_finite
from landscape.probes import draw_probes
from landscape.results import StopReason

KEEP = 0.6  # share of the basis that a restart keeps
MARGIN = 4.0  # the noise along wanted vectors may exceed the mean noise by this factor
FEWEST_PREDICTIONS = 10  # components known from symmetry, for an estimate of the noise


class Krylov:
    """The basis: orthonormal rows 0..size with known T = Q^T H Q, and `width` next rows, to which H is applied next.

    coupling: B.  scale: largest length of a product.  predicted: components of the next products known from symmetry;
    predictions, mismatch: number of such components so far, and the norm of all their differences.  noise: of a product, as
    measured, nan before.  first_cycle: steps before the first restart.  random_share: length of the random part of the start.
    """

    def __init__(
        self, operator: SymmetricOperator, generator: torch.Generator, settings: EigenSettings, start: Tensor | None
    ) -> None:
        first = draw_probes(operator.dim, min(settings.block, operator.dim), generator, operator.dtype)
        self.operator, self.generator, self.settings = operator, generator, settings
        self.capacity = min(settings.basis, operator.dim)  # rows with known T
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
        if isinstance(operator, LiftedOperator):  # without a part in the null space, up to round-off
            first = operator.project(first)
        self.append(first.T.contiguous())
        self.predicted = torch.zeros(0, self.width, dtype=torch.float64)
        self.predictions, self.mismatch = 0, 0.0

    def expand(self, near_noise: bool) -> None:
        """Apply H to the next rows.  near_noise: also measure the noise, unless it is known."""
        old, new = self.size, self.size + self.width
        W = self.products(near_noise)
        lengths = [norm(w) for w in W]
        require_finite(self.operator, all(map(isfinite, lengths)))
        self.scale = max(self.scale if old else 0.0, *lengths)
        components = orthogonalise(W, self.basis[:new])
        self.mismatch = hypot(self.mismatch, norm(components[:old] - self.predicted))
        self.predictions += self.predicted.numel()
        self.project(components)
        self.coupling = self.append(W)
        self.predicted = torch.zeros(new, self.width, dtype=torch.float64)
        self.predicted[old:] = self.coupling.T
        self.first_cycle += not self.restarted

    def ritz(self) -> Ritz:
        """All Ritz pairs, with the indices of the wanted ones: descending at the upper end, ascending at the lower end."""
        m, settings = self.size, self.settings
        values, coordinates = torch.linalg.eigh(self.T[:m, :m])
        residuals = torch.linalg.vector_norm(self.coupling @ coordinates[m - self.coupling.shape[1] :], dim=0)
        descending = list(range(m - 1, m - 1 - settings.largest, -1))
        return Ritz(values, coordinates, residuals, descending, list(range(settings.smallest)))

    def exhausted(self, ritz: Ritz, goal: Goal) -> bool:
        """Whether the basis spans, or has spanned, an invariant subspace, so that later rows are random vectors.

        All residuals are then small, even if another eigenvector of a wanted value is missing.  So a run ends only after a
        further row has changed no wanted value.
        """
        # |B| bounds every residual
        self._exhausted |= norm(self.coupling) <= float(goal.of(ritz.values[ritz.wanted]).max())
        return self._exhausted

    def make_room(self, ritz: Ritz) -> None:
        """Restart if the memory has no room for the next rows.

        The share KEEP of the Ritz vectors stays, at least the wanted ones; the others in equal numbers from both ends.  Those
        near an end help it converge where the spectrum is dense there, those at the other end where it reaches far.
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
        self.predicted = combination[:, self.size - self.coupling.shape[1] :] @ self.coupling.T
        self.size, self.restarted = keep, True

    @property
    def seen_noise(self) -> float:
        """The noise of a product from symmetry; nan with fewer than FEWEST_PREDICTIONS components."""
        return (
            self.mismatch * sqrt(self.operator.dim / (2 * self.predictions))
            if self.predictions >= FEWEST_PREDICTIONS
            else nan
        )

    def floor(self, ritz: Ritz) -> float:
        """The smallest residual that the measured noise of a product permits."""
        return self.rounding(ritz) if isnan(self.noise) else max(self.noise, self.rounding(ritz))

    def rounding(self, ritz: Ritz) -> float:
        """The smallest possible round-off of a product, eps |lambda|_max."""
        return torch.finfo(self.basis.dtype).eps * float(ritz.values.abs().max())

    def products(self, near_noise: bool) -> Float[Tensor, "width n"]:
        """H times the next rows, without a check for finite numbers.  near_noise: see `expand`."""
        V = self.basis[self.size : self.size + self.width].T
        if near_noise and isnan(self.noise):
            V = torch.cat([V, SCALE * V[:, :1]], dim=1)
        W = product(self.operator, V.contiguous(), finite=False).T.clone(memory_format=torch.contiguous_format)
        self.matvecs += len(W)
        if len(W) > self.width:
            self.noise, W = norm(W[-1].double() / SCALE - W[0].double()), W[:-1]
        return W

    def project(self, components: Float64[Tensor, "new width"]) -> None:
        """Extend T by the next rows, given their components q_i . H q_j with all rows."""
        old, self.size = self.size, len(components)
        new = slice(old, self.size)
        self.T[: self.size, new] = components
        self.T[new, : self.size] = components.T
        self.T[new, new] = (components[old:] + components[old:].T) / 2

    def append(self, W: Float[Tensor, "b n"]) -> Float64[Tensor, "next b"]:
        """Make orthonormal next rows N that span the rows of W, which are orthogonal to the basis; return B with W^T = N^T B.

        A row that is only round-off of vectors of length `scale` means that the basis spans an invariant subspace.  It is
        replaced by a random vector, with B = 0.
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
            if length < max(before, self.scale) / 10:  # cancellation has magnified the round-off of earlier passes
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
        """The wanted pairs with reported residuals, and whether more steps would make them better.

        budget: the reason for pairs that have not reached their goal.  converged: whether the recurrence meets the goal.
        """
        s = self.settings
        vectors = self.basis[: self.size].T @ ritz.coordinates[:, ritz.wanted].to(self.basis)
        vectors /= torch.linalg.vector_norm(vectors, dim=0)  # restarts add round-off
        known = ritz.residuals[ritz.wanted]
        values, residuals = self._checked(ritz, vectors, converged)
        # a residual far above that of the recurrence is noise of the matvec: more steps cannot lower it
        stuck = (known <= residuals / 4) | (known <= self.floor(ritz))
        reached = residuals <= Goal(s.rtol, s.atol).of(values)
        errors = residuals / ritz.gaps()[ritz.wanted]

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
        further = self._further(ritz) if s.further else None
        ends = EigenEnds(largest, smallest, "lanczos", self.matvecs, beyond, noise, spectrum, further)
        return ends, not bool((reached | stuck).all())

    def _further(self, ritz: Ritz) -> tuple[Eigenpairs, Eigenpairs]:
        """The pairs next to those wanted at either end, as they are."""
        s, order, found = self.settings, range(len(ritz.values)), []
        for chosen in (order[::-1][s.largest :], order[s.smallest :]):
            some = list(chosen[: min(s.further, max(len(order) - s.wanted, 0) // 2)])
            vectors = self.basis[: self.size].T @ ritz.coordinates[:, some].to(self.basis)
            residuals = ritz.residuals[some]
            errors = residuals / ritz.gaps()[some]
            found.append(Eigenpairs(ritz.values[some], turned(vectors), residuals, errors, "not asked for"))
        return found[0], found[1]

    def _checked(
        self, ritz: Ritz, vectors: Float[Tensor, "n k"], converged: bool
    ) -> tuple[Float64[Tensor, " k"], Float64[Tensor, " k"]]:
        """Values and residuals of the wanted pairs: from the recurrence, from one product, or from one product each."""
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
        """Residuals of all wanted pairs from one product, which also measures the noise."""
        signs = draw_probes(len(ritz.wanted), 1, self.generator, torch.float64, "rademacher")[:, 0]
        unknown = product(self.operator, (vectors @ signs.to(vectors.dtype))[:, None])[:, 0].double()
        self.matvecs += 1
        known = self.remainders(ritz)
        for i, value in enumerate(ritz.values[ritz.wanted]):
            unknown -= signs[i] * (value * vectors[:, i] + known[:, i])
        self.noise = norm(unknown) / len(signs) ** 0.5
        return torch.tensor([norm(signs[i] * known[:, i] + unknown) for i in range(len(signs))], dtype=torch.float64)

    def remainders(self, ritz: Ritz) -> Float[Tensor, "n k"]:
        """r_i of the wanted pairs (columns), from the recurrence."""
        last = ritz.coordinates[self.size - self.coupling.shape[1] : self.size, ritz.wanted]
        return self.basis[self.size : self.size + self.width].T @ (self.coupling @ last).to(self.basis)


def _mixed(start: Tensor, random: Tensor, noise: float) -> Tensor:
    """The normalised sum of the start vectors' directions, plus `noise` times the direction of the random vector."""
    total = unit_columns(start.reshape(random.numel(), -1).to(random)).sum(dim=1)
    return total / norm(total) + noise * random / norm(random)


def _beyond(n: int, steps: int, spread: float, share: float) -> float:
    """Distance that the spectrum can reach beyond the Ritz values, with probability 0.99 over the random start.

    Kuczynski and Wozniakowski (1992), Theorem 4.2: after m steps the probability that an end is missed by more than the share
    eps of the spectrum's width is at most 1.648 sqrt(n) exp(-sqrt(eps) (2 m - 1)).  With a warm start only this `share` of the
    start's length is random, which multiplies the probability by at most 1 / share: the start is longer, and its component
    along the end is no likelier to be small than that of the random part, whose density is symmetric with its maximum at 0.
    """
    if steps >= n:
        return 0.0
    eps = (log(2 * 1.648 * sqrt(n) / (0.01 * share)) / (2 * steps - 1)) ** 2
    return eps / (1 - 2 * eps) * spread if eps < 0.5 else inf
