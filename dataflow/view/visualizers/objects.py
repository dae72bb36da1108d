"""Objects in the image and in space: detections, segmentation, boxes, tracks, landmarks."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import rerun as rr

from dataflow.messages import Boxes3D, Detections2D, Keypoints2D, LandmarkSightings, SegmentationMap, Tracks, TrackState
from dataflow.view import colors
from dataflow.view.canvas import Canvas, visualizer
from dataflow.view.visualizers.clouds import finite_rows

MANY_LABELS = 24  # more labels than this are shown only on hovering
_BACKDROP = frozenset(
    ("background", "building", "ceiling", "floor", "ground", "road", "sidewalk", "sky", "terrain", "vegetation", "wall")
)
_BACKDROP_ALPHA = 60  # of 255: the image stays readable
_MASK_ALPHA = 110  # of 255
_FOUND = 0.5
_LIMB = (80, 230, 120)
_RAY = 10.0  # metres: how far a bearing without a range is drawn
_PATH_VERTICES = 200
_STILL = 0.05  # m/s
_UNSEEN = 0.3  # seconds: a track that was not matched for longer leaves the image; where it is has become a guess


@visualizer(Detections2D, "overlay")
def detections_2d(canvas: Canvas, message: Detections2D) -> None:
    """Boxes over the image, coloured by class, labelled with name, identity and score; masks as a layer below."""
    shown = finite_rows(message.boxes)
    names = message.labels()
    _masks(canvas, message, names)
    paint = colors.of_classes([names[i] for i in shown])
    _boxes_2d(canvas, message.boxes[shown], paint, [_scored(message, names, i) for i in shown])


def _masks(canvas: Canvas, message: Detections2D, names: Sequence[str]) -> None:
    """Pixels of objects in their colours, the surest on top; taken away where a message after others has none."""
    if message.masks is None:
        if canvas.scene.remembered.get((canvas.entity, "masked")):
            canvas.clear("overlay/masks")
            canvas.scene.changed(canvas.entity, "masked", False)
        return
    canvas.scene.changed(canvas.entity, "masked", True)
    layer = np.zeros((message.height, message.width, 4), np.uint8)
    for k in np.argsort(message.scores, kind="stable").tolist():
        layer[message.mask(k)] = (*colors.of_class(names[k]), _MASK_ALPHA)
    canvas.draw("overlay/masks", canvas.plane, rr.Image(layer, color_model="RGBA", draw_order=1.0))


@visualizer(Keypoints2D, "overlay")
def keypoints_2d(canvas: Canvas, message: Keypoints2D) -> None:
    """Points over the image and the limbs between them, those that are likelier found than not."""
    sure = np.isfinite(message.points).all(axis=2) & (message.scores >= _FOUND)
    canvas.draw("overlay/limbs", canvas.plane, rr.LineStrips2D(message.limbs(_FOUND), colors=_LIMB))
    points = rr.Points2D(message.points[sure], colors=_LIMB, radii=rr.Radius.ui_points(3))
    canvas.draw("overlay/points", canvas.plane, points)


@visualizer(SegmentationMap, "overlay")
def segmentation_map(canvas: Canvas, message: SegmentationMap) -> None:
    """Classes as a transparent layer in class colours, walls and floors fainter; instances, where known, apart."""
    if message.classes.size == 0:
        canvas.clear("overlay")
        return
    known = range(len(message.class_names)) if message.class_names else np.unique(message.classes).tolist()
    table = canvas.scene.remembered.setdefault((canvas.entity, "classes"), {})
    for index in known:
        name = message.class_names[index] if message.class_names else str(index)
        alpha = _BACKDROP_ALPHA if name.lower() in _BACKDROP else 255
        table[index] = rr.AnnotationInfo(id=index, label=name, color=(*colors.of_class(name), alpha))
    if message.void is not None:
        table[message.void] = rr.AnnotationInfo(id=message.void, label="void", color=(0, 0, 0, 0))
    if canvas.scene.changed(canvas.entity, "annotations", tuple((i, table[i].label) for i in sorted(table))):
        canvas.log("overlay", rr.AnnotationContext([table[i] for i in sorted(table)]), static=True)
    canvas.draw("overlay", canvas.plane, rr.SegmentationImage(message.classes, opacity=0.4, draw_order=1.0))
    if message.instances is not None:
        canvas.draw("instances", canvas.plane, rr.SegmentationImage(message.instances, opacity=0.6))


@visualizer(Boxes3D, "space")
def boxes_3d(canvas: Canvas, message: Boxes3D) -> None:
    """Oriented boxes, coloured by class, with arrows for velocities (one second of travel)."""
    shown = finite_rows(message.centers, message.sizes, message.orientations)
    names = message.labels()
    paint = colors.of_classes([names[i] for i in shown])
    boxes = rr.Boxes3D(
        centers=message.centers[shown],
        half_sizes=message.sizes[shown] / 2,
        quaternions=message.orientations[shown],
        colors=paint,
        labels=[_scored(message, names, i) for i in shown],
        show_labels=len(shown) <= MANY_LABELS,
    )
    canvas.draw("space", message.frame, boxes)
    _velocities(canvas, message.frame, message.centers[shown], message.velocities, shown, paint)


@visualizer(Tracks, "overlay", "space")
def tracks(canvas: Canvas, message: Tracks) -> None:
    """Boxes over the image and in space, coloured by identity and darker while coasting, with their recent paths.

    Boxes over the image go when their track has not been matched for a while.
    """
    alive = np.flatnonzero(message.states != TrackState.ENDED)
    names = message.labels()
    labels = [f"{names[i]} #{message.ids[i]}" for i in range(message.count)]
    paint = colors.of_identities(message.ids.tolist())
    paint[message.states == TrackState.COASTING] //= 2
    if message.boxes is not None:
        shown = alive[np.isin(alive, finite_rows(message.boxes)) & (message.unseen[alive] <= _UNSEEN)]
        _boxes_2d(canvas, message.boxes[shown], paint[shown], [labels[i] for i in shown])
    if message.positions is None:
        return
    shown = alive[np.isin(alive, finite_rows(message.positions))]
    centers = message.positions[shown]
    if message.sizes is not None:
        boxes = rr.Boxes3D(
            centers=centers,
            half_sizes=np.nan_to_num(message.sizes[shown]) / 2,
            quaternions=None if message.orientations is None else message.orientations[shown],
            colors=paint[shown],
            labels=[labels[i] for i in shown],
            show_labels=len(shown) <= MANY_LABELS,
        )
        canvas.draw("space", message.frame, boxes)
    else:
        _points_3d(canvas, message.frame, centers, paint[shown], [labels[i] for i in shown])
    _velocities(canvas, message.frame, centers, message.velocities, shown, paint[shown])
    _track_paths(canvas, message, shown, paint)


@visualizer(LandmarkSightings, "space")
def landmark_sightings(canvas: Canvas, message: LandmarkSightings) -> None:
    """Points; where only the bearing is known, rays of 10 m; where only the range is known, circles."""
    paint = colors.of_identities(message.ids.tolist())
    labels = [f"{message.family} {i}".strip() if i >= 0 else "?" for i in message.ids.tolist()]
    points, ranges, bearings = message.positions, message.ranges, message.bearings
    if points is not None and points.shape[1] == 2:
        points = np.column_stack([points, np.zeros(len(points))])
    strips: list[npt.NDArray[np.float64]] = []
    if points is None and bearings is not None:
        e = np.zeros(message.count) if message.elevations is None else message.elevations
        rays = np.column_stack([np.cos(e) * np.cos(bearings), np.cos(e) * np.sin(bearings), np.sin(e)])
        if ranges is None:
            shown = finite_rows(rays)
            strips = [np.array([np.zeros(3), rays[i] * _RAY]) for i in shown]
        else:
            with np.errstate(invalid="ignore", over="ignore"):
                points = rays * ranges[:, None]
    elif points is None:
        assert ranges is not None  # polar without bearings
        turn = np.linspace(0, 2 * np.pi, 65)
        circle = np.column_stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)])
        shown = finite_rows(ranges)
        strips = [circle * ranges[i] for i in shown]
    if points is None:
        lines = rr.LineStrips3D(strips, colors=paint[shown], labels=[labels[i] for i in shown])
        canvas.draw("space", message.frame, lines)
        return
    shown = finite_rows(points)
    canvas.scene.viewpoint.saw_places(canvas.scene.tree.pose(message.frame), points[shown])
    _points_3d(canvas, message.frame, points[shown], paint[shown], [labels[i] for i in shown])


def _points_3d(
    canvas: Canvas, frame: str, points: npt.NDArray[np.float64], paint: colors.Colors, labels: list[str]
) -> None:
    radius, few = rr.Radius.ui_points(6.0), len(labels) <= MANY_LABELS
    canvas.draw("space", frame, rr.Points3D(points, colors=paint, labels=labels, radii=radius, show_labels=few))


def _boxes_2d(canvas: Canvas, boxes: npt.NDArray[np.float32], paint: colors.Colors, labels: list[str]) -> None:
    drawn = rr.Boxes2D(
        array=boxes.reshape(-1, 4),
        array_format=rr.Box2DFormat.XYXY,
        colors=paint,
        labels=labels,
        show_labels=len(labels) <= MANY_LABELS,
        draw_order=10.0,
    )
    canvas.draw("overlay", canvas.plane, drawn)


def _velocities(
    canvas: Canvas,
    frame: str,
    origins: npt.NDArray[np.float64],
    velocities: npt.NDArray[np.float64] | None,
    shown: npt.NDArray[np.int64],
    paint: colors.Colors,
) -> None:
    if velocities is None:
        return
    vectors = velocities[shown]
    moving = (np.abs(vectors) < 1e4).all(axis=1) & (np.abs(vectors) > _STILL).any(axis=1)
    radius = rr.Radius.ui_points(1.5)
    arrows = rr.Arrows3D(vectors=vectors[moving], origins=origins[moving], colors=paint[moving], radii=radius)
    canvas.draw("space/velocity", frame, arrows)


def _track_paths(canvas: Canvas, message: Tracks, shown: npt.NDArray[np.int64], paint: colors.Colors) -> None:
    assert message.positions is not None
    paths = canvas.scene.track_paths.setdefault(canvas.entity, {})
    if canvas.scene.changed(canvas.entity, "track frame", message.frame):
        paths.clear()
    oldest = message.stamp - canvas.scene.options.track_history
    for i in shown:
        path = paths.setdefault(int(message.ids[i]), deque(maxlen=_PATH_VERTICES))
        path.append((message.stamp, message.positions[i]))
    for identity, path in list(paths.items()):
        while path and (path[0][0] < oldest or path[0][0] > message.stamp):
            path.popleft()
        if not path:
            del paths[identity]
    drawn = [(i, paths[int(message.ids[i])]) for i in shown if len(paths.get(int(message.ids[i]), ())) > 1]
    strips = [np.array([position for _, position in path]) for _, path in drawn]
    lines = rr.LineStrips3D(strips, colors=[paint[i] for i, _ in drawn], radii=rr.Radius.ui_points(1.5))
    canvas.draw("space/paths", message.frame, lines)


def _scored(message: Detections2D | Boxes3D, names: Sequence[str], index: int) -> str:
    """A label such as "chair #3 0.87"; a score of 1 (truth, or an unscored box) is left out."""
    identity = "" if message.ids is None else f" #{message.ids[index]}"
    score = float(message.scores[index])
    return names[index] + identity + (f" {score:.2f}" if np.isfinite(score) and score != 1 else "")
