"""Memory of a viewer between messages: frames, ends of trails, what it said already, where to look from."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
import rerun as rr

from dataflow.messages.geometry import split_matrix
from dataflow.view import colors
from dataflow.view.frames import Attach, Change, Detach, FrameTree, NewRoot, Rank
from dataflow.view.layout import Layout, is_truth
from dataflow.view.unshown import Offer, Unshown

Vector = npt.NDArray[np.float64]

SCENE = "/scene"
"""Entity of the drawing frame: the origin of the 3-D view."""

FRAMES = "/frames"
"""Entities of the frames: `/frames/<name>`."""

TIMELINE = "stamp"
"""The one timeline: event time."""

VIEWER_LOG = "/viewer/log"
"""Entity of what the viewer itself has to say."""

_ONE_SIDED = 0.5
"""Length of the mean direction of points that lie more to one side of their sensor than all round it."""

ASSUMPTION_GRACE = 1_000_000_000
"""Event time (ns) for which a frame may stay unplaced before the viewer says so."""


@dataclass(frozen=True, slots=True)
class ViewOptions:
    """Bounds on what is shown, and with it on memory.

    - `jpeg_quality`: raw colour images are sent as JPEG of this quality, None: as they are (20 times the memory).
    - `depth_step`: depth is sent as 16-bit PNG in steps of so many metres (coarser only where the farthest would not
      fit); None: as float32.
    - `max_points`: a cloud of more points is thinned evenly to at most this many; the viewer's log says so once.
    - `point_step`: positions of a cloud's points are rounded to this, metres, which packs better; 0: not at all.
    - `kept_step`: side (m) of the cells in which points that stay are kept, one each; `kept_after`: clouds that must
      have had a point in a cell, so that what moves leaves none.
    - `trail`: trails get a vertex every so many metres at least.
    - `pose_step`: event time (ns) from which a pose of a stream is drawn again; its frames are placed, and its curves
      go on, with every message.
    - `track_history`: event time (ns) for which the paths of tracks are drawn.
    """

    jpeg_quality: int | None = 85
    depth_step: float | None = 0.001
    max_points: int = 200_000
    point_step: float = 0.0
    kept_step: float = 0.05
    kept_after: int = 4
    trail: float = 0.01
    pose_step: int = 0
    track_history: int = 5_000_000_000

    def __post_init__(self) -> None:
        if self.jpeg_quality is not None and not 1 <= self.jpeg_quality <= 100:
            raise ValueError(f"jpeg_quality must be 1 to 100 or None, got {self.jpeg_quality}")
        if self.depth_step is not None and not self.depth_step > 0:
            raise ValueError(f"depth_step must be more than 0 m or None, got {self.depth_step}")
        if not self.point_step >= 0:
            raise ValueError(f"point_step must be 0 m or more, got {self.point_step}")
        if not self.kept_step > 0:
            raise ValueError(f"kept_step must be more than 0 m, got {self.kept_step}")
        if self.max_points < 1:
            raise ValueError(f"max_points must be at least 1, got {self.max_points}")


@dataclass(frozen=True, slots=True)
class Outlook:
    """A viewpoint in the drawing frame, metres. `up` is a unit vector along an axis."""

    up: Vector
    position: Vector | None = None
    target: Vector | None = None


@dataclass(slots=True)
class Trail:
    """The last vertex of a trail that has been drawn."""

    frame: str
    position: Vector


@dataclass(slots=True)
class SceneState:
    """The state of one viewer session; visualisers read and update it."""

    layout: Layout = field(default_factory=Layout)
    options: ViewOptions = field(default_factory=ViewOptions)
    tree: FrameTree = field(default_factory=FrameTree)
    optical: dict[str, None] = field(default_factory=dict)
    trails: dict[str, Trail] = field(default_factory=dict)
    track_paths: dict[str, dict[int, deque[tuple[int, Vector]]]] = field(default_factory=dict)
    remembered: dict[tuple[str, str], Any] = field(default_factory=dict)
    unshown: Unshown = field(default_factory=Unshown)
    _noted: set[tuple[str, str]] = field(default_factory=set)
    _ranges: list[float] = field(default_factory=list)
    _around: list[Vector] = field(default_factory=list)
    _kept: list[Vector] = field(default_factory=list)
    _ahead: Vector | None = None  # the direction in which one looks, decided once
    _posed: dict[str, None] = field(default_factory=dict)
    _waiting: dict[str, int] = field(default_factory=dict)
    _rows: dict[str, tuple[int, bool]] = field(default_factory=dict)  # frame: stamp of its last row, a stream's pose?

    def changed(self, entity: str, key: str, value: object) -> bool:
        """Tells whether `value` differs from what was last remembered under (entity, key); remembers it."""
        if self.remembered.get((entity, key), self) == value:
            return False
        self.remembered[entity, key] = value
        return True

    def due(self, entity: str, stamp: int) -> bool:
        """Tells whether a pose is to be drawn at `entity`: the last one is `pose_step` old. Then this is the last."""
        last = self.remembered.get((entity, "pose"))
        if last is not None and 0 <= stamp - last < self.options.pose_step:
            return False
        self.remembered[entity, "pose"] = stamp
        return True

    def once(self, stream: str, what: str) -> bool:
        """True the first time for (stream, what)."""
        if (stream, what) in self._noted:
            return False
        self._noted.add((stream, what))
        return True

    def rank(self, stream: str) -> Rank:
        """Whose word counts on where frames lie."""
        return Rank.TRUTH if is_truth(stream) else Rank.ESTIMATE

    def trail_color(self, stream: str, streams: tuple[str, ...]) -> colors.RGB:
        """Green for ground truth; else by the place of the stream among `streams`, those of its kind."""
        if is_truth(stream):
            return colors.TRUTH
        others = [name for name in streams if not is_truth(name)]
        index = others.index(stream) if stream in others else len(others)
        return colors.ESTIMATES[index % len(colors.ESTIMATES)]

    def see(self, recording: rr.RecordingStream, frame: str, stamp: int) -> None:
        """A message names `frame`: makes sure that it hangs somewhere."""
        if frame not in self.tree:
            self.draw_frames(recording, self.tree.see(frame), stamp)
            self._take_unshown(recording, frame, stamp)

    def place(
        self,
        recording: rr.RecordingStream,
        *,
        parent: str,
        child: str,
        T_parent_child: Vector,
        stream: str,
        rank: Rank,
        stamp: int,
        static: bool,
    ) -> None:
        """A message places `child` in `parent`; poses that are not finite are passed over."""
        if not np.isfinite(T_parent_child).all():
            return
        self._posed.setdefault(child)
        changes = self.tree.place(parent, child, T_parent_child, owner=stream, rank=rank, stamp=stamp)
        self.draw_frames(recording, changes, stamp, static=static)
        self._take_unshown(recording, parent, stamp)

    def offer(
        self,
        recording: rr.RecordingStream,
        *,
        parent: str,
        child: str,
        T_parent_child: Vector,
        stream: str,
        tree: bool,
        stamp: int,
        static: bool,
    ) -> None:
        """A message of a stream that is not shown places `child` in `parent`, if that is needed."""
        if np.isfinite(T_parent_child).all():
            rank = Rank.TREE if tree else self.rank(stream)
            self.unshown.offer(child, Offer(parent, T_parent_child, stream, rank, stamp, static))
            self._take_unshown(recording, child, stamp)

    def _take_unshown(self, recording: rr.RecordingStream, child: str, stamp: int) -> None:
        offer = self.unshown.needed(self.tree, child, stamp)
        if offer is not None and (offer.stamp == stamp or self.tree.owner(child) is None):
            self.place(
                recording,
                parent=offer.parent,
                child=child,
                T_parent_child=offer.T_parent_child,
                stream=offer.stream,
                rank=Rank.TREE if offer.rank is Rank.TREE else Rank.UNSHOWN,
                stamp=stamp,
                static=offer.static,
            )

    def draw_frames(
        self, recording: rr.RecordingStream, changes: list[Change], stamp: int, *, static: bool = False
    ) -> None:
        """Logs the changes of the tree. What is assumed is never static, so that what is given later replaces it."""
        for change in changes:
            match change:
                case Attach():
                    position, orientation = split_matrix(change.T_parent_child)
                    pose = rr.Transform3D(
                        translation=position,
                        quaternion=rr.Quaternion(xyzw=orientation),
                        parent_frame=change.parent,
                        child_frame=change.child,
                    )
                    self._log_frame(recording, change.child, pose, stamp, static=static, given=not change.assumed)
                    if change.assumed:
                        self._waiting.setdefault(change.child, stamp)
                case Detach():
                    self._log_frame(
                        recording, change.child, rr.Clear(recursive=False), stamp, static=static, given=False
                    )
                case NewRoot():
                    recording.log(SCENE, rr.CoordinateFrame(change.frame), static=True)

    def _log_frame(
        self,
        recording: rr.RecordingStream,
        frame: str,
        row: rr.AsComponents,
        stamp: int,
        *,
        static: bool,
        given: bool,
    ) -> None:
        """Logs a row of a frame so that it takes the place of what was assumed, whichever of the two is stamped later.

        A static row would not: Rerun keeps the parents of earlier rows beside it, and may find a loop. So a frame that
        has a row in time gets no static one; a pose that holds for all time then replaces its last row in time.
        """
        if static and given and frame not in self._rows:
            recording.log(frame_entity(frame), row, static=True)
            return
        last, moving = self._rows.get(frame, (stamp, False))
        at = last if static else stamp if given and moving else max(last, stamp)
        recording.set_time(TIMELINE, timestamp=np.datetime64(at, "ns"))
        recording.log(frame_entity(frame), row)
        recording.set_time(TIMELINE, timestamp=np.datetime64(stamp, "ns"))
        self._rows[frame] = at, given and not static

    def doubts(self, stamp: int) -> list[str]:
        """Returns what to tell people about frames that nobody placed for a while; each once."""
        words = []
        assumed = self.tree.assumed() if self._waiting else {}
        for frame, since in list(self._waiting.items()):
            if frame not in assumed:
                del self._waiting[frame]
            elif stamp - since >= ASSUMPTION_GRACE:
                del self._waiting[frame]
                reason = self.tree.reason(frame)
                words.append(
                    f"frame {frame!r} is not placed by any stream: drawn so that {reason} agree at first"
                    if reason
                    else f"frame {frame!r} is not placed by any stream: drawn at the origin of {assumed[frame]!r}"
                )
        return words

    def saw_range(self, distances: npt.ArrayLike) -> None:
        """Distances (N,) in metres at which things were seen: they set how far back to look from."""
        d = np.asarray(distances, np.float64)
        d = d[np.isfinite(d) & (d > 0)]
        if d.size and len(self._ranges) < 256:
            self._ranges.append(float(np.median(d)))

    def saw_points(self, frame: str, points: npt.ArrayLike) -> None:
        """Points (N, 3) of a cloud in its sensor's frame: how far things are, where the place of a scan all round is.

        Call it when the frame is known to the tree.
        """
        p = np.asarray(points, np.float64).reshape(-1, 3)
        distances = np.linalg.norm(p, axis=1)
        self.saw_range(distances)
        p, distances = p[distances > 0], distances[distances > 0]
        if len(p) < 16 or len(self._around) >= 16:
            return
        T = self.tree.pose(frame)
        if T is not None and np.linalg.norm((p / distances[:, None]).mean(axis=0)) < _ONE_SIDED:
            self._around.append(p @ T[:3, :3].T + T[:3, 3])

    @property
    def keeps(self) -> bool:
        """Tells whether there are points that stay."""
        return bool(self._kept)

    def kept_points(self, points: npt.ArrayLike) -> None:
        """Points (N, 3) in the root frame that stay: the viewpoint is so far off that they are in view."""
        p = np.asarray(points, np.float64).reshape(-1, 3)
        self._kept.append(p[:: max(len(p) // 64, 1)])

    def outlook(self) -> Outlook:
        """Chooses the viewpoint from which everything seen is in view.

        From behind and above the cameras, or else the robot; where a sensor scans all round, so high that the whole
        place is in view, since the robot will drive about in it. Up is +z (REP 103), unless the root is itself like an
        optical frame (y down), as in data sets whose world is their first camera.
        """
        up = np.array([0.0, 0.0, 1.0])
        cameras = [T for frame in self.optical if (T := self.tree.pose(frame)) is not None]
        if cameras and all(T[1, 1] > 0.7 and T[2, 2] > 0.7 for T in cameras):
            up = np.array([0.0, -1.0, 0.0])
        if cameras:
            at, ahead = cameras[0][:3, 3], cameras[0][:3, 2]
        else:
            robot = next((T for frame in self._posed if (T := self.tree.pose(frame)) is not None), None)
            if robot is None and not self._ranges:
                return Outlook(up)
            at, ahead = (np.zeros(3), np.eye(3)[0]) if robot is None else (robot[:3, 3], robot[:3, 0])
        level = ahead - up * (ahead @ up)
        if np.linalg.norm(level) < 0.2:
            level = np.eye(3)[0] - up * up[0]
        level /= np.linalg.norm(level)
        if self._ahead is None:
            self._ahead = level
        level = self._ahead
        reach = float(np.clip(np.median(self._ranges) if self._ranges else 3.0, 1.0, 30.0))
        side = np.cross(level, up)
        if self._around or self._kept:
            lower, upper = np.percentile(np.concatenate(self._around + self._kept), [3, 97], axis=0)
            middle = (lower + upper) / 2
            size = float(np.clip(np.linalg.norm((upper - lower)[up == 0]) / 2, 1.0, 50.0))
            away = -0.97 * level + 1.05 * up + 0.4 * side
            return Outlook(up, middle + size * away, middle - (0.1 * size * level if self._kept else 0.0))
        position = at - level * (0.75 * reach) + up * (0.6 * reach) + side * (0.45 * reach)
        return Outlook(up, position, at + level * (0.75 * reach))


def frame_entity(frame: str) -> str:
    """The entity that places a frame: always the same, as Rerun demands."""
    return f"{FRAMES}/{rr.escape_entity_path_part(frame)}"


def entity_of(stream: str) -> str:
    """The entity of a stream: its name as a path."""
    return "/" + "/".join(rr.escape_entity_path_part(part) for part in stream.split("/") if part)
