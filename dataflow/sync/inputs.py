"""The inputs of one aligner: the streams that feed them, and the lanes from streams into inputs."""

from __future__ import annotations

from collections.abc import Mapping

from dataflow.sync.lanes import Lane, Role, StreamState
from dataflow.sync.spec import AlignSpec
from dataflow.sync.stamps import FOREVER


class Inputs:
    """Holds the streams and lanes that an `AlignSpec` names. A stream that feeds several inputs has a lane to each."""

    __slots__ = ("lanes", "streams")

    def __init__(self, spec: AlignSpec) -> None:
        self.streams = {name: StreamState(name, name in spec.static) for name in sorted(spec.streams)}
        """The state of each stream, by its name."""
        self.lanes: dict[str, tuple[Lane, ...]] = {}
        """The lanes into each input, in the order of their streams' names."""
        for trigger in spec.triggers:
            self._add(trigger.name, "trigger", trigger.streams)
        for sampled in spec.sampled:
            self._add(sampled.name, "sampled", sampled.streams, sampled.before or 0)
        for batch in spec.batches:
            self._add(batch.name, "batch", batch.streams)

    def _add(self, name: str, role: Role, streams: tuple[str, ...], delay: int = 0) -> None:
        self.lanes[name] = tuple(Lane(name, role, self.streams[stream], delay) for stream in sorted(streams))
        for lane in self.lanes[name]:
            lane.state.lanes.append(lane)

    def stream(self, name: str) -> StreamState:
        """The state of a stream. Raises KeyError for one that feeds no input."""
        state = self.streams.get(name)
        if state is None:
            raise KeyError(f"stream {name!r} feeds no input; those that do: {', '.join(self.streams)}")
        return state

    def force(self, input: str, frontier: int) -> bool:
        """Raises the frontier of an input's lanes, but for those of static streams; False when that is no news."""
        if input not in self.lanes:
            raise KeyError(f"no input {input!r}; the inputs are {', '.join(self.lanes)}")
        frontier = min(frontier, FOREVER - 1)
        moved = [lane for lane in self.lanes[input] if not lane.state.static and frontier > lane.frontier]
        for lane in moved:
            lane.frontier = frontier
        return bool(moved)

    def awaits_static(self, needs: Mapping[str, int]) -> list[str]:
        """Names the inputs that lack a static stream for the frontier that they need."""
        return [
            name
            for name, frontier in needs.items()
            if any(lane.state.static and lane.frontier < frontier for lane in self.lanes[name])
        ]

    def buffered(self) -> dict[str, int]:
        """The number of messages held, by input."""
        return {name: sum(len(lane.entries) for lane in lanes) for name, lanes in self.lanes.items()}
