"""Kernels for NVIDIA GPUs, in Triton: all that names it.  Loaded by `device_named`; loading registers `Backend` for CUDA."""

from splat.gpu.backend import CUDA
from splat.render.backend import BACKENDS

BACKENDS["cuda"] = CUDA
