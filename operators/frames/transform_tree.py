"""Poses looked up in a tree of frames, as an operator."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from dataflow.messages import Diagnostics, Message, Odometry, Pose, Transforms
from dataflow.messages.diagnostics import Level
from dataflow.operator import Context, Counts, Duration, In, Operator, Out, Param, Sampled
from operators.geometry.frame_tree import FrameTree, TransformError, told_by
from operators.status import counted_status

LAG = "1s"
_MAY_STILL_COME = ("unknown frame", "not connected", "too late")


@dataclass(kw_only=True)
class State(Counts):
    """Holds the transforms, the stamps still asked for, and the present, ns."""

    tree: FrameTree
    asked: deque[int] = field(default_factory=deque)
    now: int = 0


class TransformTree(Operator, merge=True):
    """Joins fixed and moving transforms into one tree, and gives the pose of one frame in another when asked.

    A pose is asked for at the stamp of every message of `at`, and answered as soon as all transforms on the way are
    known at that stamp or after it: between two stamps they are interpolated on SE(3), at a constant twist. One answer
    is given at a time, oldest first, stamped as the question. A question that cannot be answered in time is dropped;
    one before a transform's first stamp or in a gap, at once. A transform that is not finite or contradicts the tree (a
    loop, a second parent, a repeated stamp) is left out. Status names and counts each.

    Method: Foote, "tf: the transform library", 2013; REP 105 for the tree's shape.
    """

    moving: In[Transforms | Pose | Odometry] = In(many=True, doc="transforms, poses, odometry: frames that move")
    at: In[Message] = In(doc="messages at whose stamps a pose is asked for, as a LiDAR's clouds")
    fixed: Sampled[Transforms] = Sampled(many=True, required=False, doc="frames that do not move: extrinsics")
    pose: Out[Pose] = Out(lag=LAG, doc="`child` in `frame` at the stamps asked for")
    status: Out[Diagnostics] = Out(doc="whenever a question is dropped or a transform left out: which, why, counts")

    frame: str = Param(min_length=1, doc="frame in which the pose is given")
    child: str = Param(min_length=1, doc="frame whose pose is given")
    patience: Duration = Param("500ms", ge=0, le=1_000_000_000, doc="how long a question waits for transforms to come")
    gap: Duration = Param("1s", gt=0, doc="transforms farther apart in time are not interpolated between")
    extrapolation: Duration = Param("0s", ge=0, doc="how far beyond its newest stamp a transform goes on as it moved")
    state: State

    def initial_state(self) -> State:
        return State(tree=FrameTree(gap=self.gap, reach=self.extrapolation))

    def setup(self) -> None:
        self._fixed: dict[str, Transforms] = {}

    def on_reset(self, input: str) -> None:
        """The clock of a stream began anew: nothing before it can be interpolated with."""
        super().on_reset(input)
        self._fixed = {}

    def process(
        self,
        moving: Mapping[str, Message],
        at: Message | None,
        context: Context,
        fixed: Mapping[str, Transforms] | None = None,
    ) -> dict[str, Any]:
        """Raises TransformError where fixed transforms contradict each other or the tree."""
        self.state.now = context.stamp
        self._take_fixed(fixed or {})
        notes = self._take_moving(moving or {})
        if at is not None:
            self.state.asked.append(at.stamp)
            self.state.counts["asked"] += 1
        return self._settle(notes)

    def finish(self) -> dict[str, Any]:
        """Answers one question more where it can; what remains is counted."""
        messages = self._settle([])
        self.state.counts["unanswered at the end"] += len(self.state.asked)
        self.state.asked.clear()
        return messages

    def summary(self) -> Mapping[str, float | int]:
        return {name: count for name, count in self.state.counts.items() if count}

    def _take_fixed(self, fixed: Mapping[str, Transforms]) -> None:
        for stream, transforms in fixed.items():
            if self._fixed.get(stream) is not transforms:
                for told in told_by(transforms):
                    self.state.tree.fix(*told)
                self._fixed[stream] = transforms

    def _take_moving(self, moving: Mapping[str, Message]) -> list[str]:
        notes: list[str] = []
        for message in moving.values():
            assert isinstance(message, Transforms | Pose | Odometry)
            for told in told_by(message):
                try:
                    self.state.tree.add(message.stamp, *told)
                except TransformError as error:
                    self._drop(f"left out: {error.reason}", str(error), notes)
        return notes

    def _settle(self, notes: list[str]) -> dict[str, Any]:
        """Answers the oldest question that can be answered, and drops those that cannot or have waited too long."""
        messages: dict[str, Any] = {}
        while self.state.asked:
            stamp = self.state.asked[0]
            try:
                T = self.state.tree.lookup(self.frame, self.child, stamp)
            except TransformError as error:
                if error.reason in _MAY_STILL_COME and self.state.now - stamp < self.patience:
                    break
                self._drop(f"dropped: {error.reason}", str(error), notes)
                self.state.asked.popleft()
                continue
            self.state.asked.popleft()
            if self.state.now - stamp > self.spec.outputs["pose"].lag:
                self._drop("dropped: answered too late", f"the answer for {stamp} came more than {LAG} later", notes)
                continue
            self.state.counts["answered"] += 1
            messages["pose"] = Pose.from_matrix(T, stamp=stamp, frame=self.frame, child_frame=self.child)
            break
        if notes:
            messages["status"] = self._status(notes)
        return messages

    def _drop(self, count: str, text: str, notes: list[str]) -> None:
        self.state.counts[count] += 1
        notes.append(text)

    def _status(self, notes: list[str]) -> Diagnostics:
        more = f" (and {len(notes) - 1} more)" if len(notes) > 1 else ""
        return counted_status("transform_tree", self.state.now, notes[0] + more, Level.WARN, self.state.counts)
