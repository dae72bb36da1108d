"""The rules one by one, by hand."""

from __future__ import annotations

import pytest

from dataflow.sync import (
    FOREVER,
    NEVER,
    TICK,
    Aligner,
    AlignSpec,
    BatchSpec,
    Entry,
    Firing,
    InputValue,
    SampledSpec,
    StreamOrderError,
    TriggerSpec,
)

from .scenarios import poll_all, push

A = TriggerSpec("a", ("a",))
B = TriggerSpec("b", ("b",))


def shape(value: InputValue) -> object:
    """The stamps in an input's value."""
    if isinstance(value, Entry):
        return value.stamp
    if value is None:
        return None
    if isinstance(value, tuple):
        return [entry.stamp for entry in value]
    return {stream: entry.stamp for stream, entry in value.items()}


def seen(firings: list[Firing]) -> list[tuple[int, dict[str, object]]]:
    return [(f.stamp, {name: shape(value) for name, value in f.inputs.items()}) for f in firings]


def test_a_single_trigger_fires_on_every_message_at_once() -> None:
    aligner = Aligner(AlignSpec((A,)))
    push(aligner, "a", 1, 5)
    assert seen(poll_all(aligner)) == [(1, {"a": 1}), (5, {"a": 5})]
    assert aligner.output_frontier() == 5


def test_merge_groups_messages_of_one_stamp_in_declared_then_key_order() -> None:
    aligner = Aligner(AlignSpec((TriggerSpec("many", ("z", "y"), many=True), A), mode="merge"))
    push(aligner, "z", 2, 3)
    push(aligner, "a", 2, 4)
    assert aligner.poll() is None  # y may still have a message at 2
    push(aligner, "y", 2)
    first, *_ = fired = poll_all(aligner)
    assert seen(fired) == [(2, {"many": {"y": 2, "z": 2}, "a": 2})]
    assert list(first.inputs) == ["many", "a"]
    assert isinstance(first.inputs["many"], dict)
    assert list(first.inputs["many"]) == ["y", "z"]
    aligner.advance("y", 3)
    assert seen(poll_all(aligner)) == [(3, {"many": {"z": 3}, "a": None})]


@pytest.mark.parametrize(
    ("before", "enough", "taken"),
    [(None, 10, 10), (1, 9, 9), (4, 6, 6)],  # stamp <= t, stamp < t, stamp <= t - D
)
def test_sampled_input_is_decided_once_its_frontier_passes_the_delay(
    before: int | None, enough: int, taken: int
) -> None:
    aligner = Aligner(AlignSpec((A,), (SampledSpec("x", ("x",), before=before),)))
    push(aligner, "x", *range(1, enough))
    push(aligner, "a", 10)
    assert aligner.poll() is None
    assert aligner.output_frontier() == 9
    aligner.push("x", Entry(enough))
    assert seen(poll_all(aligner)) == [(10, {"a": 10, "x": taken})]


def test_missing_or_stale_required_sample_drops_the_trigger_with_reason() -> None:
    aligner = Aligner(AlignSpec((A,), (SampledSpec("x", ("x",), max_age=5),)))
    aligner.advance("x", 1)
    push(aligner, "a", 1, 7, 8)
    push(aligner, "x", 2)
    aligner.advance("x", 8)
    assert seen(poll_all(aligner)) == [(7, {"a": 7, "x": 2})]
    assert aligner.drops == {("a", "no_sample"): 1, ("a", "stale"): 1}
    assert [(d.stamp, d.reason, d.because) for d in aligner.take_drops()] == [(1, "no_sample", "x"), (8, "stale", "x")]


def test_an_optional_sample_that_is_stale_is_absent_and_flagged() -> None:
    aligner = Aligner(AlignSpec((A,), (SampledSpec("x", ("x",), max_age=5, required=False),)))
    push(aligner, "x", 1)
    aligner.advance("x", 20)
    push(aligner, "a", 6, 7)
    fresh, stale = poll_all(aligner)
    assert (shape(fresh.inputs["x"]), fresh.stale) == (1, frozenset())
    assert (shape(stale.inputs["x"]), stale.stale) == (None, {"x"})


def test_batch_holds_the_messages_since_the_last_firing() -> None:
    aligner = Aligner(AlignSpec((A,), batches=(BatchSpec("imu", ("imu",)),)))
    push(aligner, "imu", 1, 2, 3, 4, 5, 6)
    push(aligner, "a", 2, 3, 5)
    assert [v["imu"] for _, v in seen(poll_all(aligner))] == [[1, 2], [3], [4, 5]]


def test_a_batch_waits_for_the_next_firing_when_this_one_is_dropped() -> None:
    spec = AlignSpec((A,), (SampledSpec("x", ("x",)),), (BatchSpec("imu", ("imu",)),))
    aligner = Aligner(spec)
    push(aligner, "imu", 1, 2, 3, 4)
    push(aligner, "a", 2, 4)
    aligner.advance("x", 2)
    push(aligner, "x", 4)
    assert [v["imu"] for _, v in seen(poll_all(aligner))] == [[1, 2, 3, 4]]


def test_bounds_of_a_batch_keep_the_newest_and_count_the_rest() -> None:
    aligner = Aligner(AlignSpec((A,), batches=(BatchSpec("imu", ("imu",), max=3, max_age=4),)))
    push(aligner, "imu", 1, 2, 3, 4, 5, 11)
    push(aligner, "a", 5, 14, 20)
    aligner.advance("imu", 20)
    assert [v["imu"] for _, v in seen(poll_all(aligner))] == [[3, 4, 5], [11], []]
    assert aligner.drops == {("imu", "unused"): 2}


def test_ticks_lie_on_the_grid_and_join_firings() -> None:
    aligner = Aligner(AlignSpec((A,), every=10))
    push(aligner, "a", 5, 20, 34)
    aligner.end("a", 41)
    *fired, finish = poll_all(aligner)
    assert [(f.stamp, f.kind, f.tick) for f in fired] == [
        (5, "fire", False),
        (10, "tick", True),
        (20, "fire", True),
        (30, "tick", True),
        (34, "fire", False),
        (40, "tick", True),
    ]
    assert (finish.stamp, finish.kind) == (42, "finish")


def test_an_operator_with_only_ticks_reads_its_inputs_at_the_ticks_stamp() -> None:
    spec = AlignSpec((), (SampledSpec("x", ("x",)),), (BatchSpec("imu", ("imu",)),), every=10)
    aligner = Aligner(spec)
    push(aligner, "x", 3, 12, 21)
    push(aligner, "imu", 4, 8, 13, 20)
    assert seen(poll_all(aligner)) == [(10, {"x": 3, "imu": [4, 8]}), (20, {"x": 12, "imu": [13, 20]})]


def test_a_tick_without_its_required_sample_is_dropped_as_a_tick() -> None:
    spec = AlignSpec((), (SampledSpec("x", ("x",)),), (BatchSpec("imu", ("imu",)),), every=10)
    aligner = Aligner(spec)
    push(aligner, "imu", 4, 10)
    aligner.advance("x", 10)
    assert aligner.poll() is None
    assert aligner.drops == {(TICK, "no_sample"): 1}


def test_a_static_message_reaches_the_first_firing_whatever_its_stamp_and_age() -> None:
    spec = AlignSpec((A,), (SampledSpec("info", ("info",), max_age=1),), static=frozenset({"info"}))
    aligner = Aligner(spec)
    push(aligner, "a", 5)
    aligner.force("info", 100)
    assert aligner.poll() is None  # waited for even live
    push(aligner, "info", 50)
    assert seen(poll_all(aligner)) == [(5, {"a": 5, "info": 50})]
    push(aligner, "a", 500)
    aligner.poll()
    push(aligner, "a", 900)
    with pytest.raises(StreamOrderError, match="one message"):
        push(aligner, "info", 60)
    assert seen(poll_all(aligner)) == [(900, {"a": 900, "info": 50})]


def test_the_output_frontier_follows_rule_3() -> None:
    aligner = Aligner(AlignSpec((A, B), (SampledSpec("x", ("x",), required=False),), mode="merge"))
    assert aligner.output_frontier() == NEVER
    aligner.advance("a", 10)
    aligner.advance("b", 20)
    assert aligner.output_frontier() == 10  # the minimum of the trigger frontiers; x does not bound it
    push(aligner, "a", 15)
    assert aligner.output_frontier() == 14  # an undecided candidate does: it waits for x
    aligner.advance("x", 15)
    assert aligner.output_frontier() == 14
    assert [f.stamp for f in poll_all(aligner)] == [15]
    assert aligner.output_frontier() == 15
    aligner.end("a", 15)
    assert aligner.output_frontier() == 20


def test_the_end_of_the_triggers_gives_one_finish_above_every_promise() -> None:
    aligner = Aligner(AlignSpec((A, B), (SampledSpec("x", ("x",), required=False),), mode="merge"))
    aligner.advance("x", 100)
    push(aligner, "a", 5)
    aligner.advance("b", 9)
    aligner.end("a", 7, "end of file")
    assert [f.stamp for f in poll_all(aligner)] == [5]
    assert not aligner.ended()
    assert aligner.output_frontier() == 9
    aligner.end("b", 9)
    assert aligner.output_frontier() == 9
    assert poll_all(aligner) == [Firing(10, "finish")]
    assert aligner.ended()
    assert aligner.final_stamp() == 9
    assert (aligner.poll(), aligner.output_frontier()) == (None, FOREVER)
    assert aligner.ends["a"].reason == "end of file"


def test_an_operator_without_any_message_still_finishes() -> None:
    aligner = Aligner(AlignSpec((A,), (SampledSpec("x", ("x",)),), every=10))
    aligner.end("x")
    aligner.end("a")
    assert poll_all(aligner) == [Firing(0, "finish")]


def test_a_stream_that_breaks_its_promise_is_an_error_that_names_it() -> None:
    aligner = Aligner(AlignSpec((A,)))
    push(aligner, "a", 5)
    with pytest.raises(StreamOrderError, match=r"stream 'a': message 0 at 0.000000005s does not come after"):
        push(aligner, "a", 5)
    aligner.advance("a", 9)
    with pytest.raises(StreamOrderError, match="breaks the promised frontier"):
        push(aligner, "a", 9)
    with pytest.raises(StreamOrderError, match="final stamp"):
        aligner.end("a", 8)
    aligner.end("a", 9)
    with pytest.raises(StreamOrderError, match="has ended"):
        push(aligner, "a", 20)
    with pytest.raises(KeyError, match="feeds no input; those that do: a"):
        push(aligner, "q", 20)
    with pytest.raises(KeyError, match="no input 'q'"):
        aligner.force("q", 3)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: AlignSpec(), "nothing would ever make it fire"),
        (lambda: AlignSpec((A,), tolerance=3), "at least two triggers"),
        (lambda: AlignSpec((A, TriggerSpec("m", ("x", "y"), many=True))), "use merge"),
        (lambda: AlignSpec((A, B), static=frozenset("b")), "declare it Sampled"),
        (lambda: AlignSpec((), (SampledSpec("x", ("x",), before=1),), every=10), "neither static nor `before`"),
        (lambda: TriggerSpec("a", ("x", "y")), "exactly one stream"),
        (lambda: TriggerSpec("a", ("x", "x"), many=True), "named twice"),
        (lambda: BatchSpec("x", ("x",), max=0), "at least 1 message"),
    ],
)
def test_a_declaration_that_means_nothing_is_refused(build: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        build()


def test_sampled_streams_buffer_only_messages_of_future_firings() -> None:
    spec = AlignSpec((A,), (SampledSpec("x", ("x",), before=20),), (BatchSpec("imu", ("imu",), max=5),))
    aligner = Aligner(spec)
    peak = dict.fromkeys(("x", "imu"), 0)
    for stamp in range(1, 5000):
        aligner.push("x", Entry(stamp, seq=stamp))
        aligner.push("imu", Entry(stamp, seq=stamp))
        aligner.advance("a", stamp)  # the trigger is silent: nothing ever fires
        held = aligner.buffered()
        peak = {name: max(peak[name], held[name]) for name in peak}
    assert peak["x"] <= 64
    assert peak["imu"] <= 64
    aligner.push("a", Entry(5000))
    aligner.push("x", Entry(5000, seq=5000))
    aligner.push("imu", Entry(5000, seq=5000))
    assert seen(poll_all(aligner)) == [(5000, {"a": 5000, "x": 4980, "imu": list(range(4996, 5001))})]


def test_join_buffers_only_messages_a_future_anchor_can_match() -> None:
    aligner = Aligner(AlignSpec((A, B), tolerance=3))
    for stamp in range(1, 2000):
        aligner.push("b", Entry(stamp, seq=stamp))
        aligner.advance("a", stamp)
        aligner.poll()
        assert aligner.buffered()["b"] <= 2
    assert aligner.drops["b", "unmatched"] >= 1990
