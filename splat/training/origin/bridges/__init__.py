"""The loss landscape of Gaussians as another tool's objects, through its own renderer (`landscape.RendererHessian`).

Parameters are taken as they are stored.  Quaternions may so have any length: curvature in one of length q is 1/q^2 of that at
length 1, where `landscape probe` measures.
"""
