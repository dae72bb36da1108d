"""Maps: occupancy grids, rooms, meshes, planes."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import rerun as rr

from dataflow.messages import Mesh, OccupancyGrid, Planes, Rooms
from dataflow.messages.geometry import matrix_to_quaternion, transform_points
from dataflow.view import colors
from dataflow.view.canvas import Canvas, visualizer
from dataflow.view.visualizers.clouds import finite_rows

_UNBOUNDED = 2.0  # metres: side of the square that stands for a plane without an extent
_NORMAL = 0.3  # metres
_DOOR = (255, 205, 70)
_LIFT = 0.02  # metres: rooms are drawn above the floor that they lie on
_SHEER = 90  # opacity of planes, of 255


@visualizer(OccupancyGrid, "space")
def occupancy_grid(canvas: Canvas, message: OccupancyGrid) -> None:
    """The grid lying in its plane: white free, black occupied, green-grey unknown (RViz's map colours)."""
    height, width = message.cells.shape
    if height == 0 or width == 0:
        canvas.clear("space")
        return
    image = message.cells[::-1].view(np.uint8)  # an image's first row is the top one; the grid's lies at the origin
    grid = rr.GridMap(
        data=image.tobytes(),
        format=rr.components.ImageFormat(width=width, height=height, color_model="L", channel_datatype="U8"),
        cell_size=message.resolution,
        translation=message.position,
        quaternion=rr.Quaternion(xyzw=(0.0, 0.0, 0.0, 1.0) if message.orientation is None else message.orientation),
        colormap=rr.components.Colormap.RvizMap,
        opacity=0.45,
    )
    canvas.draw("space", message.frame, grid)


@visualizer(Rooms, "space")
def rooms(canvas: Canvas, message: Rooms) -> None:
    """The floor of each room in its own colour, with its area; doors as points with their widths."""
    if not message.count or not (message.cells >= 0).any():
        canvas.clear("space")
        canvas.clear("space/places")
        return
    corners, own = _runs(message.cells)
    flat = np.column_stack([corners * message.resolution, np.full(len(corners), _LIFT)])
    floors = rr.Mesh3D(
        vertex_positions=transform_points(message.matrix(), flat),
        triangle_indices=(np.arange(0, len(corners), 4)[:, None, None] + [[0, 1, 2], [0, 2, 3]]).reshape(-1, 3),
        vertex_colors=np.repeat(colors.of_identities(message.ids[own].tolist()), 4, axis=0),
        albedo_factor=(255, 255, 255, _SHEER),  # the opacity of single corners is not drawn
    )
    canvas.draw("space", message.frame, floors)
    names = [f"room {i}: {area:.1f} m²" for i, area in zip(message.ids.tolist(), message.areas.tolist(), strict=True)]
    doors = [f"door {width:.2f} m" for width in message.door_widths.tolist()]
    paint = np.concatenate([colors.of_identities(message.ids.tolist()), np.tile(_DOOR, (len(doors), 1))])
    places = rr.Points3D(
        np.concatenate([message.centers, message.door_positions]),
        colors=paint.astype(np.uint8),
        labels=[*names, *doors],
        radii=rr.Radius.ui_points(3.0),
        show_labels=True,
    )
    canvas.draw("space/places", message.frame, places)


@visualizer(Mesh, "space")
def mesh(canvas: Canvas, message: Mesh) -> None:
    """The triangles, in the vertices' colours or grey."""
    bad = np.flatnonzero(~np.isfinite(message.vertices).all(axis=1))
    triangles = message.triangles[~np.isin(message.triangles, bad).any(axis=1)]
    if not len(triangles):
        canvas.clear("space")
        return
    drawn = rr.Mesh3D(
        vertex_positions=np.nan_to_num(message.vertices),
        triangle_indices=triangles,
        vertex_normals=None if message.normals is None else np.nan_to_num(message.normals),
        vertex_colors=message.colors,
        albedo_factor=None if message.colors is not None else (*colors.NEUTRAL, 255),
    )
    canvas.draw("space", message.frame, drawn)


@visualizer(Planes, "space")
def planes(canvas: Canvas, message: Planes) -> None:
    """The hull or the rectangle seen of each plane, else a square where it comes nearest to the origin; and normals."""
    paint = colors.of_identities(list(range(message.count)))
    normals = message.coefficients[:, :3]
    if message.centers is not None and message.orientations is not None and message.extents is not None:
        shown = finite_rows(message.centers, message.orientations, message.extents)
        centers, turned, extents = message.centers[shown], message.orientations[shown], message.extents[shown]
    else:
        shown = finite_rows(message.coefficients)
        centers = -normals[shown] * message.coefficients[shown, 3:]
        turned = np.array([matrix_to_quaternion(_basis(n)) for n in normals[shown]]).reshape(-1, 4)
        extents = np.full((len(shown), 2), _UNBOUNDED)
    if message.hulls is not None:
        _hulls(canvas, message, paint)
    else:
        sheets = rr.Boxes3D(
            centers=centers,
            half_sizes=np.column_stack([extents / 2, np.full(len(shown), 0.002)]),
            quaternions=turned,
            colors=np.column_stack([paint[shown], np.full(len(shown), _SHEER, np.uint8)]),
            fill_mode=rr.components.FillMode.Solid,
        )
        canvas.draw("space", message.frame, sheets)
    arrows = rr.Arrows3D(origins=centers, vectors=normals[shown] * _NORMAL, colors=paint[shown])
    canvas.draw("space/normals", message.frame, arrows)


def _runs(cells: npt.NDArray[np.int32]) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.intp]]:
    """Returns the rectangles of cells of one room that lie side by side in a row: corners (4 N, 2), x and y in cells,
    and the room (N,) of each."""
    edges = np.diff(np.pad(cells, ((0, 0), (1, 1)), constant_values=-1), axis=1) != 0
    rows, begins = np.nonzero(edges & np.pad(cells >= 0, ((0, 0), (0, 1))))
    _, ends = np.nonzero(edges & np.pad(cells >= 0, ((0, 0), (1, 0))))
    low, high = np.stack([begins, rows], axis=1), np.stack([ends, rows + 1], axis=1)
    around = [low, np.stack([high[:, 0], low[:, 1]], axis=1), high, np.stack([low[:, 0], high[:, 1]], axis=1)]
    return np.stack(around, axis=1).reshape(-1, 2).astype(np.float64), cells[rows, begins].astype(np.intp)


def _hulls(canvas: Canvas, message: Planes, paint: npt.NDArray[np.uint8]) -> None:
    """Draws the hulls as sheets of triangles around their first corner, and their edges."""
    hulls = [message.hull(k) for k in range(message.count)]
    drawn = [k for k, hull in enumerate(hulls) if len(hull) > 2 and np.isfinite(hull).all()]
    if not drawn:
        canvas.clear("space")
        canvas.clear("space/edges")
        return
    sizes = np.array([len(hulls[k]) for k in drawn])
    starts = np.cumsum(sizes) - sizes
    fans = [start + np.array([[0, i, i + 1] for i in range(1, n - 1)]) for start, n in zip(starts, sizes, strict=True)]
    sheets = rr.Mesh3D(
        vertex_positions=np.concatenate([hulls[k] for k in drawn]),
        triangle_indices=np.concatenate(fans),
        vertex_colors=np.repeat(paint[drawn], sizes, axis=0),
        albedo_factor=(255, 255, 255, _SHEER),  # the opacity of single corners is not drawn
    )
    canvas.draw("space", message.frame, sheets)
    edges = [np.vstack([hulls[k], hulls[k][:1]]) for k in drawn]
    canvas.draw("space/edges", message.frame, rr.LineStrips3D(edges, colors=paint[drawn]))


def _basis(normal: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """A rotation (3, 3) whose z axis is `normal`."""
    helper = np.eye(3)[int(np.argmin(np.abs(normal)))]
    x = np.cross(helper, normal)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(normal, x), normal])
