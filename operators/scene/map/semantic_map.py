"""The map of objects and surfaces as an operator."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path as FilePath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import (
    Boxes3D,
    CameraInfo,
    Clusters,
    Detections2D,
    Diagnostics,
    Odometry,
    Path,
    PointCloud,
    Pose,
    SceneGraph,
    Transforms,
)
from dataflow.messages.diagnostics import Level
from dataflow.messages.geometry import invert, quaternion_from_yaw, transform_points
from dataflow.operator import Counts, In, Operator, Out, Param, Sampled
from operators.cloud.filtering import in_range
from operators.geometry.depth_sensors import DEPTH_SENSOR, read_depth_sensor
from operators.geometry.extrinsics import transform_between
from operators.labels import LabelSpace, labels_file
from operators.labels.label_space import warn_of_unknown
from operators.scene.map.class_priors import ClassPriors
from operators.scene.map.cuboid import ImageView
from operators.scene.map.file import LearnedFile, SavedMap, learned_files, together
from operators.scene.map.map_object import MapObject
from operators.scene.map.matching import MapSettings, Observation
from operators.scene.map.nodes import nodes_of, seen_surfaces
from operators.scene.map.object_map import ObjectMap
from operators.scene.map.range_view import RangeView
from operators.scene.map.surface_map import SurfaceMap
from operators.scene.map.trajectory import Trajectory
from operators.status import counted_status

_BORDER = 3.0  # pixels; boxes that end nearer to the image's edge may go on beyond it


@dataclass(kw_only=True)
class State(Counts):
    """Holds the maps, in a frame and with the names of classes that the first view gives."""

    surfaces: SurfaceMap
    frame: str = ""
    classes: tuple[str, ...] = ()  # before the map, which is made anew with them
    map: ObjectMap | None = None
    trajectory: Trajectory = field(default_factory=Trajectory)
    corrected: int = -1  # stamp of the last keyframes that the map moved with


class SemanticMap(Operator):
    """Accumulates objects and surfaces in the world, each with class, box, existence and when it was last seen.

    What a view shows is joined to the map by place, class, colour and the track that it is of (the ids of `boxes`), of
    which nodes keep the last ones; two entries that come to share their place and are not seen beside each other are
    one. Each view also shows empty space: an object whose place is empty goes, and one of its class, size and colour
    that appears elsewhere takes its id, moved and not doubled. Classes that move by themselves are followed instead,
    and forgotten after a while out of sight. Everything else is kept while it is out of sight. An object that is seen
    often enough is given, whatever its size: if its class is never so large, or if it is of a small class and seldom
    surely detected, it is doubted, which halves its score or lowers it by what the label lacks. Surfaces are joined by
    their planes and by where they lie; there is one floor, and people stand on it.

    With `keyframes` the map deforms with loop closures: each voxel and each image of an object or surface moves with
    the place from which it was seen, boxes are fitted again, and entries of one thing, seen before and after the drift,
    become one.

    With `save` the map is written at the end, and with it the classes that were learned for it; `map_file` begins with
    such a map, in whose frame the pose must be. Objects that move by themselves are not taken over.

    Method: after Hughes et al., "Hydra: a real-time spatial perception system", 2022, and Gu et al., "ConceptGraphs",
    2024, with free space from the views themselves.
    """

    boxes: In[Boxes3D] = In(doc="objects of one view, as ObjectLifter gives them")
    clusters: In[Clusters] = In(doc="the object of every point of the cloud, in the order of the boxes")
    cloud: In[PointCloud] = In(doc="the whole view: points behind a place show that it is empty")
    pose: Sampled[Pose | Odometry] = Sampled(
        doc="the cloud's sensor or its robot in the frame of the map, whose z is up"
    )
    extrinsics: Sampled[Transforms] = Sampled(
        required=False, doc="holds the transform between the cloud's frame and that of the pose, where they differ"
    )
    images: Sampled[Detections2D] = Sampled(
        required=False, doc="the image's boxes of the same objects, in their order; not used where of another stamp"
    )
    image_info: Sampled[CameraInfo] = Sampled(required=False, doc="calibration of that image")
    surfaces: Sampled[Boxes3D] = Sampled(
        required=False, doc="the cloud's surfaces, as PlaneSegmenter finds them; not used where of another stamp"
    )
    keyframes: Sampled[Path] = Sampled(
        required=False,
        doc="all keyframes as SLAM has them at a loop, with stamps: poses of what `pose` poses, in the map's frame; "
        "nodes move with those from which they were seen",
    )
    objects: Out[Boxes3D] = Out(
        doc="the objects that were seen often enough, in the map's frame; scores are probabilities of existence, "
        "lowered for what is doubted"
    )
    nodes: Out[SceneGraph] = Out(
        doc="the same objects as nodes without relations, with when each was last seen; and the surfaces, whose ids "
        "are 0 (the floor) and from -11 down"
    )
    seen: Out[Detections2D] = Out(
        doc="of `images` those of objects that are given, with the ids of their nodes; where there are any images"
    )
    status: Out[Diagnostics] = Out(
        doc="objects by what became of them, doubted ones too; a warning for a view without points"
    )

    voxel: float = Param(0.03, gt=0.005, le=0.2, doc="side of the voxels that objects consist of", unit="m")
    overlap: float = Param(0.25, gt=0, le=1, doc="share of a view's points that are near those of the object it is of")
    image_overlap: float = Param(
        0.3, gt=0, le=1, doc="IoU in the image of an object's box and that of a view that is of it"
    )
    confirm: float = Param(1.25, gt=0, doc="evidence from which an object is given, in log odds")
    views: int = Param(3, ge=1, doc="and views from which it was seen; those less than 0.1 s after another count less")
    missed: float = Param(0.12, ge=0, doc="evidence that a view in which it is plain but not detected takes")
    plain: float = Param(0.03, gt=0, doc="angle of view from which an object should be detected", unit="rad")
    labels: str = Param("coco", doc="label space: coco, simulator, or a YAML file; gives roles and sizes of classes")
    mover_memory: float = Param(8.0, gt=0, doc="time out of sight after which agents are forgotten", unit="s")
    move_memory: float = Param(120.0, ge=0, doc="time for which a vanished object is known again elsewhere", unit="s")
    surface_views: int = Param(2, ge=1, doc="views of a surface from which it is given")
    max_range: float = Param(6.0, gt=0, doc="farther points are not used", unit="m")
    depth_sensor: str = Param("", doc=f"{DEPTH_SENSOR}; what it grows by with the range counts")
    map_file: str | None = Param(None, doc="saved map to begin with; an empty one if none")
    save: str | None = Param(None, doc="file that the map is written to at the end")
    learned: list[str] = Param(
        [], doc="files of `dataflow learn object`, or saved maps, whose classes the detector finds: saved with the map"
    )

    state: State

    def setup(self) -> None:
        """Raises FileNotFoundError or ValueError for a bad label space, sensor or map, or voxels of another size."""
        self._sensor = read_depth_sensor(self.depth_sensor, self.use_file)
        self._labels = LabelSpace.read(self.use_file(labels_file(self.labels)))
        self._known = None if self.map_file is None else SavedMap.read(FilePath(self.use_file(self.map_file)))
        if self._known is not None and self._known.voxel != self.voxel:
            raise ValueError(f"{self.map_file} has voxels of {self._known.voxel} m, but voxel is {self.voxel}")
        given = [learned_files(FilePath(self.use_file(name))) for name in self.learned]
        self._learned: tuple[LearnedFile, ...] = together(() if self._known is None else self._known.learned, *given)

    def initial_state(self) -> State:
        return State(surfaces=SurfaceMap(self.surface_views))

    def new_part(self, kind: type[Any]) -> ObjectMap:
        return self._made()

    def finish(self) -> None:
        """Writes the map."""
        if self.save is not None:
            objects = {} if self.state.map is None else self.state.map.snapshot()
            saved = SavedMap(
                self.state.classes, self.state.frame, self.voxel, objects, self.state.surfaces.snapshot(), self._learned
            )
            saved.write(FilePath(self.save).expanduser())

    def process(
        self,
        boxes: Boxes3D,
        clusters: Clusters,
        cloud: PointCloud,
        pose: Pose | Odometry,
        extrinsics: Transforms | None = None,
        images: Detections2D | None = None,
        image_info: CameraInfo | None = None,
        surfaces: Boxes3D | None = None,
        keyframes: Path | None = None,
    ) -> dict[str, Any]:
        """Raises ValueError where boxes, clusters and cloud do not belong together, where the pose's frame changes, and
        for keyframes in another frame or without stamps."""
        if clusters.count != boxes.count or len(clusters.labels) != cloud.count:
            raise ValueError(
                f"{boxes.count} boxes, {clusters.count} clusters and labels for {len(clusters.labels)} of "
                f"{cloud.count} points do not belong together"
            )
        known = self._opened(boxes, pose)
        self._go_on(known, pose, cloud.stamp, keyframes)
        sensor = pose.child_frame or cloud.frame
        T = pose.matrix() @ transform_between(extrinsics, cloud.frame, sensor)
        usable = np.flatnonzero(in_range(cloud.points, 0.0, self.max_range))
        points = cloud.points[usable].astype(np.float64)
        shown = _images(boxes, cloud, images, image_info, T, extrinsics)
        rows, ends = _by_label(clusters.labels[usable], boxes.count)
        world, colors = transform_points(T, points[rows]), _mean_colors(cloud, usable[rows], ends)
        seen = [
            self._observation(boxes, world[ends[k] : ends[k + 1]], None if colors is None else colors[k], k, shown[k])
            for k in range(boxes.count)
        ]
        known.floor = self.state.surfaces.floor
        view = RangeView(points[:: 1 + len(points) // 20_000], T, 0.012)
        joined = known.update(cloud.stamp, [each for each in seen if each is not None], view)
        if surfaces is not None and surfaces.stamp == cloud.stamp:
            parts = seen_surfaces(surfaces, cloud, T, self.max_range)
            self.state.surfaces.update(cloud.stamp, parts, view, known.heading)
        objects, planes = known.confirmed(), self.state.surfaces.confirmed
        doubts = [known.doubt(o) for o in objects]
        scores = [o.score * (1 - doubt) for o, doubt in zip(objects, doubts, strict=True)]
        counts = {
            "objects": len(objects),
            "doubted": sum(doubt > 0 for doubt in doubts),
            "tentative": len(known.objects) - len(objects),
            "seen now": sum(o.seen == cloud.stamp for o in objects),
            "moved": known.moved,
            "surfaces": len(planes),
            "points": len(points),
        }
        self._count(counts)
        made = {
            "objects": self._boxes(cloud.stamp, objects, scores),
            "nodes": nodes_of(cloud.stamp, self.state.frame, self.state.classes, objects, scores, planes),
            "status": _status(cloud.stamp, counts),
        }
        if images is not None and images.stamp == boxes.stamp and images.count == boxes.count:
            used = [k for k, each in enumerate(seen) if each is not None]
            made["seen"] = _of_nodes(images, dict(zip(used, joined, strict=True)), {o.id for o in objects})
        return made

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the classes, by id; empty before the first view."""
        return self.state.classes

    def entries(self) -> list[MapObject]:
        """Returns all objects, those too that are not surely there."""
        return [] if self.state.map is None else list(self.state.map.objects.values())

    def _opened(self, boxes: Boxes3D, pose: Pose | Odometry) -> ObjectMap:
        if self.state.map is None:
            self.state.classes, self.state.frame = boxes.class_names, pose.frame
            self.state.counts["unknown classes"] = warn_of_unknown(self, self._labels, self.state.classes)
            self.state.map = self._made()
            if self._known is not None and self._known.objects:
                self._take_up(self._known, boxes.stamp)
        if pose.frame != self.state.frame:
            raise ValueError(f"the pose is in {pose.frame!r}, the map in {self.state.frame!r}")
        if boxes.class_names != self.state.classes:
            if boxes.class_names[: len(self.state.classes)] != self.state.classes:
                raise ValueError(f"boxes have the classes {boxes.class_names}, the map has {self.state.classes}")
            self.state.classes = boxes.class_names
            self.state.counts["unknown classes"] = warn_of_unknown(self, self._labels, self.state.classes)
            self.state.map.widen(len(self.state.classes), ClassPriors.of(self._labels, self.state.classes))
        return self.state.map

    def _count(self, counts: Mapping[str, int]) -> None:
        """Counts a view, and notes what the map has now."""
        self.state.counts["views"] += 1
        self.state.counts["views without points"] += not counts["points"]
        for name in ("objects", "moved", "doubted", "surfaces"):
            self.state.counts[name] = counts[name]

    def _go_on(self, known: ObjectMap, pose: Pose | Odometry, stamp: int, keyframes: Path | None) -> None:
        """Moves the map with keyframes that it has not moved with yet, then notes from where it is seen."""
        if keyframes is not None and keyframes.stamp != self.state.corrected:
            self._correct(known, keyframes)
        self.state.trajectory.add(stamp, pose.matrix())

    def _correct(self, known: ObjectMap, keyframes: Path) -> None:
        if keyframes.frame != self.state.frame:
            raise ValueError(f"the keyframes are in {keyframes.frame!r}, the map in {self.state.frame!r}")
        self.state.corrected = keyframes.stamp
        correction = self.state.trajectory.corrected(keyframes)
        if correction is not None:
            known.correct(correction)
            self.state.surfaces.correct(correction, known.heading)
            self.state.counts["corrections"] += 1

    def _take_up(self, saved: SavedMap, stamp: int) -> None:
        """Goes on from a saved map. Raises ValueError where its frame or its classes are others."""
        if saved.frame != self.state.frame:
            raise ValueError(f"the pose is in {self.state.frame!r}, {self.map_file} in {saved.frame!r}")
        assert self.state.map is not None
        objects, surfaces = saved.begun(stamp, self.state.classes, self._labels)
        self.state.map.restore(objects)
        self.state.surfaces.restore(surfaces)

    def _made(self) -> ObjectMap:
        settings = MapSettings(
            voxel=self.voxel,
            overlap=self.overlap,
            image_overlap=self.image_overlap,
            miss_angle=self.plain,
            confirm=self.confirm,
            views=self.views,
            missed=self.missed,
            range_noise=MapSettings.range_noise if self._sensor is None else self._sensor.quadratic,
            mover_memory=self.mover_memory,
            move_memory=self.move_memory,
        )
        return ObjectMap(max(len(self.state.classes), 1), ClassPriors.of(self._labels, self.state.classes), settings)

    def _observation(
        self,
        boxes: Boxes3D,
        points: NDArray[np.float64],
        color: NDArray[np.float64] | None,
        k: int,
        image: ImageView | None,
    ) -> Observation | None:
        if len(points) < 3:
            return None
        class_id = int(boxes.class_ids[k]) if self.state.classes else 0
        track = -1 if boxes.ids is None else int(boxes.ids[k])
        return Observation(points, class_id, float(boxes.scores[k]), color, image, track)

    def _boxes(self, stamp: int, objects: list[MapObject], scores: list[float]) -> Boxes3D:
        return Boxes3D(
            stamp=stamp,
            frame=self.state.frame,
            class_names=self.state.classes,
            centers=np.array([o.center for o in objects]).reshape(-1, 3),
            sizes=np.array([o.size for o in objects]).reshape(-1, 3),
            orientations=quaternion_from_yaw(np.array([o.yaw for o in objects])).reshape(-1, 4),
            scores=np.array(scores, np.float32),
            class_ids=np.array([o.class_id for o in objects], np.int32),
            ids=np.array([o.id for o in objects], np.int64),
            velocities=np.array([o.velocity for o in objects]).reshape(-1, 3),
            point_counts=np.array([len(o.voxels) for o in objects], np.int64),
        )


def _by_label(labels: NDArray[np.int32], count: int) -> tuple[NDArray[np.intp], list[int]]:
    """Returns the rows with labels from 0 on, by label, and where those of each label begin and the last ones end."""
    labelled = np.flatnonzero(labels >= 0)
    rows = labelled[np.argsort(labels[labelled], kind="stable")]
    return rows, np.searchsorted(labels[rows], np.arange(count + 1)).tolist()


def _mean_colors(cloud: PointCloud, rows: NDArray[np.intp], ends: Sequence[int]) -> NDArray[np.float64] | None:
    """Returns the mean colour (K, 3) in [0, 1] of the rows between each two ends; None where the cloud has none."""
    if cloud.colors is None:
        return None
    sums = np.zeros((len(rows) + 1, 3), np.int64)
    np.cumsum(cloud.colors[rows], axis=0, out=sums[1:])
    return np.asarray(np.diff(sums[list(ends)], axis=0) / np.maximum(np.diff(ends), 1)[:, None] / 255.0)


def _images(
    boxes: Boxes3D,
    cloud: PointCloud,
    images: Detections2D | None,
    info: CameraInfo | None,
    T_map_cloud: NDArray[np.float64],
    extrinsics: Transforms | None,
) -> list[ImageView | None]:
    """Returns what the image shows of each object; None where there is no image of the same time."""
    if images is None or info is None or images.stamp != boxes.stamp or images.count != boxes.count:
        return [None] * boxes.count
    if (images.width, images.height, images.frame) != (info.width, info.height, info.frame):
        raise ValueError(
            f"images are of {images.width}x{images.height} pixels in {images.frame!r}, but image_info describes "
            f"{info.width}x{info.height} in {info.frame!r}"
        )
    T_image_map = transform_between(extrinsics, cloud.frame, images.frame) @ invert(T_map_cloud)
    P, eye = np.asarray(info.K) @ T_image_map[:3], invert(T_image_map)[:3, 3]
    size = np.array([images.width, images.height, images.width, images.height])
    rows = images.boxes.astype(np.float64)
    whole = np.where(np.arange(4) < 2, rows > _BORDER, rows < size - _BORDER)
    return [ImageView(P, box - 0.5, edges, eye, stamp=boxes.stamp) for box, edges in zip(rows, whole, strict=True)]


def _of_nodes(images: Detections2D, joined: Mapping[int, int], given: Collection[int]) -> Detections2D:
    """Returns the rows of images that show given nodes, by the node of each row that has one."""
    rows = [k for k, i in joined.items() if i in given]
    return Detections2D(
        stamp=images.stamp,
        frame=images.frame,
        width=images.width,
        height=images.height,
        class_names=images.class_names,
        boxes=images.boxes[rows],
        scores=images.scores[rows],
        class_ids=images.class_ids[rows],
        ids=np.array([joined[k] for k in rows], np.int64),
    )


def _status(stamp: int, counts: Mapping[str, int]) -> Diagnostics:
    text = f"{counts['objects']} objects, {counts['seen now']} in view, {counts['moved']} moved so far"
    text += f", {counts['surfaces']} surfaces" if counts["surfaces"] else ""
    level = Level.OK if counts["points"] else Level.WARN
    return counted_status("semantic_map", stamp, text if counts["points"] else "the view has no points", level, counts)
