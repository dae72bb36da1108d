"""A source: static messages come before the end of their stream, stamps are those of the supervisor's clock."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from firing_operators import Collector, node, value

from dataflow.execution.source import SourceRunner
from dataflow.messages import FeatureVector
from dataflow.operator import Out, Source


class Camera(Source):
    """Gives its calibration once, and two frames."""

    calibration: Out[FeatureVector] = Out(static=True)
    image: Out[FeatureVector]

    def static_outputs(self) -> Mapping[str, FeatureVector]:
        return {"calibration": value(0, 7.0)}

    def stream(self) -> Iterator[Mapping[str, FeatureVector]]:
        for stamp in (1000, 2000):
            yield {"image": value(stamp)}


class InOrder(Collector):
    """Also keeps in which order messages and ends came."""

    def __init__(self) -> None:
        super().__init__()
        self.order: list[str] = []

    def message(self, stream: str, entry: object) -> None:
        super().message(stream, entry)
        self.order.append(f"message of {stream}")

    def end(self, stream: str, final_stamp: int | None, reason: str) -> None:
        super().end(stream, final_stamp, reason)
        self.order.append(f"end of {stream}")


def camera(*, live: bool = False) -> tuple[SourceRunner, InOrder]:
    collector = InOrder()
    runner = SourceRunner(node(Camera, {}), collector, operator=Camera(), live=live)
    return runner, collector


def test_a_static_message_is_sent_before_its_stream_ends() -> None:
    runner, collector = camera()

    runner.setup()

    assert collector.order == ["message of t/n/calibration", "end of t/n/calibration"]


def test_stamps_of_another_machines_clock_become_those_of_the_supervisor() -> None:
    runner, _ = camera(live=True)
    runner.setup()
    runner.clock.measured(300, delay=0)  # ahead by 300 ns

    assert [step["image"].stamp for step in (runner.take(), runner.take()) if step is not None] == [700, 1700]
