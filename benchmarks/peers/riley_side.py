"""riley-raster for a plane mesh, with one sample in each pixel, as in modeharvest."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import riley
from meshes import MeshView
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Render = Callable[[], FloatArray]

BACKGROUND = -1e6
"""Value where there is no material, far from those of all fields."""
_MESH_TYPE = {"T3": "tri3", "T6": "tri6", "Q4": "quad4", "Q8": "quad8", "Q9": "quad9"}


def nodal(view: MeshView, field: FloatArray, threads: int) -> Render:
    """Make a renderer of a nodal field (n, 1) or (n, 3), which gives (fields, rows, cols)."""
    shader = riley.NodalShader(field=field[:, None, :], scaling_type=riley.ScaleStrategy.none)
    return _renderer(view, shader, threads)


def textured(view: MeshView, texture: NDArray[np.generic], sample: str, threads: int) -> Render:
    """Make a renderer of a texture that covers the grid from its first to its last pixel centre.

    ``sample`` is one of riley's names of a TextureSample.
    """
    row, col = view.grid.to_px(*view.mesh.nodes.T)
    uvs = np.column_stack([col / (view.grid.cols - 1), row / (view.grid.rows - 1)])
    how = riley.TextureSample[sample]
    return _renderer(view, riley.TextureShader(uvs, texture[None], sample=how), threads)


def _renderer(view: MeshView, shader: riley.Shader, threads: int) -> Render:
    name = _MESH_TYPE[view.mesh.element]
    convention = riley.ConnectConvention(
        riley.EElemType(name), riley.EConnectAxis.ROW, 0, riley.ENodeOrder.VTK
    )
    coords = np.column_stack([view.deformed, np.zeros(len(view.deformed))])
    mesh = riley.create_mesh(convention, riley.MeshType[name], coords, view.mesh.cells, shader)
    camera = _camera(view)
    config = riley.RasterConfig(
        parallel=threads,
        save_strategy=riley.SaveStrategy.memory,
        save_scaling=riley.ScaleStrategy.none,
        report=riley.ReportMode.off,
        background_value=BACKGROUND,
    )

    def render() -> FloatArray:
        image = riley.raster(mesh, camera, config)
        return np.asarray(image[0, 0])

    return render


def _camera(view: MeshView) -> riley.Camera:
    """A pinhole camera straight above the plane, whose pixels are those of the grid."""
    grid = view.grid
    x = grid.x0 + 0.5 * (grid.cols - 1) * grid.pixel_size
    y = grid.y0 - 0.5 * (grid.rows - 1) * grid.pixel_size
    return riley.Camera(
        pixels_num=(grid.cols, grid.rows),
        pixels_size=(grid.pixel_size, grid.pixel_size),
        pos_world=(x, y, 1.0),
        rot_world=(0.0, 0.0, 0.0),
        roi_cent_world=(x, y, 0.0),
        focal_length=1.0,
        sub_sample=1,
    )
