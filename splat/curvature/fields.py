"""Numbers of each Gaussian that say where a scene's loss is curved: from its own block of the Hessian, and from the views.

B is the 11 x 11 block of a Gaussian's geometry and opacity in the Hessian H of the mean loss, or in its Gauss-Newton part G.
The length of a quaternion is a null direction of the image, so B is taken on its complement of 10 dimensions: E^T B E with
orthonormal E.  All of stored parameters: positions in world units, log-scales, unit quaternions, opacity logits, SH.

    eigenvalues           of E^T B E; `largest` is the greatest with its sign
    log-determinant       sum of ln |lambda| over those with |lambda| > 10 eps max |lambda|, eps of the parameters' precision;
                          `rank` says how many these are (a Gaussian that few views see has fewer than 10), `negative` how many
                          of them are below 0
    depth, lateral        v^T B v and (tr B - v^T B v) / 2 of the position's 3 x 3, v the mean direction of the rays from the
                          views that see it
    split                 the least eigenvalue of E^T (H - G) E, the curvature that splitting the Gaussian in two makes use of
                          (Liu, Wu and Wang 2019): below 0 a split in its direction lowers the loss
    views, pixels         views that give it weight, and pixels of all of them
    weight                sum of alpha T over these pixels, px; `one_view`: the share of it in the view that has most
    condition             of the splat's covariance, the largest of the views that see it
    order_gap             the least way along a ray, px, that changes its place with the next in front of it (`Sight.gap`)
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float, Float64
from torch import Tensor

from landscape.results import Progress
from splat.backend.cpu.threads import over_batch
from splat.curvature.gaussian_blocks import GEOMETRY_COLUMNS, PerGaussianBlocks
from splat.curvature.objective import SceneObjective
from splat.render.sight import Sight, sight

Values = dict[str, Float64[Tensor, " n"]]
PER_UNIT = {
    "means": "per world unit²", "log_scales": "per log unit²", "quats": "per quaternion unit²", "opacity_logits": "per logit²",
    "sh": "per SH unit²",
}  # fmt: skip
WORDS = {"means": "position", "log_scales": "scale", "quats": "rotation", "opacity_logits": "opacity", "sh": "colour"}
PREFIXES = ("", "gn_")
MIXED = "per unit² of the parameters"


@dataclass(frozen=True)
class Field:
    """A field in words; its unit, empty where it has none; scale: as a picture shows it; log: of positive numbers, signed:
    about 0."""

    words: str
    unit: str
    scale: Literal["log", "signed", "linear"]


OF_BLOCKS = {
    **{f"trace_{name}": Field(f"trace of {WORDS[name]}", unit, "signed") for name, unit in PER_UNIT.items()},
    "largest": Field("largest curvature", MIXED, "log"),
    "log_det": Field("log-determinant", "ln of units of the parameters", "linear"),
    "rank": Field("rank of the block", "of 10", "linear"),
    "negative": Field("negative curvatures of the block", "of 10", "linear"),
    "depth": Field("curvature along the ray", PER_UNIT["means"], "signed"),
    "lateral": Field("curvature across the ray", PER_UNIT["means"], "signed"),
}
OF_VIEWS = {
    "views": Field("views that see it", "", "linear"),
    "pixels": Field("pixels that see it", "", "log"),
    "weight": Field("weight in the images", "px", "log"),
    "one_view": Field("share of its weight in one view", "", "linear"),
    "condition": Field("condition of its splat", "(long : short axis)²", "log"),
    "order_gap": Field("distance along the ray to the next in front", "px", "log"),
}
FIELDS = {
    **OF_BLOCKS,
    **{f"gn_{name}": replace(field, words=f"{field.words} (Gauss-Newton)") for name, field in OF_BLOCKS.items()},
    "split": Field("least curvature of Hessian minus Gauss-Newton", MIXED, "signed"),
    **OF_VIEWS,
}


def scene_fields(objective: SceneObjective, progress: Progress | None = None) -> tuple[Values, list[Sight]]:
    """Every field of the active Gaussians, on the CPU, and how each view sees them; a pass over the pixels for each view.

    InputError on a GPU.

    >>> from splat import SceneObjective, SyntheticSettings, synthetic_scene
    >>> made = synthetic_scene(SyntheticSettings(gaussians=50, views=2, width=16, height=12))
    >>> objective = SceneObjective(made.truth, made.scene.load())
    >>> fields, sights = scene_fields(objective)
    >>> fields.keys() == FIELDS.keys(), len(sights), bool((fields["views"] >= 1).all())
    (True, 2, True)
    """
    gaussians = objective.active
    sights = [sight(gaussians, view.camera, objective.settings) for view in objective.views]
    hessian, gauss_newton = objective.block_diagonals(progress=progress)
    rays = mean_rays(objective, sights)
    found = block_fields(hessian, gauss_newton, gaussians.quats, rays, gaussians.flat.dtype) | sight_fields(sights)
    return {name: found[name] for name in FIELDS}, sights


def mean_rays(objective: SceneObjective, sights: Sequence[Sight]) -> Float64[Tensor, "n 3"]:
    """The unit mean of the rays' directions from the views that see each active Gaussian."""
    means = objective.active.means.double()
    rays = torch.zeros_like(means)
    for view, seen in zip(objective.views, sights, strict=True):
        rays += F.normalize(means - view.camera.centre, dim=1) * seen.seen[:, None]
    return F.normalize(rays, dim=1)


def block_fields(
    hessian: PerGaussianBlocks,
    gauss_newton: PerGaussianBlocks,
    quats: Float[Tensor, "n 4"],
    rays: Float64[Tensor, "n 3"],
    precision: torch.dtype,
) -> Values:
    """The fields of the blocks.  quats: of unit length; precision: in which the blocks were computed."""
    found: Values = {}
    across = [on_complement(blocks.geometry.double(), quats.double()) for blocks in (hessian, gauss_newton)]
    for prefix, blocks, B in zip(PREFIXES, (hessian, gauss_newton), across, strict=True):
        for name, diagonal in blocks.diagonals_across(quats).items():
            found[f"{prefix}trace_{name}"] = diagonal.flatten(1).sum(dim=1)
        values = eigenvalues(B)
        size = values.abs()
        kept = size > len(values[0]) * torch.finfo(precision).eps * size.amax(dim=1, keepdim=True)
        found[f"{prefix}largest"] = values[:, -1]
        found[f"{prefix}log_det"] = torch.where(kept, size, torch.ones_like(size)).log().sum(dim=1)
        found[f"{prefix}rank"] = kept.sum(dim=1).double()
        found[f"{prefix}negative"] = (kept & (values < 0)).sum(dim=1).double()
        position = blocks.geometry[:, :3, :3].double()
        depth = torch.einsum("ni,nij,nj->n", rays, position, rays)
        found[f"{prefix}depth"] = depth
        found[f"{prefix}lateral"] = (found[f"{prefix}trace_means"] - depth) / 2
    found["split"] = eigenvalues(across[0] - across[1])[:, 0]
    return found


def sight_fields(sights: Sequence[Sight]) -> Values:
    """The fields that tell how the views see each Gaussian."""
    weight = torch.stack([each.weight for each in sights])
    total = weight.sum(dim=0)
    return {
        "views": torch.stack([each.seen for each in sights]).sum(dim=0).double(),
        "pixels": torch.stack([each.pixels for each in sights]).sum(dim=0).double(),
        "weight": total,
        "one_view": weight.amax(dim=0) / total.clamp_min(torch.finfo(total.dtype).tiny),
        "condition": torch.stack([each.condition for each in sights]).amax(dim=0),
        "order_gap": torch.stack([each.gap for each in sights]).amin(dim=0),
    }


def on_complement(blocks: Float64[Tensor, "n 11 11"], quats: Float64[Tensor, "n 4"]) -> Float64[Tensor, "n 10 10"]:
    """E^T B E."""
    E = complement(quats)
    return E.mT @ blocks @ E


def complement(quats: Float64[Tensor, "n 4"]) -> Float64[Tensor, "n 11 10"]:
    """E: q i, q j, q k in place of the quaternion's four axes."""
    w, x, y, z = quats.unbind(dim=1)
    turns = torch.stack([-x, -y, -z, w, -z, y, z, w, -x, -y, x, w], dim=1).view(-1, 4, 3)
    columns = GEOMETRY_COLUMNS["quats"]
    E = torch.zeros(len(quats), 11, 10, dtype=quats.dtype)
    E[:, : columns.start, : columns.start] = torch.eye(columns.start, dtype=quats.dtype)
    E[:, columns, columns.start : columns.start + 3] = turns
    E[:, columns.stop, columns.start + 3] = 1
    return E


def eigenvalues(matrices: Float64[Tensor, "n d d"]) -> Float64[Tensor, "n d"]:
    """Ascending."""
    values = matrices.new_empty(matrices.shape[:2])

    def part(start: int, stop: int) -> None:
        values[start:stop] = torch.linalg.eigvalsh(matrices[start:stop])

    over_batch(len(matrices), part, matrices.device)
    return values
