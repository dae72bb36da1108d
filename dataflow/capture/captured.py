"""A captured call: an operator, its state, and the calls that show what is wrong; as a file, and made again.

The file is msgpack, compressed by zlib. It needs neither the recording nor its graph, but the operator's module.
"""

from __future__ import annotations

import zlib
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

from dataflow.execution.calls import Calls, entries_of, value_of
from dataflow.execution.effects.journal import RecordedJournal
from dataflow.execution.failure import RAISED, readable
from dataflow.execution.snapshots import pack_state, unpack_state
from dataflow.execution.threads import limit_threads
from dataflow.graph.model import Live, Node
from dataflow.messages.base import Message
from dataflow.recording.streams.diff import differences
from dataflow.state import plain, typed
from dataflow.sync import NEVER, Entry, Firing, InputValue

FORMAT = 1
BEFORE = 2
"""Calls before the wrong one of which the outputs are compared, too."""


class Shot(NamedTuple):
    """One call: what it was given, and what was recorded of its effects and, by port, of its outputs (digests)."""

    firing: Firing
    effects: Mapping[str, Any]
    digests: Mapping[str, bytes]


@dataclass(frozen=True, slots=True)
class Setting:
    """The operator: its name and class (`module:Class`), parameters, those that had been changed, seed of the graph,
    version of the seeding, threads of libraries, output ports."""

    name: str
    use: str
    params: Mapping[str, Any]
    changed: Mapping[str, Any]
    seed: int
    seeding: int
    threads: int
    outputs: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class Outcome:
    """The outcome of the last call, and the digests (by port) of `BEFORE` calls before it; `broken`: an earlier call
    raised."""

    firing: Firing
    outputs: Mapping[str, Message]
    error: BaseException | None
    before: Sequence[Mapping[str, bytes]] = ()
    broken: bool = False

    @property
    def digests(self) -> dict[str, bytes]:
        """Digests of the outputs, by port."""
        return {port: message.digest() for port, message in self.outputs.items()}

    def names(self) -> dict[str, Any]:
        """Names for an expression: `inp` and `out` by input and port, `stamp` (ns), `error`."""
        given = {name: value_of(value) for name, value in self.firing.inputs.items()}
        outputs = dict.fromkeys(self.digests) | dict(self.outputs)
        return {
            "inp": SimpleNamespace(**given),
            "out": SimpleNamespace(**outputs),
            "stamp": self.firing.stamp,
            "error": None if self.error is None else readable(self.error),
        }


@dataclass(frozen=True, slots=True)
class Captured:
    """Calls of one operator; the last one is that in which something is wrong.

    Expected of it are the messages in `expected`, by port, or the error `recorded_error`, or, where there is a
    `predicate`, that this expression is false; where neither is given, that it raises nothing.
    """

    setting: Setting
    state: bytes | None
    shots: tuple[Shot, ...]
    expected: Mapping[str, Message] | None = None
    recorded_error: str = ""
    predicate: str = ""

    def play(self) -> Outcome:
        """Makes the calls with a new operator. Raises `OperatorFailure` where it cannot be set up."""
        setting = self.setting
        node = Node(
            name=setting.name,
            use=setting.use,
            params=dict(setting.params),
            inputs={},
            outputs=dict(setting.outputs),
            live=Live("block", 64, {}),
        )
        limit_threads(setting.threads)
        journal = RecordedJournal()
        calls = Calls(node, node.make(), setting.seed, version=setting.seeding, effects=journal)
        try:
            calls.setup()
            for name, value in setting.changed.items():
                calls.parameter(name, value, (0, NEVER))
            if self.state is not None:
                calls.restore(self.state, (0, self.shots[0].firing.stamp - 1))
            return _made(calls, journal, self.shots)
        finally:
            calls.operator.close()

    def check(self) -> None:
        """Makes the calls; raises `AssertionError`, or the operator's own error, where the last one is wrong."""
        outcome = self.play()
        if self.predicate:
            assert not eval(self.predicate, outcome.names()), f"{self.setting.name}: {self.predicate}"
        elif self.recorded_error:
            error = "nothing" if outcome.error is None else readable(outcome.error)
            assert error == self.recorded_error, f"{self.setting.name}: raised {error}, expected {self.recorded_error}"
        elif outcome.error is not None:
            raise outcome.error
        elif self.expected is not None:
            found = "; ".join(_differences(self.expected, outcome.outputs))
            assert not found, f"{self.setting.name}: {found}"

    def to_bytes(self) -> bytes:
        """Returns the file's content. Raises ValueError for a message that does not come back from it alike."""
        messages: dict[str, Any] = {}

        def kept(message: Message) -> str:
            key = message.digest().hex()
            if key not in messages:
                messages[key] = plain(message)
                if typed(type(message), unpack_state(pack_state(messages[key]))).digest() != message.digest():
                    raise ValueError(f"a {message.SCHEMA} cannot be captured: it is not the same when read back")
            return key

        shots = [_packed(shot, kept) for shot in self.shots]
        expected = None if self.expected is None else {port: kept(one) for port, one in self.expected.items()}
        content = {
            "format": FORMAT,
            "setting": asdict(self.setting),
            "state": self.state,
            "shots": shots,
            "expected": expected,
            "recorded_error": self.recorded_error,
            "predicate": self.predicate,
            "messages": messages,
        }
        return zlib.compress(pack_state(content), 6)

    @staticmethod
    def from_bytes(data: bytes) -> Captured:
        """Reads what `to_bytes` gave. Raises ValueError for anything else."""
        try:
            content = unpack_state(zlib.decompress(data))
        except zlib.error as error:
            raise ValueError(f"no captured call: {error}") from error
        if content["format"] != FORMAT:
            raise ValueError(f"a captured call of format {content['format']!r}; this version reads {FORMAT}")
        setting = Setting(**content["setting"])
        import_module(setting.use.partition(":")[0])  # declares its types of messages
        messages = {key: typed(Message, value) for key, value in content["messages"].items()}
        expected = content["expected"]
        return Captured(
            setting,
            content["state"],
            tuple(_unpacked(shot, messages) for shot in content["shots"]),
            None if expected is None else {port: messages[key] for port, key in expected.items()},
            content["recorded_error"],
            content["predicate"],
        )


def check(path: Path) -> None:
    """Makes a captured call again, from its file. Raises `AssertionError`, or what the operator raises, where it is
    wrong still."""
    Captured.from_bytes(path.read_bytes()).check()


def _made(calls: Calls, journal: RecordedJournal, shots: Sequence[Shot]) -> Outcome:
    """Makes the calls, to the last or to the first that raises."""
    before: deque[dict[str, bytes]] = deque(maxlen=BEFORE)
    outputs: dict[str, Message] = {}
    for left, shot in zip(range(len(shots) - 1, -1, -1), shots, strict=True):
        journal.begin(shot.effects)
        try:
            outputs = calls.process(shot.firing)
        except RAISED as error:
            return Outcome(shot.firing, {}, error, tuple(before), broken=left > 0)
        if 0 < left <= BEFORE:
            before.append({port: message.digest() for port, message in outputs.items()})
    return Outcome(shots[-1].firing, outputs, None, tuple(before))


def _differences(expected: Mapping[str, Message], outputs: Mapping[str, Message]) -> list[str]:
    found = []
    for port in {**expected, **outputs}:
        then, now = expected.get(port), outputs.get(port)
        if then is None or now is None:
            made, wanted = ("nothing" if message is None else "a message" for message in (now, then))
            found.append(f"{port}: made {made}, expected {wanted}")
        elif then.digest() != now.digest():
            fields, _ = differences(then, now, None)
            found += [f"{port}.{field.field}: {field.detail} (expected against made)" for field in fields]
    return found


def _packed(shot: Shot, kept: Any) -> dict[str, Any]:
    firing = shot.firing
    entries = {
        name: [_form(given), [[e.stream, e.seq, e.incarnation, kept(e.value)] for e in entries_of(given)]]
        for name, given in firing.inputs.items()
    }
    return {
        "stamp": firing.stamp,
        "kind": firing.kind,
        "tick": firing.tick,
        "stale": sorted(firing.stale),
        "late": sorted(firing.late),
        "inputs": entries,
        "effects": dict(shot.effects),
    }


def _form(given: InputValue) -> str:
    if given is None:
        return "none"
    return "one" if isinstance(given, Entry) else "by stream" if isinstance(given, Mapping) else "all"


def _unpacked(values: Mapping[str, Any], messages: Mapping[str, Message]) -> Shot:
    inputs: dict[str, InputValue] = {}
    for name, (form, listed) in values["inputs"].items():
        entries = tuple(
            Entry(messages[key].stamp, messages[key], seq, incarnation, messages[key].digest(), stream)
            for stream, seq, incarnation, key in listed
        )
        forms: dict[str, InputValue] = {"none": None, "all": entries, "by stream": {e.stream: e for e in entries}}
        inputs[name] = entries[0] if form == "one" else forms[form]
    firing = Firing(
        values["stamp"], values["kind"], values["tick"], inputs, frozenset(values["stale"]), frozenset(values["late"])
    )
    return Shot(firing, values["effects"], {})
