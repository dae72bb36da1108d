"""The canvas on which a visualiser draws: one stream's entity, at one stamp; and the registry of visualisers by message
class."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

import numpy as np
import numpy.typing as npt
import rerun as rr

from dataflow.messages import Message, Odometry, Pose, Transforms
from dataflow.view import colors
from dataflow.view.frames import FrameCycleError, FramePriority
from dataflow.view.layout import is_truth
from dataflow.view.scene import TIMELINE, VIEWER_LOG, Placed, SceneState

NAMELESS = "(no frame)"
"""Stands for the empty frame name, which Rerun does not take."""

Role = Literal["image", "overlay", "space", "plot", "log", "graph", "map", "tensor", "status", "text"]
"""The views in which a type appears. `image` is drawn at the stream's entity itself, all else at `<entity>/<role>`."""


@dataclass(frozen=True, slots=True)
class Canvas:
    """One message being drawn."""

    recording: rr.RecordingStream
    entity: str
    stream: str
    stamp: int
    scene: SceneState

    @property
    def static(self) -> bool:
        """Returns whether the message holds for all time."""
        return self.stream in self.scene.layout.static

    @property
    def plane(self) -> str:
        """The image plane that the stream's pixels lie in."""
        return self.scene.layout.planes.get(self.stream, f"image:{self.stream}")

    def log(self, path: str, *archetypes: rr.AsComponents, static: bool | None = None) -> None:
        """Logs at `<entity>/<path>` (the entity itself for "")."""
        entity = f"{self.entity}/{path}" if path else self.entity
        self.recording.log(entity, *archetypes, static=self.static if static is None else static)

    def draw(self, path: str, frame: str, *archetypes: rr.AsComponents) -> None:
        """Logs at `<entity>/<path>`, in the coordinates of a named frame; the path's own in an image plane."""
        if not frame:
            self.notice("its messages name no frame; they are drawn at the root")
            frame = NAMELESS
        if frame != self.plane:
            self.scene.see(self.recording, frame, self.stamp)
        if path.startswith("space"):
            self.begin("space")
        self._begin(path, frame)
        self.log(path, rr.CoordinateFrame(frame), *archetypes)

    def _begin(self, path: str, frame: str) -> None:
        """Logs from the beginning on in which frame a path is drawn: a viewer asks also where nothing is yet."""
        begin = self.scene.begin
        if self.static or begin is None or begin >= self.stamp or not self.scene.changed(self.entity, f"/{path}", True):
            return
        self.recording.set_time(TIMELINE, timestamp=np.datetime64(begin, "ns"))
        self.log(path, rr.CoordinateFrame(frame))
        self.recording.set_time(TIMELINE, timestamp=np.datetime64(self.stamp, "ns"))

    def begin(self, part: str) -> None:
        """Notes that a part of the stream is drawn (`space`, `plot/NAME`), so that it gets its view."""
        self.scene.new_parts |= self.scene.changed(self.entity, part, True)

    def clear(self, path: str) -> None:
        """Takes away what was drawn at `<entity>/<path>` before, and below."""
        if not self.static:
            self.log(path, rr.Clear(recursive=True))

    def plot(self, path: str, values: Sequence[float] | npt.NDArray[Any], names: Sequence[str]) -> None:
        """One curve per name at `<entity>/plot/<path>`. Values that are not finite leave gaps."""
        where = f"plot/{path}"
        if not len(values):
            return
        self.scene.new_parts |= (self.entity, where) not in self.scene.remembered
        if self.scene.changed(self.entity, where, tuple(names)):
            paint = colors.AXES if len(names) == 3 else colors.of_classes(names)
            self.log(where, rr.SeriesLines(names=list(names), colors=paint), static=True)
        self.log(where, rr.Scalars(np.asarray(values, np.float64)))

    def text(self, text: str, level: str = "INFO") -> None:
        """One line in the text log."""
        self.log("log", rr.TextLog(text, level=level))

    def notice(self, text: str, level: str = "WARN") -> None:
        """Logs once that this stream is not shown as it is."""
        if self.scene.once(self.stream, text):
            self.recording.log(VIEWER_LOG, rr.TextLog(f"{self.stream}: {text}", level=level))

    def place_frames(self, message: Message) -> None:
        """Places the frames of a message, and draws nothing."""
        match message:
            case Transforms():
                for frame, child, T in zip(message.frames, message.child_frames, message.matrices(), strict=True):
                    self.place(frame, child, T, tree=True)
            case Pose() | Odometry() if message.child_frame and message.child_frame != message.frame:
                self.place(message.frame, message.child_frame, message.matrix())

    def place(self, parent: str, child: str, T_parent_child: npt.NDArray[np.float64], *, tree: bool = False) -> None:
        """Places `child` by `T_parent_child` (4×4). `tree`: from a stream of transforms, which goes first.

        What cannot be (a frame within itself) is not drawn, and said once.
        """
        rank = FramePriority.TREE if tree else FramePriority.TRUTH if is_truth(self.stream) else FramePriority.ESTIMATE
        frames = parent or NAMELESS, child or NAMELESS
        try:
            pose = Placed(*frames, T_parent_child, self.stream, rank, self.stamp, self.static)
            self.scene.place(self.recording, pose)
        except FrameCycleError as error:
            self.notice(str(error))


M = TypeVar("M", bound=Message)
Visualizer = Callable[[Canvas, Any], None]

VISUALIZERS: dict[type[Message], Visualizer] = {}
ROLES: dict[type[Message], tuple[Role, ...]] = {}
PLOTS: dict[type[Message], tuple[str, ...]] = {}


def visualizer(
    message_type: type[M], *roles: Role, plots: tuple[str, ...] = ()
) -> Callable[[Callable[[Canvas, M], None]], Callable[[Canvas, M], None]]:
    """Registers the function that draws a message type; it appears in the views of `roles`.

    `plots`: the curves at `<entity>/plot/<name>` that get separate axes; none: all share one plot. A package with
    custom message types registers theirs the same way. Subclasses inherit.
    """

    def register(function: Callable[[Canvas, M], None]) -> Callable[[Canvas, M], None]:
        VISUALIZERS[message_type] = function
        ROLES[message_type] = roles
        PLOTS[message_type] = plots
        return function

    return register
