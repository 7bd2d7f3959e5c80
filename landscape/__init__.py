"""Curvature of any objective from products with its Hessian: traces, eigenpairs, densities, anisotropy, slices.

An estimator takes a `SymmetricOperator` H (products with k vectors at once, V of shape (n, k)) and a `torch.Generator`, and
returns a frozen result that carries its error.  Bad arguments, and products that are not finite, raise
`InputError`, a ValueError; arrays of a wrong shape or type a plain one.

    operators     `ObjectiveHessian` of a torch function, `DenseOperator` of a matrix, and sums, restrictions, ... of these
    renderers     `RendererHessian` of any renderer with a gradient, differentiable only once, and `check_renderer`;
                  `gauss_newton_traces`, ... by its backward passes alone; `renderer_eigenpairs`; `Monitor` of a training
    checks        `check_operator`: is it symmetric, are its products finite?
    estimators    `estimate_traces`, `estimate_diagonal`, `extreme_eigenpairs`, `spectral_density`
    indices       `anisotropy` of ends and a density; `block_anisotropy`: of an operator or a block of it
    slices        `evaluate_slice` along `random_directions`, `gradient_direction`, ...; at finite
                  steps `finite_probe` and `critical_sharpness`
    processes     `Ranks`, `DistributedOperator`
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
