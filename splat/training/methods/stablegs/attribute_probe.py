"""Attribute-space probes of StableGS: steps in all five attributes at once, along the gradient or at random.

    tau     sqrt(max(tr H, 0) / dim) of an attribute's block, `splat.curvature.traces.curvature_scale`; for quats on the unit
            sphere, without radial directions, since H_quats scales with 1 / |q|^2
    rho     c / (tau + eps), at most the attribute's cap                                                       Eq. (5)
    rise    of the quadratic model under a random probe, 1/2 E[step H step] = rho^2 tr(H) / 2 = c^2 dim / 2: by the constants
            alone, below the caps and for tr H > 0; for quats with rho per radian a quarter of it.  Where `dose` is "equal",
            each c is reset so that all rises equal their mean.  Not in it: the slope along which means and opacities
            step, the kinks of an l1 loss, the weights of SH bands and the shares of rotations
    g       the gradient of the sampled view's loss, its regularisers included
    v       the unit vector from that view's camera centre to the mean
    means   + rho u,  u the direction of gamma g_depth + (1 - gamma) g_lateral,  g_depth = (g.v) v             Eqs. (7), (8)
    quats   q x exp(omega), omega ~ N(0, rho_i^2 1), rho_i = rho min((kappa - 1) / kappa_full, 1), in radians  Eqs. (9), (10)
    scales  log_scales + delta, delta ~ N(0, rho^2 1)                                                          Eq. (11)
    opacity logit + rho sign(g)                                                                                Eq. (12)
    sh      + w_l e, e ~ N(0, 1) for each coefficient and channel, w_l = rho (1 + l / l_max), rho if l_max = 0 Eq. (13)

Quaternions are w x y z; x is the Hamilton product, exp(omega) = (cos(|omega| / 2), sin(|omega| / 2) omega / |omega|).  kappa is
the condition number of the splat's covariance in the sampled view, with its blur.  A Gaussian outside the view has no kappa
and, but for a regulariser of opacities, g = 0: its mean, quaternion and opacity stay.  Scales and SH of all Gaussians are
probed, as in Eqs. (11) and (13), for renders of the probed copy from other poses.

The step counts as a constant, as in SAM: with Theta' = Theta + step (Eq. (14)), dTheta' / dTheta is the identity, except for
quaternions: there it is right multiplication by exp(omega), an orthogonal matrix.

rho of quats: tr(H_q) is per unit of a unit quaternion, which is two radians.  `rotation_unit` is that of c / (tau + eps);
rho itself is in radians.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from math import inf, isfinite, isqrt, sqrt
from statistics import fmean
from typing import Annotated, Literal

import torch
from jaxtyping import Float, Float64
from msgspec import Meta
from torch import Tensor

from landscape.errors import InputError
from splat.curvature.traces import Dimension, curvature_scale
from splat.model.camera import Camera
from splat.model.gaussians import Gaussians
from splat.model.typed import LARGEST, NonNegative, Positive, Settings, Share, Typed
from splat.projection.reference import NEEDLE, Splats, condition, on_screen

Attribute = Literal["means", "log_scales", "quats", "opacity_logits", "sh"]
Cap = Annotated[float, Meta(gt=0)]
DRAWN = ("quats", "log_scales", "sh")  # attributes with random steps


@dataclass(frozen=True)
class Constants(Settings):
    """c of Eq. (5) for each attribute; 0 switches its probe off."""

    means: NonNegative = 0.01
    log_scales: NonNegative = 0.01
    quats: NonNegative = 0.01
    opacity_logits: NonNegative = 0.01
    sh: NonNegative = 0.01


@dataclass(frozen=True)
class Caps(Settings):
    """The largest rho of each attribute; inf for none.  Uncapped, rho is c / eps where a trace is not positive.

    means: in units of the scene's extent (`splat/training/densify.py`); log_scales: 0.2 is a fifth in size;
    quats: radians; opacity_logits: 0.5 is at most 0.125 in opacity; sh: 0.05 is 0.1 in colour at SH degree 3.
    """

    means: Cap = 0.035
    log_scales: Cap = 0.2
    quats: Cap = 0.05
    opacity_logits: Cap = 0.5
    sh: Cap = 0.05


@dataclass(frozen=True)
class ProbeSettings(Settings):
    """Settings of the probes: c and eps of Eq. (5), caps of rho, gamma of Eq. (8), kappa_full of Eq. (10).

    attributes: those that are probed, if their c is above 0.  dimension: dim of tau (`splat.curvature.traces.curvature_scale`);
    default "attribute": with "active" rho is larger by the root of the number of Gaussians, and at its cap in all but tiny
    scenes.  gamma: 1 for steps of means along the viewing ray, 0.5 along the gradient itself.  dose: each attribute's own c, or
    an equal rise.  rotation_unit: of c / (tau + eps) for quats; the cap is in radians in either.
    """

    attributes: tuple[Attribute, ...] = ("means", "log_scales", "quats", "opacity_logits", "sh")
    c: Constants = field(default_factory=Constants)
    caps: Caps = field(default_factory=Caps)
    dimension: Dimension = "attribute"
    eps: Positive = 1e-6
    gamma: Share = 0.7
    kappa_full: Positive = NEEDLE
    dose: Literal["constants", "equal"] = "constants"
    rotation_unit: Literal["radian", "quaternion"] = "radian"

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(set(self.attributes)) < len(self.attributes):
            raise InputError(f"expected each of the attributes once, got {', '.join(self.attributes)}")

    @property
    def on(self) -> tuple[Attribute, ...]:
        """The attributes that are probed, whose traces are needed: those named with c above 0."""
        return tuple(name for name in self.attributes if getattr(self.c, name) > 0)


@dataclass(frozen=True)
class Magnitude(Typed):
    """The step length rho of an attribute, and how it is computed: trace, tau, and rho of Eq. (5) before its cap."""

    trace: Annotated[float, Meta(ge=-LARGEST, le=LARGEST)]
    tau: NonNegative
    uncapped: NonNegative
    rho: NonNegative

    @property
    def capped(self) -> bool:
        return self.rho < self.uncapped

    @property
    def negative(self) -> bool:
        """Whether the trace is below 0, so that tau is 0."""
        return self.trace < 0


def magnitudes(
    traces: Mapping[str, float], active: int, sh_degree: int, extent: float, settings: ProbeSettings = ProbeSettings()
) -> dict[str, Magnitude]:
    """The magnitude of each probed attribute.

    traces: of the attributes' Hessian blocks (quats: on the unit sphere) over `active` Gaussians.  extent: of the scene, world
    units; the cap of the means is in units of it.  InputError where a trace is missing or not finite.
    """
    if active < 1 or not 0 < extent < inf:
        raise ValueError(f"expected at least 1 active Gaussian and a finite extent above 0, got {active} and {extent}")
    dimensions = {"means": 3, "log_scales": 3, "quats": 3, "opacity_logits": 1, "sh": 3 * (sh_degree + 1) ** 2}
    turn = {"radian": 1.0, "quaternion": 2.0}[settings.rotation_unit]
    c = {name: getattr(settings.c, name) * (turn if name == "quats" else 1) for name in settings.on}
    if settings.dose == "equal" and c:
        # c^2 dim / 2 of steps in the parameters: of a quaternion they are half of the radians
        unit = {name: 0.5 if name == "quats" else 1.0 for name in c}
        rise = fmean((unit[name] * c[name]) ** 2 * dimensions[name] / 2 for name in c)
        c = {name: sqrt(2 * rise / dimensions[name]) / unit[name] for name in c}
    result = {}
    for name in settings.on:
        cap = getattr(settings.caps, name)
        trace = traces.get(name)
        if trace is None or not isfinite(trace):
            raise InputError(f"expected a finite trace of {name}, got {trace}; lower the rates or leave {name} out")
        tau = curvature_scale(trace, dimensions[name] * active, active, settings.dimension)
        rho = c[name] / (tau + settings.eps)
        result[name] = Magnitude(trace, tau, rho, min(rho, cap * extent if name == "means" else cap))
    return result


@dataclass(frozen=True, eq=False)
class Probed:
    """The probed copy of a set of Gaussians (Eq. (14)), off the autograd graph.  turns: exp(omega)."""

    gaussians: Gaussians
    turns: Float[Tensor, "n 4"]

    def pull(self, gradient: Float[Tensor, " p"]) -> Float[Tensor, " p"]:
        """Pull a gradient in the probed parameters back to the original ones, in place.

        For quaternions, with e = exp(omega): (q x e) . p = q . (p x conjugate(e)).
        """
        pulled = self.gaussians.with_flat(gradient)
        pulled.quats.copy_(hamilton(pulled.quats, self.turns * self.turns.new_tensor([1, -1, -1, -1])))
        return gradient


def draw_seeds(generator: torch.Generator) -> list[int]:
    """Seeds of `draw_steps`."""
    return torch.randint(2**63 - 1, (len(DRAWN),), generator=generator).tolist()


def draw_steps(gaussians: Gaussians, names: Collection[str], seeds: Sequence[int]) -> dict[str, Tensor]:
    """Standard normal numbers for the random steps of the named attributes, of quats for omega.

    Each attribute in DRAWN has a generator of its own: what else is probed does not change its numbers.
    """
    shapes = {"quats": gaussians.means, "log_scales": gaussians.log_scales, "sh": gaussians.sh}
    return {
        name: torch.empty_like(shapes[name]).normal_(generator=torch.Generator(gaussians.flat.device).manual_seed(seed))
        for name, seed in zip(DRAWN, seeds, strict=True)
        if name in names
    }


@torch.no_grad()
def probe_attributes(
    gaussians: Gaussians,
    gradient: Float[Tensor, " p"],
    camera: Camera,
    splats: Splats,
    magnitudes: Mapping[str, Magnitude],
    settings: ProbeSettings,
    draws: Mapping[str, Tensor],
    sign: float = 1.0,
) -> Probed:
    """The Gaussians after a step of each attribute by its magnitude; attributes without a magnitude stay.

    camera, gradient, splats: of the sampled view, its loss and its render.  draws: of `draw_steps`; sign: their factor.
    """
    probed = gaussians.with_flat(gaussians.flat.clone())
    value, slope = probed.attributes, gaussians.with_flat(gradient).attributes
    rho = {name: magnitude.rho for name, magnitude in magnitudes.items()}
    omega = torch.zeros_like(probed.means)
    if "means" in rho:
        rays = gaussians.means.double() - camera.centre.to(probed.flat.device)
        value["means"].add_(depth_biased(slope["means"], rays, settings.gamma), alpha=rho["means"])
    if "log_scales" in rho:
        value["log_scales"].add_(draws["log_scales"], alpha=sign * rho["log_scales"])
    if "quats" in rho:
        share = ((condition(splats.conics) - 1) / settings.kappa_full).clamp(0, 1) * on_screen(splats, camera)
        omega.copy_(sign * rho["quats"] * draws["quats"] * share[:, None])
    if "opacity_logits" in rho:
        value["opacity_logits"].add_(slope["opacity_logits"].sign(), alpha=rho["opacity_logits"])
    if "sh" in rho:
        # as rows of 3 k numbers, which takes a quarter of the time
        weights = [1 + isqrt(k // 3) / max(gaussians.sh_degree, 1) for k in range(3 * value["sh"].shape[1])]
        value["sh"].view(-1, len(weights)).addcmul_(
            draws["sh"].view(-1, len(weights)), value["sh"].new_tensor(weights), value=sign * rho["sh"]
        )
    turns = exponential(omega)
    probed.quats.copy_(hamilton(gaussians.quats, turns))
    return Probed(probed, turns)


def depth_biased(gradient: Float[Tensor, "n 3"], rays: Float64[Tensor, "n 3"], gamma: float) -> Float64[Tensor, "n 3"]:
    """Unit vector along gamma g_depth + (1 - gamma) g_lateral, or 0; in float64, where squares of float32 do not underflow."""
    v, gradient = _unit(rays), gradient.double()
    depth = torch.einsum("ni, ni -> n", gradient, v)[:, None] * v
    return _unit(torch.lerp(gradient - depth, depth, gamma))


def _unit(x: Float64[Tensor, "n 3"]) -> Float64[Tensor, "n 3"]:
    """x / |x|, and less where |x|^2 would underflow."""
    return x / x.norm(dim=1, keepdim=True).clamp_min(torch.finfo(x.dtype).tiny ** 0.5)


def exponential(omega: Float[Tensor, "n 3"]) -> Float[Tensor, "n 4"]:
    """exp(omega): the unit quaternions w x y z of rotations by |omega| radians about omega."""
    angle = omega.norm(dim=1, keepdim=True)
    return torch.cat([(angle / 2).cos(), omega * torch.sinc(angle / (2 * torch.pi)) / 2], dim=1)


def hamilton(p: Float[Tensor, "n 4"], q: Float[Tensor, "n 4"]) -> Float[Tensor, "n 4"]:
    """The product p x q of quaternions w x y z; as rotations, q acts first.

    >>> i, j = torch.eye(4)[1:3]
    >>> hamilton(i[None], j[None]).tolist()  # k
    [[0.0, 0.0, 0.0, 1.0]]
    """
    # columns, each in one piece: two thirds of the time
    (a, b, c, d), (w, x, y, z) = (torch.stack(each.unbind(-1)) for each in (p, q))
    return torch.stack(
        [
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        ],
        dim=-1,
    )
