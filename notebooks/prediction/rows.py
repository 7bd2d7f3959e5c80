"""A row of the study's table: one checkpoint, measured.  Of every training: at its end, and at each of LEVELS that it reached.

All curvature is in the optimiser's units, of D H D with the learning rates of the first step: traces of SAMPLES samples, both
ends to 1% or ENDS products, the participation ratio by a density of DENSITY products.  What is not curvature
is of `analysis.probe.measures`; photographs of the views that were held out are in psnr_test alone.  A number with draws has
_error beside it (`landscape.results.Measured`); of lambda it is the residual, of the participation ratio _low and _high.
"""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from analysis.measures.units import optimiser_units
from analysis.probe.measures import measures, new_poses
from analysis.records.tables import columns_of
from landscape import EigenSettings, extreme_eigenpairs, spectral_density
from landscape.operators.operator import LiftedOperator, ScaledOperator
from landscape.spectrum.anisotropy import anisotropy
from landscape.spectrum.density import ActiveSpace
from landscape.traces.trace import total_trace
from notebooks.prediction.measures import coadaptation, ensemble
from splat import open_subject
from splat.curvature.block_eigenvectors import BlockEigenvectors
from splat.curvature.hessian import SceneHessian
from splat.curvature.objective import SceneObjective
from splat.curvature.traces import exact_traces
from splat.training.checkpoint import load_checkpoint
from splat.training.origin.fingerprint import digest
from splat.training.origin.subject import Subject
from splat.training.score.evaluate import evaluate
from splat.training.state import Training

SAMPLES, ENDS, DENSITY = 8, 150, 64
Row = dict[str, Any]


def measured_row(path: Path) -> Row:
    """Every column but those of the ensemble.  path: of the checkpoint."""
    subject = open_subject(path)
    training, reference = subject.checkpoint.training, subject.checkpoint.scene
    views = {part: subject.scene.load(names) for part, names in (("train", reference.train), ("test", reference.test))}
    background, config = training.config.background_colour(training.gaussians.flat.dtype), training.config
    psnr = {f"psnr_{part}": evaluate(training.gaussians, some, background, config.render).psnr
            for part, some in views.items()}  # fmt: skip
    objective, gaussians, row = subject.objective(), training.gaussians, Row(psnr)
    row |= {"step": training.step, "gaussians": len(gaussians)} | curvature(objective, training)
    row |= columns_of(measures(subject, objective))
    row |= columns_of({"coadaptation": coadaptation(gaussians, new_poses(subject), seeded())})
    return row | {"digest": subject.checkpoint.state, "scene_digest": scene_digest(subject)}


def ensemble_columns(path: Path, others: list[Path]) -> Row:
    """The columns of the ensemble: with the checkpoints of the same cell's other seeds."""
    subject = open_subject(path)
    trained = [load_checkpoint(each).training.gaussians for each in others]
    found = ensemble(subject.checkpoint.training.gaussians, trained, new_poses(subject))
    return columns_of({"ensemble": found}) | {"ensemble_seeds": len(others)}


def scene_digest(subject: Subject) -> str:
    """Of poses, lenses, photographs and masks of all views that the training and its score are of."""
    return digest({name: asdict(view) for name, view in subject.checkpoint.scene.views.items()})


def seeded() -> torch.Generator:
    """The same draws for every checkpoint and measure."""
    return torch.Generator().manual_seed(0)


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
    row: Row = columns_of({"trace": total, "trace_means": (means.value, means.standard_error)})
    for name, pairs in {"lambda_max": ends.largest, "lambda_min": ends.smallest}.items():
        row |= columns_of({name: (float(pairs.values[0]), float(pairs.residuals[0]))})
    spread = found.participation_ratio
    assert spread is not None  # there is a density
    row |= {"eigenvalue_ratio": found.eigenvalue_ratio.value, "participation_ratio": spread.value}
    return row | {"participation_ratio_low": spread.low, "participation_ratio_high": spread.high}
