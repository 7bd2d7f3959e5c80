"""A row of the study's table: one checkpoint, measured.  Of every training: at its end, and at each of LEVELS that it reached.

All curvature is in the optimiser's units, of D H D with the learning rates of the first step: traces of SAMPLES samples, both
ends to 1% or ENDS products, the participation ratio by a density of DENSITY products.  New poses are the cameras of the views
that were held out, POSES of them spread evenly; their photographs are in psnr_test alone.  A number with draws has _error
beside it (`notebooks.prediction.poses.Measured`); of lambda it is the residual, of the participation ratio _low and _high.
"""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from analysis.measures.units import optimiser_units, scene_size
from landscape import EigenSettings, extreme_eigenpairs, spectral_density
from landscape.operators.operator import LiftedOperator, ScaledOperator
from landscape.spectrum.anisotropy import anisotropy
from landscape.spectrum.density import ActiveSpace
from landscape.traces.trace import total_trace
from notebooks.prediction.fields import field_sharpness
from notebooks.prediction.measures import coadaptation, critical_sharpness, ensemble, open_curvature, order_fragility
from notebooks.prediction.poses import Measured, Poses
from splat import open_subject
from splat.backend.cpu.adam import BETA1
from splat.curvature.block_eigenvectors import BlockEigenvectors
from splat.curvature.hessian import SceneHessian
from splat.curvature.objective import SceneObjective
from splat.curvature.traces import exact_traces
from splat.scenes.splits import spread_views
from splat.training.adam import Adam
from splat.training.checkpoint import load_checkpoint
from splat.training.origin.fingerprint import digest
from splat.training.origin.subject import Subject
from splat.training.score.evaluate import evaluate
from splat.training.state import Training

SAMPLES, ENDS, DENSITY = 8, 150, 64
POSES = 4
LENGTH = 0.01  # correlation of the fields, of the scene's size
Row = dict[str, Any]


def measured_row(path: Path) -> Row:
    """Every column but those of the ensemble.  path: of the checkpoint."""
    subject = open_subject(path)
    training, reference = subject.checkpoint.training, subject.checkpoint.scene
    views = {part: subject.scene.load(names) for part, names in (("train", reference.train), ("test", reference.test))}
    background, config = training.config.background_colour(training.gaussians.flat.dtype), training.config
    psnr = {f"psnr_{part}": evaluate(training.gaussians, some, background, config.render).psnr
            for part, some in views.items()}  # fmt: skip
    objective, new = subject.objective(), new_poses(subject)
    seen = Poses([view.camera for view in views["train"]], background, config.render)
    gaussians, row = training.gaussians, Row(psnr)
    row |= {"step": training.step, "gaussians": len(gaussians)} | curvature(objective, training)
    row |= columns("order_fragility", order_fragility(gaussians, seen, seeded()))
    row |= columns("order_fragility_new", order_fragility(gaussians, new, seeded()))
    field = field_sharpness(gaussians, objective, new, LENGTH * scene_size(objective), seeded())
    row |= columns("field_sharpness", field.loss) | columns("field_sharpness_new", field.images)
    row |= columns("critical_sharpness", along_the_update(objective, training))
    opened, ratio = open_curvature(gaussians, seen, new)
    row |= columns("open_curvature", opened) | {"open_ratio": ratio}
    row |= columns("coadaptation", coadaptation(gaussians, new, seeded()))
    return row | {"digest": subject.checkpoint.state, "scene_digest": scene_digest(subject)}


def ensemble_columns(path: Path, others: list[Path]) -> Row:
    """The columns of the ensemble: with the checkpoints of the same cell's other seeds."""
    subject = open_subject(path)
    trained = [load_checkpoint(each).training.gaussians for each in others]
    found = ensemble(subject.checkpoint.training.gaussians, trained, new_poses(subject))
    return columns("ensemble", found) | {"ensemble_seeds": len(others)}


def scene_digest(subject: Subject) -> str:
    """Of poses, lenses, photographs and masks of all views that the training and its score are of."""
    return digest({name: asdict(view) for name, view in subject.checkpoint.scene.views.items()})


def seeded() -> torch.Generator:
    """The same draws for every checkpoint and measure."""
    return torch.Generator().manual_seed(0)


def columns(name: str, found: Measured) -> Row:
    return {name: found.value, f"{name}_error": found.error}


def new_poses(subject: Subject) -> Poses:
    config, flat = subject.checkpoint.training.config, subject.checkpoint.training.gaussians.flat
    held_out = subject.scene.select(subject.checkpoint.scene.test)
    cameras = [frame.camera for frame in subject.scene.select(spread_views(held_out, POSES))]
    return Poses(cameras, config.background_colour(flat.dtype), config.render)


def curvature(objective: SceneObjective, training: Training) -> Row:
    """Traces, ends and participation ratio of D H D."""
    D, hessian = optimiser_units(objective, training.config.rates, training.extent), SceneHessian(objective)
    traces = exact_traces(objective, seeded(), samples=SAMPLES, scale=D)
    total, means = total_trace(traces), traces["means"]
    P, operator = hessian.projector.scaled(D), ScaledOperator(hessian, D)
    start = BlockEigenvectors(objective, *objective.approximate_blocks, scale=D).warm_start()
    lifted = LiftedOperator(operator, P.apply, seeded())
    ends = extreme_eigenpairs(lifted, seeded(), EigenSettings(rtol=0.01, max_matvecs=ENDS), start)
    density = spectral_density(operator, seeded(), DENSITY, active=ActiveSpace(P.apply, P.rank), ends=ends, trace=total)
    found = anisotropy(ends, density)
    row = columns("trace", Measured(*total)) | columns("trace_means", Measured(means.value, means.standard_error))
    for name, pairs in {"lambda_max": ends.largest, "lambda_min": ends.smallest}.items():
        row |= columns(name, Measured(float(pairs.values[0]), float(pairs.residuals[0])))
    spread = found.participation_ratio
    assert spread is not None  # there is a density
    row |= {"eigenvalue_ratio": found.eigenvalue_ratio.value, "participation_ratio": spread.value}
    return row | {"participation_ratio_low": spread.low, "participation_ratio_high": spread.high}


def along_the_update(objective: SceneObjective, training: Training) -> Measured:
    """Critical sharpness along Adam's next update, with the gradient of all training views for its first moment too.

    Along a momentum of single views the loss need not fall, and the sharpness is then undefined.
    """
    active = training.gaussians.select(objective.mask)  # as stored, quaternions too: the moments are of these
    at, count, gradient = objective.linearizer(active), len(objective.views), torch.zeros_like(active.flat)
    for index in range(count):
        gradient += at(index).gradient / count
    rates = training.gaussians.with_flat(training.rates(training.step)).select(objective.mask).flat
    second, updates = training.adam.second.select(objective.mask), training.adam.updates
    first = active.with_flat(gradient * (1 - BETA1**updates))  # of so many equal gradients
    after = active.flat.clone()
    Adam(first, second, updates).update(after, gradient, rates)
    step = active.flat - after
    return critical_sharpness(objective.loss, active.flat, step, float(gradient.double() @ step.double()))
