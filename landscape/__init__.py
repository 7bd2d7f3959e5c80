"""Curvature of any objective from products with its Hessian: traces, eigenpairs, densities, anisotropy, slices.

An estimator takes a `SymmetricOperator` H (products with k vectors at once, V of shape (n, k)) and a `torch.Generator`, and
returns a frozen result that carries its error.  Bad arguments, and products that are not finite, raise ValueError.

    operators     `ObjectiveHessian` of a torch function, `DenseOperator` of a matrix, and sums, restrictions, ... of these
    checks        `check_operator`, `check_gradient`, `check_objective`: is it the Hessian?
    estimators    `estimate_traces`, `estimate_diagonal`, `extreme_eigenpairs`, `spectral_density`
    indices       `anisotropy` of ends and a density; `families`: of the whole operator and of each of its blocks
    slices        `evaluate_slice` along `random_directions`, `gradient_direction`, ...; `finite_probe` at finite steps
    processes     `Ranks`, `DistributedOperator`
"""

from landscape.eigen.eigen import EigenSettings, extreme_eigenpairs
from landscape.eigen.lanczos import LanczosFactorization, lanczos
from landscape.eigen.pairs import EigenEnds, Eigenpairs
from landscape.eigen.power import PowerSettings, power_ends, power_iteration
from landscape.operators.block_size import fastest_block
from landscape.operators.checks import DerivativeCheck, OperatorCheck, check_gradient, check_objective, check_operator
from landscape.operators.distributed import DistributedOperator, Ranks
from landscape.operators.objective import ObjectiveHessian
from landscape.operators.operator import (
    CountingOperator,
    DenseOperator,
    ProjectedOperator,
    RestrictedOperator,
    ScaledOperator,
    SumOperator,
    SymmetricOperator,
)
from landscape.results import Bracket, Progress, StopReason
from landscape.slices.directions import gradient_direction, groups_of, line_between, orthonormal, random_directions
from landscape.slices.finite_probe import FiniteProbe, finite_probe
from landscape.slices.refinement import SliceSettings
from landscape.slices.slice import Slice
from landscape.slices.slices import curvature_reach, evaluate_slice, symmetric_axis
from landscape.spectrum.absolute_sum import absolute_sum
from landscape.spectrum.anisotropy import Anisotropy, anisotropy, effective_rank, literal, mass_quantile, saddle, share
from landscape.spectrum.density import ActiveSpace, spectral_density
from landscape.spectrum.families import Family, FamilySettings, Lead, families, family
from landscape.spectrum.quantiles import absolute_quantile, quantile
from landscape.spectrum.rules import SpectralDensity
from landscape.traces.control import PartlyKnown
from landscape.traces.diagonal import DiagonalEstimate, GroupSums, estimate_diagonal
from landscape.traces.estimate import TraceEstimate
from landscape.traces.trace import PAPER, TraceSettings, estimate_traces, total_trace

__all__ = [
    "PAPER",
    "ActiveSpace",
    "Anisotropy",
    "Bracket",
    "CountingOperator",
    "DenseOperator",
    "DerivativeCheck",
    "DiagonalEstimate",
    "DistributedOperator",
    "EigenEnds",
    "EigenSettings",
    "Eigenpairs",
    "Family",
    "FamilySettings",
    "FiniteProbe",
    "GroupSums",
    "LanczosFactorization",
    "Lead",
    "ObjectiveHessian",
    "OperatorCheck",
    "PartlyKnown",
    "PowerSettings",
    "Progress",
    "ProjectedOperator",
    "Ranks",
    "RestrictedOperator",
    "ScaledOperator",
    "Slice",
    "SliceSettings",
    "SpectralDensity",
    "StopReason",
    "SumOperator",
    "SymmetricOperator",
    "TraceEstimate",
    "TraceSettings",
    "absolute_quantile",
    "absolute_sum",
    "anisotropy",
    "check_gradient",
    "check_objective",
    "check_operator",
    "curvature_reach",
    "effective_rank",
    "estimate_diagonal",
    "estimate_traces",
    "evaluate_slice",
    "extreme_eigenpairs",
    "families",
    "family",
    "fastest_block",
    "finite_probe",
    "gradient_direction",
    "groups_of",
    "lanczos",
    "line_between",
    "literal",
    "mass_quantile",
    "orthonormal",
    "power_ends",
    "power_iteration",
    "quantile",
    "random_directions",
    "saddle",
    "share",
    "spectral_density",
    "symmetric_axis",
    "total_trace",
]
