"""Render a height field off-screen with PyVista: `python -m figures.render_surface FIELD.npz OUT.png`.

A program of its own: where a machine has no usable OpenGL, VTK may end the process that renders.  FIELD.npz holds
`height` [nx, ny] in [0, 1], nan where there is none, `dots` [nx, ny], the points to mark, `colour` [256, 3] as bytes, and
`levels`, the heights of the contour lines.  The scene is a `Box`, seen from `eye` in parallel projection.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splat.model.untrusted import read_arrays


@dataclass(frozen=True, eq=False)
class Box:
    """x, y in [-1, 1], z in [0, TOP], and the camera, whose image is EXTENT wide and high."""

    eye: np.ndarray

    TOP = 1.0
    TARGET = np.array([0.0, 0.0, 0.4])
    EXTENT = 3.2
    PIXELS = 900

    def project(self, points: np.ndarray) -> np.ndarray:
        """Points [..., 3] of the scene to [..., 2] of the image, (0, 0) its lower left corner, (1, 1) the opposite."""
        forward = -self.eye / np.linalg.norm(self.eye)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        up = np.cross(right, forward)
        return 0.5 + (np.asarray(points) - self.TARGET) @ np.stack([right, up], axis=1) / self.EXTENT


def render(
    height: np.ndarray, dots: np.ndarray, colour: np.ndarray, levels: np.ndarray, eye: np.ndarray, out: Path
) -> None:
    """Write the picture of the surface with its contour lines, and the lines once more on the floor, on white."""
    import pyvista as pv
    from matplotlib.colors import ListedColormap

    x, y = np.meshgrid(np.linspace(-1, 1, height.shape[0]), np.linspace(-1, 1, height.shape[1]), indexing="ij")
    grid = pv.StructuredGrid(x, y, np.nan_to_num(height) * Box.TOP)
    grid["height"] = height.ravel(order="F")
    surface = grid.threshold([0.0, 1.0], scalars="height", all_scalars=True).extract_surface(
        algorithm="dataset_surface"
    )
    plotter = pv.Plotter(off_screen=True, window_size=[Box.PIXELS, Box.PIXELS])
    plotter.background_color = pv.Color("white")
    plotter.enable_anti_aliasing("ssaa")
    plotter.add_mesh(
        surface, scalars="height", cmap=ListedColormap(colour / 255.0), clim=[0, 1], smooth_shading=True,
        ambient=0.35, diffuse=0.7, specular=0.1, show_scalar_bar=False,
    )  # fmt: skip
    lines = surface.contour(levels.tolist(), scalars="height") if len(levels) else pv.PolyData()
    if lines.n_points:
        plotter.add_mesh(lines.translate([0, 0, 0.004]), color="black", line_width=2)
        plotter.add_mesh(lines.scale([1, 1, 0]), color="#808080", line_width=2)
    marked = dots & np.isfinite(height)
    if marked.any():
        places = np.stack([x[marked], y[marked], height[marked] * Box.TOP + 0.006], axis=1)
        plotter.add_mesh(pv.PolyData(places), color="black", point_size=8, render_points_as_spheres=True)
    plotter.camera.parallel_projection = True
    plotter.camera.position = tuple(Box.TARGET + 10 * eye)
    plotter.camera.focal_point = tuple(Box.TARGET)
    plotter.camera.up = (0, 0, 1)
    plotter.camera.parallel_scale = Box.EXTENT / 2
    plotter.camera.clipping_range = (1, 100)
    plotter.screenshot(str(out))
    plotter.close()


if __name__ == "__main__":
    if len(sys.argv) != 3:
        print("expected FIELD.npz OUT.png; to draw a record: python -m figures.surface RUN/probe", file=sys.stderr)
        sys.exit(2)
    field = read_arrays(Path(sys.argv[1]))
    render(field["height"], field["dots"], field["colour"], field["levels"], field["eye"], Path(sys.argv[2]))
