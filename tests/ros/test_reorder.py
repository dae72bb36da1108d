"""Messages of several publishers in the order of their stamps."""

from __future__ import annotations

from dataflow.interop.clocks import BACK
from dataflow.messages import Message, Number, Transforms
from dataflow.ros.reorder import Reorder

A, B = b"a" * 16, b"b" * 16


def number(stamp: int) -> Number:
    return Number(stamp=stamp, value=0.0, unit="")


def transform(stamp: int, child: str) -> Transforms:
    place = {"translations": [[0.0, 0.0, 0.0]], "rotations": [[0.0, 0.0, 0.0, 1.0]]}
    return Transforms(stamp=stamp, frames=("base",), child_frames=(child,), **place)


def given(order: Reorder, now: float) -> list[Message]:
    found = []
    while (message := order.take(now)) is not None:
        found.append(message)
    return found


def stamps(order: Reorder, now: float) -> list[int]:
    return [message.stamp for message in given(order, now)]


def test_without_a_wait_messages_go_on_at_once_and_late_ones_are_counted() -> None:
    order = Reorder(0.0)
    order.put(number(10), A, 0.0)
    assert stamps(order, 0.0) == [10]
    order.put(number(7), B, 0.0)
    assert stamps(order, 0.0) == []
    assert (order.late, order.behind) == (1, 3)


def test_within_the_wait_stamps_decide() -> None:
    order = Reorder(0.02)
    for stamp, who, now in ((20, A, 0.0), (10, B, 0.01), (30, A, 0.015)):
        order.put(number(stamp), who, now)
    assert stamps(order, 0.019) == []
    assert order.due_in(0.019) == 0.02 - 0.019
    assert stamps(order, 0.02) == [10, 20]
    assert stamps(order, 0.04) == [30]
    assert order.due_in(1.0) is None
    assert order.late == 0


def test_transforms_of_one_stamp_become_one_message() -> None:
    order = Reorder(0.02)
    order.put(transform(5, "lidar"), A, 0.0)
    order.put(transform(5, "camera"), B, 0.01)
    assert [m.child_frames for m in given(order, 0.02)] == [("lidar", "camera")]


def test_a_clock_that_is_set_back_is_followed() -> None:
    order = Reorder(0.02)
    order.put(number(10**12), A, 0.0)
    order.put(number(5), A, 0.001)  # the simulator was reset
    order.put(number(6), B, 0.002)
    assert stamps(order, 0.1) == [10**12, 5, 6]
    order = Reorder(0.0)
    order.put(number(10**12), A, 0.0)
    assert stamps(order, 0.0) == [10**12]
    order.put(number(5), B, 0.0)  # and was started anew
    assert stamps(order, 0.0) == [5]
    assert order.late == 0


def test_a_stamp_of_a_wrong_clock_silences_the_others_for_ten_messages() -> None:
    order = Reorder(0.0)
    came = []
    second = 10**9
    for stamp, who in [(second, A), (2**31 * second, B), *((second * n, A) for n in range(2, 20))]:
        order.put(number(stamp), who, 0.0)
        came += stamps(order, 0.0)
    assert came == [second, 2**31 * second, *(second * n for n in range(11, 20))]
    assert order.late == 9
    assert order.behind > BACK


def test_late_ones_that_are_near_show_no_wrong_clock() -> None:
    order = Reorder(0.0)
    second = 10**9
    order.put(number(100 * second), B, 0.0)
    assert stamps(order, 0.0) == [100 * second]
    for stamp in range(95 * second, 97 * second, second // 10):
        order.put(number(stamp), A, 0.0)
    assert (order.late, stamps(order, 0.0)) == (20, [])


def test_a_second_message_of_a_stamp_is_repeated_and_not_late() -> None:
    order = Reorder(0.0)
    for who in (A, B):
        order.put(number(10), who, 0.0)
    order.put(number(20), A, 0.0)
    assert stamps(order, 0.0) == [10, 20]
    order.put(number(20), B, 0.0)
    assert (order.late, order.repeated) == (0, 2)
    order.put(transform(20, "lidar"), B, 0.0)  # a longer wait would have joined it
    assert (order.late, order.repeated) == (1, 2)
