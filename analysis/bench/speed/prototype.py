"""A prototype of the compositing kernels, run from a private copy of its folder, to be measured beside the project's.

The folder holds `rast.py` (`scene(n, width, height)` and `Rast`, one rasterization), `gen.py` (`get(lanes, rows, bits)`
compiles the kernels for that vector), and what those import.  Pixel centres are integers; images are stored by tile.
"""

import importlib
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import numba
import numpy as np

from analysis.bench.workloads import BACKGROUND, TANGENTS, Problem
from splat.backend.cpu.planes import TILE_ROWS
from splat.backend.cpu.simd import REGISTER_BITS, lanes_of
from splat.backend.cpu.threads import thread_count

FILES = ("binning.py", "gen.py", "rast.py", "simd.py", "tmpl.py")
Calls = dict[str, Callable[[], object]]
Getters = dict[str, Callable[[], np.ndarray]]
Results = Callable[[], dict[str, np.ndarray]]


class Prototype:
    """The prototype in a folder.  Raises FileNotFoundError where a part of it is missing."""

    def __init__(self, rast: ModuleType, kernels: Any):
        self._rast, self.kernels = rast, kernels

    def splats(self, count: int, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
        """Its own random scene as splats (n, 9) and depths."""
        means, conics, opacities, colours, depths = self._rast.scene(count, width, height)
        columns = [means + 0.5, conics, opacities[:, None], colours]
        return np.concatenate(columns, axis=1).astype(np.float32), depths

    def stages(self, p: Problem) -> tuple[Calls, Results]:
        """Its stages by the rows of `bench_kernels`, and their results in the project's layout."""
        numba.set_num_threads(thread_count())
        k, size = self.kernels, p.size
        parts = (p.splats[:, :2] - 0.5, p.splats[:, 2:5], p.splats[:, 5], p.splats[:, 6:])
        r = self._rast.Rast(size.width, size.height, *parts, p.depths, np.array(BACKGROUND), k)
        r.bin()
        r.forward()
        by_reached = r.perm
        gradient = r.backward(p.cotangents[0].transpose(1, 2, 0))
        by_entries, sums, threads = np.argsort(-np.diff(r.off), kind="stable"), np.empty((r.E, 9), r.dt), _threads()
        grid, background = (r.ntx, r.nt), r.bg
        binned = (r.mean, r.conic, r.opac, r.depth, r.W, r.H, k.TW, k.TH)

        def binning():
            self._rast.bin_gaussians(*binned)
            r.sched(np.diff(r.off))

        def slots():
            k.compact(r.off, r.gid, r.stopk, r.nt, r.gs2, r.ei2)
            r.sched(np.minimum(np.diff(r.off), r.stopk.max(axis=(1, 2))))

        def forward():
            k.forward(r.P, r.off, r.gid, r.rows, *grid, by_entries, threads, background, r.img, r.Tfin, r.stopk)

        def backward():
            lists = (r.off, r.gid, r.ei2, r.rows, *grid, by_reached, threads, background)
            k.backward(r.P, *lists, r.Tfin, r.stopk, r.g, sums)
            k.reduce_bwd(r.conic, r.opac, r.gs2, sums, r.mom, *gradient)

        calls: Calls = {
            "binning": binning,
            "packing": lambda: k.pack(r.mean, r.conic, r.opac, r.color, r.P),
            "forward": forward,
            "slots": slots,
            "backward + reduce": backward,
        }
        results: Getters = {}
        for K in TANGENTS:
            calls |= self._tangent_stages(p, r, by_reached, K, results)

        def finished() -> dict[str, np.ndarray]:
            image = self._rast.from_tiles(r.img, r.H, r.W, k.L, k.TH).transpose(2, 0, 1)
            return {"forward": image, "backward + reduce": _columns(gradient), **{n: f() for n, f in results.items()}}

        return calls, finished

    def _tangent_stages(
        self, p: Problem, r: Any, order: np.ndarray, K: int, results: dict[str, Callable[[], np.ndarray]]
    ) -> Calls:
        k, threads = self.kernels, _threads()
        d = np.ascontiguousarray(p.directions[:, :K].transpose(1, 0, 2))
        r.jvp(d[..., :2], d[..., 2:5], d[..., 5], d[..., 6:])
        r.hvp(p.cotangents[1 : 1 + K].transpose(0, 2, 3, 1))
        directions = [np.ascontiguousarray(part) for part in r.u]
        packed, planes, transmittances = r.Q, r.dimg, r.dTf
        cotangents = np.stack(
            [self._rast.to_tiles(c.transpose(1, 2, 0), k.L, k.TH, r.dt) for c in p.cotangents[1 : 1 + K]]
        )
        sums = np.empty((r.E, K, 9), r.dt)
        product = [np.empty((K, r.N, *rest), r.dt) for rest in ((2,), (3,), (), (3,))]
        tangent, curvature = (k.jvp1, k.hvp1) if K == 1 else (k.jvp, k.hvp)
        grid = (r.ntx, r.nt, order, threads, r.bg)

        def image() -> np.ndarray:
            return np.stack([self._rast.from_tiles(x, r.H, r.W, k.L, k.TH).transpose(2, 0, 1) for x in planes])

        results[f"J u {K}"] = image
        results[f"reduce {K}"] = lambda: np.stack([_columns([part[i] for part in product]) for i in range(K)], axis=1)
        return {
            f"tangents {K}": lambda: k.pack_tan(r.conic, r.opac, *directions, packed),
            f"J u {K}": lambda: tangent(r.P, packed, r.off, r.gid, r.rows, *grid, r.stopk, planes, transmittances),
            f"tangent of backward {K}": lambda: curvature(
                r.P, packed, r.off, r.gid, r.ei2, r.rows, *grid, r.Tfin, r.stopk, r.g, transmittances, cotangents, sums
            ),
            f"reduce {K}": lambda: k.reduce_hvp(r.conic, r.opac, r.gs2, sums, r.mom, *directions[:3], *product),
        }


def _threads() -> int:
    return numba.get_num_threads()


def _columns(parts: list[np.ndarray] | tuple[np.ndarray, ...]) -> np.ndarray:
    return np.concatenate([part.reshape(len(part), -1) for part in parts], axis=1)


@contextmanager
def prototype_in(folder: Path) -> Iterator[Prototype]:
    """Load a prototype from a copy of its folder (it writes modules beside itself), which is removed in the end."""
    missing = [name for name in FILES if not (folder / name).is_file()]
    if missing:
        raise FileNotFoundError(f"expected a prototype's {', '.join(FILES)} in {folder}, found no {missing[0]} there")
    before, path = set(sys.modules), list(sys.path)
    with tempfile.TemporaryDirectory(prefix="landscape-prototype-") as copy:
        for file in folder.glob("*.py"):
            shutil.copy(file, copy)
        sys.path.insert(0, copy)
        try:
            portable = {} if REGISTER_BITS == 512 else {"exp": "vexp2_port", "rcp": "vrcp_div"}
            kernels = importlib.import_module("gen").get(lanes_of(np.float32), TILE_ROWS, 32, **portable)
            yield Prototype(importlib.import_module("rast"), kernels)
        finally:
            sys.path[:] = path
            for name in set(sys.modules) - before:
                if str(getattr(sys.modules[name], "__file__", "")).startswith(copy):
                    del sys.modules[name]
