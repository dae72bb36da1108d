"""Memory of a viewer between messages: frames, ends of trails, what it said already."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import rerun as rr

from dataflow.messages.geometry import split_matrix
from dataflow.video.decoder import PacketDecoder
from dataflow.view import colors
from dataflow.view.frames import Attach, Change, Detach, FramePriority, FrameTree, Matrix, NewRoot
from dataflow.view.layout import Layout, is_truth
from dataflow.view.viewpoint import Vector, Viewpoint

SCENE = "/scene"
"""Entity of the drawing frame: the origin of the 3-D view."""
FRAMES = "/frames"
"""Entities of the frames: `/frames/<name>`."""
TIMELINE = "stamp"
"""The one timeline: event time."""
VIEWER_LOG = "/viewer/log"
"""Entity of what the viewer itself has to say."""
ASSUMPTION_GRACE = 1_000_000_000
"""Event time (ns) for which a frame may stay unplaced before the viewer reports it."""


@dataclass(frozen=True, slots=True)
class Placed:
    """The place of a frame by a stream's message: `T_parent_child` (4×4) in `parent`."""

    parent: str
    child: str
    T_parent_child: Matrix
    stream: str
    rank: FramePriority
    stamp: int
    static: bool


@dataclass(slots=True)
class HiddenFrames:
    """The newest offer for each frame of streams that are not shown; an estimate goes before truth.

    One is taken where something shown needs it and nothing shown gives it: a hidden stream must not take the frames of
    what is shown with it, nor bring its frames into the picture or win one from a stream that is shown.
    """

    _offers: dict[str, Placed] = field(default_factory=dict)
    _wanted: dict[str, int] = field(default_factory=dict)

    def offer(self, pose: Placed) -> None:
        held = self._offers.get(pose.child)
        if held is None or held.stream == pose.stream or pose.rank < held.rank:
            self._offers[pose.child] = pose

    def needed(self, tree: FrameTree, child: str, stamp: int) -> Placed | None:
        """Returns the offer that is to place `child` now, if any.

        What moves is taken a message later than it is first wanted: what is shown and of the same stamp may place it.
        """
        offer = self._offers.get(child)
        if offer is None or child not in tree:
            return None
        if (owner := tree.owner(child)) is not None:
            return offer if owner == offer.stream else None
        return offer if offer.static or self._wanted.setdefault(child, stamp) < stamp else None


@dataclass(frozen=True, slots=True)
class ViewOptions:
    """Bounds on what is shown, and with it on memory.

    - `jpeg_quality`: raw colour images are sent as JPEG of this quality, None: as they are (20 times the memory).
    - `depth_step`: depth is sent as 16-bit PNG in steps of so many metres (coarser only where the farthest would not
      fit); None: as float32. `depth_block`: side (pixels) of the squares that have one depth each; 1: every pixel.
    - `max_points`: a cloud of more points is thinned evenly to at most this many; the viewer's log notes it once.
    - `point_step`: positions of a cloud's points are rounded to this, metres, which packs better; 0: not at all.
    - `point_shades`: colours that distinguish the values of a cloud's points, which packs better; 0: all.
    - `kept_step`: side (m) of the cells in which points that stay are kept, one each; `kept_after`: clouds that must
      have had a point in a cell, so that what moves leaves none.
    - `trail`: trails get a vertex every so many metres at least.
    - `pose_step`: event time (ns) from which a pose of a stream is drawn again; its frames are placed, and its curves
      go on, with every message.
    - `image_step`: event time (ns) in which one message of a stream of images, of what is drawn over them, or of clouds
      is drawn, the first; and the stream's last. 0: every message.
    - `track_history`: event time (ns) for which the paths of tracks are drawn.
    """

    jpeg_quality: int | None = 85
    depth_step: float | None = 0.001
    depth_block: int = 1
    max_points: int = 200_000
    point_step: float = 0.0
    point_shades: int = 0
    kept_step: float = 0.05
    kept_after: int = 4
    trail: float = 0.01
    pose_step: int = 0
    image_step: int = 0
    track_history: int = 5_000_000_000

    def __post_init__(self) -> None:
        for name, fits, wanted in (
            ("jpeg_quality", self.jpeg_quality is None or 1 <= self.jpeg_quality <= 100, "1 to 100 or None"),
            ("depth_step", self.depth_step is None or self.depth_step > 0, "more than 0 m or None"),
            ("depth_block", self.depth_block >= 1, "at least 1 pixel"),
            ("point_step", self.point_step >= 0, "0 m or more"),
            ("kept_step", self.kept_step > 0, "more than 0 m"),
            ("image_step", self.image_step >= 0, "0 ns or more"),
            ("point_shades", self.point_shades == 0 or self.point_shades >= 2, "at least 2, or 0 for all"),
            ("max_points", self.max_points >= 1, "at least 1"),
        ):
            if not fits:
                raise ValueError(f"{name} must be {wanted}, got {getattr(self, name)}")


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
    trails: dict[str, Trail] = field(default_factory=dict)
    track_paths: dict[str, dict[int, deque[tuple[int, Vector]]]] = field(default_factory=dict)
    remembered: dict[tuple[str, str], Any] = field(default_factory=dict)
    videos: dict[str, PacketDecoder] = field(default_factory=dict)
    """By stream, the decoder of its packets."""
    unshown: HiddenFrames = field(default_factory=HiddenFrames)
    viewpoint: Viewpoint = field(default_factory=Viewpoint)
    begin: int | None = None
    """The stamp (ns) of the first message that was drawn."""
    new_parts: bool = False
    """Parts of streams were first drawn since the views were last derived."""
    _noted: set[tuple[str, str]] = field(default_factory=set)
    _waiting: dict[str, int] = field(default_factory=dict)
    _rows: dict[str, tuple[int, bool]] = field(default_factory=dict)  # frame: stamp of its last row, a stream's pose?

    def changed(self, entity: str, key: str, value: object) -> bool:
        """Returns whether `value` differs from what was last remembered under (entity, key); remembers it."""
        if self.remembered.get((entity, key), self) == value:
            return False
        self.remembered[entity, key] = value
        return True

    def has_drawn(self, stream: str, path: str) -> bool:
        """Returns whether a stream has drawn at `<entity>/<path>`, where that is a part of `parts_of` its type."""
        return (entity_of(stream), path) in self.remembered

    def due(self, entity: str, stamp: int) -> bool:
        """Returns whether a pose is to be drawn at `entity`: the last one is `pose_step` old. Then this is the last."""
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

    def trail_color(self, stream: str, streams: tuple[str, ...]) -> colors.RGB:
        """Returns green for ground truth, otherwise a palette colour by the place of the stream among `streams`."""
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

    def place(self, recording: rr.RecordingStream, pose: Placed) -> None:
        """A message places a frame, or offers to, where its stream is not shown; what is not finite is passed over."""
        if not np.isfinite(pose.T_parent_child).all():
            return
        if pose.stream in self.layout.placing:
            self.unshown.offer(pose)
            self._take_unshown(recording, pose.child, pose.stamp)
        else:
            self._place(recording, pose)

    def _place(self, recording: rr.RecordingStream, pose: Placed) -> None:
        parent, child, T_parent_child = pose.parent, pose.child, pose.T_parent_child
        self.viewpoint.posed.setdefault(child)
        changes = self.tree.place(parent, child, T_parent_child, owner=pose.stream, rank=pose.rank, stamp=pose.stamp)
        self.draw_frames(recording, changes, pose.stamp, static=pose.static)
        self._take_unshown(recording, parent, pose.stamp)

    def _take_unshown(self, recording: rr.RecordingStream, child: str, stamp: int) -> None:
        offer = self.unshown.needed(self.tree, child, stamp)
        if offer is not None and (offer.stamp == stamp or self.tree.owner(child) is None):
            rank = FramePriority.TREE if offer.rank is FramePriority.TREE else FramePriority.UNSHOWN
            self._place(recording, replace(offer, rank=rank, stamp=stamp))

    def draw_frames(
        self, recording: rr.RecordingStream, changes: list[Change], stamp: int, *, static: bool = False
    ) -> None:
        """Logs the changes of the tree. Assumed frames are never static, so that later ones replace them."""
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
                    cleared = rr.Clear(recursive=False)
                    self._log_frame(recording, change.child, cleared, stamp, static=static, given=False)
                case NewRoot():
                    recording.log(SCENE, rr.CoordinateFrame(change.frame), static=True)

    def _log_frame(
        self, recording: rr.RecordingStream, frame: str, row: rr.AsComponents, stamp: int, *, static: bool, given: bool
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
        """Returns messages about frames that no stream has placed for a while; each once."""
        words = []
        assumed = self.tree.assumed() if self._waiting else {}
        for frame, since in list(self._waiting.items()):
            if frame not in assumed:
                del self._waiting[frame]
            elif stamp - since >= ASSUMPTION_GRACE:
                del self._waiting[frame]
                reason = self.tree.reason(frame)
                where = f"so that {reason} agree at first" if reason else f"at the origin of {assumed[frame]!r}"
                words.append(f"frame {frame!r} is not placed by any stream: drawn {where}")
        return words


def frame_entity(frame: str) -> str:
    """The entity that places a frame: always the same, as Rerun demands."""
    return f"{FRAMES}/{rr.escape_entity_path_part(frame)}"


def entity_of(stream: str) -> str:
    """The entity of a stream: its name as a path."""
    return "/" + "/".join(rr.escape_entity_path_part(part) for part in stream.split("/") if part)
