"""States declared as data: snapshots, restoration and resets follow from the annotations."""

from __future__ import annotations

import enum
from collections import Counter, defaultdict, deque
from dataclasses import dataclass, field
from typing import Any, Generic, Literal, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dataflow.execution.snapshots import pack_state, unpack_state
from dataflow.messages import Number, Odometry
from dataflow.operator import KEPT, In, Operator, Out, Param, Remembered
from dataflow.state import Counts, StateError, of_another_version, plain, seen, state_hints, take_over, typed

V = TypeVar("V")


class Mode(enum.Enum):
    SEARCH = 1
    FOLLOW = 2


class Place(NamedTuple):
    stamp: int
    xyz: npt.NDArray[np.float64]


@dataclass(frozen=True)
class Track:
    id: int
    mean: npt.NDArray[np.float64]
    label: str | None = None
    mode: Mode = Mode.SEARCH


class Window(Remembered):
    values: list[float]

    def __init__(self, length: int = 3) -> None:
        self.length, self.values = length, []
        self.restored()

    def restored(self) -> None:
        self.total = sum(self.values)

    def add(self, value: float) -> None:
        self.values = [*self.values, value][-self.length :]
        self.restored()


@dataclass
class State:
    window: Window = field(default_factory=Window)
    tracks: dict[int, Track] = field(default_factory=dict)
    places: deque[Place] = field(default_factory=lambda: deque(maxlen=2))
    seen: set[str] = field(default_factory=set)
    pairs: dict[tuple[int, str], float] = field(default_factory=dict)
    ordered: dict[str, None] = field(default_factory=dict)
    by_id: defaultdict[int, list[float]] = field(default_factory=lambda: defaultdict(list))
    last: Odometry | None = None
    kind: Literal["a", "b"] = "a"
    raw: bytes = b""
    phase: complex = 0j
    single: np.float32 = field(default_factory=np.float32)
    spare: tuple[float, ...] = ()
    windows: dict[str, Window] = field(default_factory=dict)
    counts: Counter[str] = field(default_factory=Counter, metadata=KEPT)


class Averager(Operator):
    value: In[Number]
    mean: Out[Number]
    size: int = Param(3, ge=1, doc="how many values")
    state: State

    def initial_state(self) -> State:
        return State(window=Window(self.size))

    def process(self, value: Number) -> Number:
        self.state.window.add(value.value)
        self.state.counts["values"] += 1
        return Number(stamp=value.stamp, value=self.state.window.total / len(self.state.window.values))


class Ring(Remembered):
    """Values in an array with room to grow, and a window of each name, of the length that its owner sets."""

    values: npt.NDArray[np.float64]
    others: dict[str, Window]
    last: Window | None

    def __init__(self, length: int) -> None:
        self._length, self._used = length, 0
        self.values, self.others, self.last = np.zeros(8), {}, None

    def prepare_snapshot(self) -> None:
        self.values = self.values[: self._used]

    def new_part(self, kind: type[Any]) -> Any:
        assert kind is Window
        return Window(self._length)

    def restored(self) -> None:
        self._used = len(self.values)


@dataclass
class Rings:
    rings: tuple[Ring, Ring]
    by_name: dict[str, Ring]


class Ringing(Operator):
    value: In[Number]
    state: Rings

    def initial_state(self) -> Rings:
        return Rings((Ring(2), Ring(5)), {"a": Ring(6)})

    def new_part(self, kind: type[Any]) -> Any:
        assert kind is Ring
        return Ring(7)

    def process(self, value: Number) -> None:
        for ring in (*self.state.rings, self.state.by_name.setdefault("b", Ring(7))):
            ring.others["x"] = ring.last = Window(ring._length)


def number(stamp: int) -> Number:
    return Number(stamp=stamp, value=float(stamp))


def filled() -> State:
    odometry = Odometry(stamp=7, frame="odom", child_frame="base", position=np.arange(3.0), orientation=np.eye(4)[3])
    state = State(last=odometry, raw=b"\0\1", phase=1 + 2j, single=np.float32(0.1), spare=(1.0, 2.5), kind="b")
    state.tracks = {9: Track(9, np.arange(3.0), "cup", Mode.FOLLOW), 2: Track(2, np.zeros((0, 3)))}
    state.places.extend(Place(k, np.full(3, k, float)) for k in range(3))
    state.seen, state.pairs, state.ordered = {"b", "a"}, {(1, "near"): 0.5}, {"b": None, "a": None}
    state.by_id[4].append(1.5)
    state.windows["left"] = Window()
    state.windows["left"].add(2.0)
    state.counts["seen"] = 2
    return state


def round_trip(state: State) -> State:
    restored: State = typed(State, unpack_state(pack_state(plain(state))))
    return restored


def test_state_fields_of_every_kind_are_restored() -> None:
    state = filled()

    back = round_trip(state)

    assert plain_bytes(back) == plain_bytes(state)
    assert list(back.tracks) == [9, 2]  # the order of a mapping is part of it
    assert back.tracks[9].mode is Mode.FOLLOW
    assert back.places.maxlen == 2
    assert [type(back.by_id[5]), type(back.counts), back.counts["none"]] == [list, Counter, 0]
    assert back.last is not None
    assert back.last.digest() == state.last.digest()
    assert type(back.single) is np.float32
    assert back.windows["left"].total == 2.0


def plain_bytes(state: State) -> bytes:
    return pack_state(plain(state))


@settings(max_examples=60)
@given(st.lists(st.integers(0, 100), min_size=1, max_size=12), st.integers(1, 5), st.integers(0, 12))
def test_operator_restored_at_any_call_continues_identically(stamps: list[int], length: int, cut: int) -> None:
    whole, begun, later = (Averager(size=length) for _ in range(3))
    expected = [whole.process(number(s)).digest() for s in stamps]
    first = [begun.process(number(s)).digest() for s in stamps[:cut]]
    snapshot = begun.snapshot()
    assert snapshot is not None

    later.restore(unpack_state(pack_state(snapshot)))

    assert first + [later.process(number(s)).digest() for s in stamps[cut:]] == expected
    assert later.state.window.length == length


def test_state_parts_with_settings_are_restored_in_place() -> None:
    one, other = Ringing(), Ringing()
    one.process(number(1))
    first, second = other.state.rings

    other.restore(unpack_state(pack_state(one.snapshot() or {})))

    assert other.state.rings == (first, second)
    lengths = [ring.others["x"].length for ring in (first, second, other.state.by_name["b"])]
    assert lengths == [2, 5, 7]
    assert second.last is not None
    assert (second.last.length, other.state.by_name["a"].last) == (5, None)


@dataclass
class Counting(Counts):
    empty: bool = False


def test_counter_started_with_a_bool_is_restored() -> None:
    counting = Counting()
    counting.counts.update({"clouds without": True})
    packed = pack_state(plain(counting))
    later = Counting()
    take_over(later, state_hints(later), unpack_state(packed), lambda kind: kind())

    assert pack_state(plain(later)) == packed
    assert later.counts["clouds without"] == 1


def test_room_for_growth_is_not_part_of_a_snapshot() -> None:
    ring, back = Ring(2), Ring(2)
    ring.values[:2], ring._used = (1.0, 2.0), 2

    back.restore(unpack_state(pack_state(ring.snapshot())))

    assert (back.values.tolist(), back._used) == ([1.0, 2.0], 2)


def test_reset_clears_all_but_the_kept_state() -> None:
    operator = Averager()
    operator.process(number(3))

    operator.on_reset("value")

    assert (operator.state.window.values, operator.state.counts) == ([], {"values": 1})


def test_states_of_two_operators_share_nothing() -> None:
    one, other = Averager(), Averager()
    one.process(number(1))

    assert other.state.counts == {}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"kind": ...}, "snapshot of another version: the state of State has no kind, which the class has now"),
        ({"older": 1}, "snapshot of another version: the state of State has older, which the class has no more"),
        ({"raw": 3}, "State.raw: expected a bytes, got a int"),
        ({"spare": [1.0, "x"]}, r"State.spare\[1\]: expected a float, got a str"),
        ({"tracks": [[1, {"id": 1}]]}, r"the state of State.tracks\[1\] \(Track\) has no label, mean, mode"),
        ({"last": {"schema": "Nothing"}}, "unknown message schema"),
        ({"windows": [["left", {}]]}, "snapshot of another version: the state of Window has no values"),
        ({"windows": {"left": {}}}, "snapshot of another version: State.windows: expected a list"),
    ],
)
def test_a_snapshot_that_does_not_fit_is_refused_with_the_field(change: dict[str, Any], words: str) -> None:
    snapshot = {**plain(filled()), **change}
    operator = Averager()

    with pytest.raises(StateError, match=words):
        operator.restore({key: value for key, value in snapshot.items() if value is not ...})


def test_a_value_that_no_snapshot_can_hold_is_named_with_its_place() -> None:
    state = State()
    state.by_id[3] = [object()]

    with pytest.raises(StateError, match=r"state.by_id\[3\]\[0\] is a object; a state holds numbers"):
        plain(state)


def test_a_set_of_values_without_an_order_is_named_with_its_place() -> None:
    @dataclass
    class Holder:
        seen: set[object]

    with pytest.raises(StateError, match=r"state\.seen is a set of values that have no order; use a dict or a list"):
        plain(Holder({1, "a"}))


def test_a_state_whose_fields_have_no_defaults_is_named() -> None:
    @dataclass
    class Needs:
        size: int

    class Sized(Operator):
        value: In[Number]
        state: Needs

        def process(self, value: Number) -> None:
            self.state.size += 1

    with pytest.raises(StateError, match=r"Sized\.state: .*size.*give every field a default, or define initial_state"):
        Sized().process(number(1))


def test_a_state_may_be_declared_within_the_operator_and_is_inherited() -> None:
    class Outer(Operator):
        @dataclass
        class Seen:
            numbers: list[int] = field(default_factory=list)

        value: In[Number]
        state: Seen

        def process(self, value: Number) -> None:
            self.state.numbers.append(value.stamp)

    class Inner(Outer):
        pass

    operator = Inner()
    operator.process(number(5))

    assert operator.snapshot() == {"numbers": [5]}


def test_an_operator_without_a_state_gives_no_snapshot() -> None:
    class Plain(Operator):
        value: In[Number]

        def process(self, value: Number) -> None:
            return None

    assert Plain().snapshot() is None
    with pytest.raises(NotImplementedError, match="Plain gives snapshots but cannot restore"):
        Plain().restore({})


@dataclass
class Kept(Generic[V]):
    place: str
    view: V | None = None


@dataclass
class Shelf(Generic[V]):
    by_id: dict[int, Kept[V]] = field(default_factory=dict)


def test_generic_dataclass_is_restored_with_its_type_arguments() -> None:
    shelf = Shelf({1: Kept("there", Track(1, np.zeros(3))), 2: Kept("here")})

    back = typed(Shelf[Track], unpack_state(pack_state(plain(shelf))))

    assert isinstance(back.by_id[1].view, Track)
    assert back.by_id[2] == Kept("here")


def test_one_of_several_dataclasses_is_found_by_its_fields() -> None:
    back = typed(Place | Kept[int] | Track, unpack_state(pack_state(plain(Track(1, np.zeros(3))))))

    assert isinstance(back, Track)


def test_a_state_of_another_version_is_taken_over_as_far_as_there_are_defaults() -> None:
    snapshot = plain(filled())
    former = {name: value for name, value in snapshot.items() if name not in ("kind", "spare")} | {"older": 1}
    operator = Averager()

    with of_another_version():
        operator.restore(former)
    assert pack_state(plain(operator.state)) == pack_state({**snapshot, "kind": "a", "spare": []})
    with of_another_version(), pytest.raises(StateError, match=r"\(Track\) has no mean, which the class has now"):
        operator.restore({**snapshot, "tracks": [[1, {"id": 1}]]})
    with pytest.raises(StateError, match="has no kind, spare, which the class has now; it has older, which"):
        operator.restore(former)


def test_a_state_is_seen_in_the_collections_that_it_declares() -> None:
    state = State(
        window=Window(2),
        tracks={7: Track(7, np.zeros(2), None, Mode.FOLLOW)},
        places=deque([Place(1, np.ones(3))], maxlen=2),
        seen={"b", "a"},
        pairs={(1, "x"): 0.5},
        by_id=defaultdict(list, {3: [1.0]}),
        last=Odometry(
            stamp=5, frame="odom", child_frame="base", position=np.zeros(3), orientation=np.array([0.0, 0, 0, 1])
        ),
        phase=2j,
    )
    packed = unpack_state(pack_state(plain(state)))

    found = seen(State, packed)

    assert found["tracks"][7]["mode"] == "FOLLOW"
    assert list(found["tracks"][7]) == sorted(["id", "mean", "label", "mode"])
    assert found["places"][-1].stamp == 1
    assert (found["seen"], found["pairs"], found["by_id"], found["phase"]) == (
        {"a", "b"},
        {(1, "x"): 0.5},
        {3: [1.0]},
        2j,
    )
    assert found["window"] == {"values": []}
    assert found["last"]["stamp"] == 5
    assert found["spare"] == ()


def test_undeclared_state_is_shown_unchanged() -> None:
    packed = {"tracks": [[1, 2]], "other": [[1, 2]], "seen": ["a"]}

    assert seen(State, packed) == {"tracks": [[1, 2]], "other": [[1, 2]], "seen": {"a"}}
    assert seen(None, packed) == packed


def test_keys_and_members_that_are_enums_are_seen_by_name() -> None:
    @dataclass
    class Modes:
        since: dict[Mode, int] = field(default_factory=dict)
        tried: set[Place] | None = None

    kept = {"since": [["SEARCH", 4]], "tried": None}
    Modes.__annotations__.update(since=dict[Mode, int], tried=set[str] | None)
    assert seen(Modes, kept) == {"since": {"SEARCH": 4}, "tried": None}
