"""Messages that an operator makes without stamp and frame: they are those of the firing and of its anchor."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from example_messages import example

from dataflow.execution.failure import OperatorFailure
from dataflow.messages import Alarm, Image, Message, Number, Point, PointCloud, message_types
from dataflow.operator import In, Operator, Out, Outputs, Source
from dataflow.testing import play


class Again(Operator):
    """Makes every message anew, without its stamp and without a frame that may be left out."""

    x: In[Message]
    y: Out[Message]

    def process(self, x: Message) -> Message:
        left_out = {"stamp", *(f.name for f in x.SCALARS if f.anchored)}
        return type(x)(**{name: value for name, value in x.items() if name not in left_out})


def test_of_every_type_a_message_made_from_its_like_is_the_same_bit_for_bit() -> None:
    for cls in message_types().values():
        if not cls.__module__.startswith("dataflow.messages."):
            continue
        for seed in range(8):
            message = example(cls, seed)
            (made,) = play(Again(), {"x": [message]})["y"]
            assert made is not message
            assert made.digest() == message.digest(), message


def point(stamp: int, frame: str) -> Point:
    return Point(stamp=stamp, frame=frame, position=[0, 0, 0])


class Centre(Operator, tolerance="10ns"):
    left: In[Point]
    right: In[Point]
    out: Out[Point]

    def process(self, left: Point, right: Point) -> Point:
        return Point(position=left.position)


class Either(Operator, merge=True):
    left: In[Point]
    right: In[Point]
    out: Out[Point]

    def process(self, left: Point | None, right: Point | None) -> Point:
        return Point(position=[1, 2, 3])


class Each(Operator):
    points: In[Point] = In(many=True)
    out: Out[Point]

    def process(self, points: Mapping[str, Point]) -> Point:
        return Point(position=[len(points), 0, 0])


def places(messages: list[Message]) -> list[tuple[int, Any]]:
    return [(m.stamp, getattr(m, "frame", None)) for m in messages]


def test_of_a_join_the_first_input_gives_stamp_and_frame() -> None:
    played = play(Centre(), {"left": [point(10, "l")], "right": [point(13, "r")]})
    assert places(played["out"]) == [(10, "l")]


def test_of_a_merge_whatever_came_gives_the_frame() -> None:
    played = play(Either(), {"left": [point(1, "l"), point(3, "b")], "right": [point(2, "r"), point(3, "b")]})
    assert places(played["out"]) == [(1, "l"), (2, "r"), (3, "b")]
    assert places(play(Each(), {"points": {"a": [point(1, "f")], "b": [point(1, "f")]}})["out"]) == [(1, "f")]


class Ticking(Operator, every="10ns"):
    image: In[Image]
    where: Out[Point]

    def process(self, image: Image | None) -> Point:
        return Point(position=[0, 0, 0])


class Unframed(Operator):
    number: In[Number]
    out: Out[Point]

    def process(self, number: Number) -> Point:
        return Point(position=[0, 0, 0])


class Closing(Operator):
    number: In[Number]
    sum: Out[Number]
    where: Out[Point]

    def process(self, number: Number) -> None:
        return None

    def finish(self) -> Outputs:
        return {"where": Point(position=[0, 0, 0])}


IMAGES = [Image(stamp=t, frame="c", data=np.zeros((2, 2), np.uint8)) for t in (5, 15)]


@pytest.mark.parametrize(
    ("operator", "streams", "why"),
    [
        (Either(), {"left": [point(1, "l")], "right": [point(1, "r")]}, r"differ: test/left/messages 'l', test/right"),
        (Each(), {"points": {"a": [point(1, "f")], "b": [point(1, "g")]}}, r"differ: test/points/a 'f'"),
        (Ticking(), {"image": IMAGES}, r"no message triggered .* but a tick"),
        (Unframed(), {"number": [Number(stamp=1, value=0)]}, "the anchor, a Number, has none"),
        (Closing(), {"number": [Number(stamp=1, value=0)]}, r"finish\(\) has no anchor"),
    ],
)
def test_undeterminable_frame_is_an_error_with_its_reason(
    operator: Operator, streams: dict[str, Any], why: str
) -> None:
    with pytest.raises(OperatorFailure, match=rf"emitted Point without frame, and .*{why}.*; give frame="):
        play(operator, streams)


def test_a_tick_and_the_end_have_a_stamp() -> None:
    class Counting(Operator, every="10ns"):
        number: In[Number]
        count: Out[Number]

        def process(self, number: Number | None) -> Number:
            return Number(value=0 if number is None else number.value)

        def finish(self) -> Outputs:
            return Number(value=-1)

    played = play(Counting(), {"number": [Number(stamp=5, value=7), Number(stamp=25, value=8)]})
    assert [(n.stamp, n.value) for n in played["count"]] == [(5, 7), (10, 0), (20, 0), (25, 8), (26, -1)]


@dataclass
class Held:
    last: Number | None = None


class Keeping(Operator):
    """Keeps what it emits, and compares the next one with it."""

    number: In[Number]
    pace: Out[Number]
    held: Out[Number]
    state: Held

    def process(self, number: Number) -> Outputs:
        before, self.state.last = self.state.last, Number(value=number.value)
        pace = 0 if before is None else number.stamp - before.stamp
        return {"pace": Number(value=pace), "held": self.state.last}


def test_a_message_that_is_kept_has_its_stamp_at_the_next_firing_and_in_snapshots() -> None:
    operator = Keeping()
    played = play(operator, {"number": [Number(stamp=3, value=1), Number(stamp=8, value=1)]})
    assert [n.value for n in played["pace"]] == [0, 5]
    later = Keeping()
    later.restore(operator.snapshot())
    assert later.state.last == Number(stamp=8, value=1)


class Silent(Source):
    """Gives no stamp, or no frame."""

    number: Out[Number] = Out()
    cloud: Out[PointCloud] = Out()

    def stream(self) -> Iterator[dict[str, Message]]:
        yield {"number": Number(stamp=1, value=0), "cloud": PointCloud(stamp=1, points=np.zeros((0, 3)))}


class Unstamped(Source):
    number: Out[Number] = Out()

    def stream(self) -> Iterator[dict[str, Number]]:
        yield {"number": Number(value=0)}


class Fixed(Operator):
    number: In[Number]
    alarm: Out[Alarm] = Out(static=True)

    def static_outputs(self) -> dict[str, Message]:
        return {"alarm": Alarm(level="info", name="a")}

    def process(self, number: Number) -> None: ...


@pytest.mark.parametrize(
    ("operator", "message"),
    [
        (Unstamped(), r"Unstamped\.number emitted Number without stamp: stream\(\) is no firing .*give stamp="),
        (Silent(), r"Silent\.cloud emitted PointCloud without frame: stream\(\) is no firing .*give frame="),
        (Fixed(), r"Fixed\.alarm emitted Alarm without stamp: static_outputs\(\) is no firing .*give stamp="),
    ],
)
def test_messages_emitted_outside_firings_need_stamp_and_frame(operator: Operator, message: str) -> None:
    with pytest.raises(OperatorFailure, match=message):
        play(operator, None if isinstance(operator, Source) else {"number": [Number(stamp=1, value=0)]})


def test_call_without_runner_leaves_stamp_and_frame_unset() -> None:
    made = Unframed().process(Number(stamp=1, value=0))
    assert made.position.tolist() == [0, 0, 0]
    with pytest.raises(ValueError, match=r"Point has no frame: .* when process\(\) returns the message"):
        print(made.frame)
