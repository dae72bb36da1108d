"""A captured call: an operator, its state, and the calls that show what is wrong; as a file, and made again.

The file is msgpack, compressed by zlib. It needs neither the recording nor its graph, but the operator's module.
"""

from __future__ import annotations

import subprocess
import zlib
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

from dataflow.environments import environment_of, is_environment
from dataflow.execution.calls import Calls, value_of
from dataflow.execution.effects.journal import RecordedJournal
from dataflow.execution.failure import RAISED, OperatorFailure, readable
from dataflow.execution.restarts import close_quietly
from dataflow.execution.snapshots import pack_state, unpack_state
from dataflow.execution.threads import environment, limited_threads
from dataflow.graph.model import Live, Node
from dataflow.messages.base import Message
from dataflow.recording.streams.diff import differences
from dataflow.state import StateError, of_another_version, plain, typed
from dataflow.sync import NEVER, Entry, Firing, InputValue
from dataflow.sync.entries import entries_of

FORMAT = 2
_CHECK = "import pathlib, sys; from dataflow.capture.captured import check; check(pathlib.Path(sys.argv[1]))"
LONGEST = 600.0
"""Seconds that the calls may take in another process."""
BEFORE = 2
"""Calls before the wrong one of which the outputs are compared, too."""


class Change(NamedTuple):
    """A change of a parameter (`kind` "param", with its value), or the reset of an input (`kind` "reset")."""

    kind: str
    name: str
    value: Any
    place: tuple[int, int]
    """(incarnation, stamp in ns)."""


class CapturedCall(NamedTuple):
    """One call: what it was given, what was recorded of its effects and, by port, of its outputs (digests), and the
    changes between the call before and this one. `here`: the digests of its outputs in the debugger."""

    firing: Firing
    effects: Mapping[str, Any]
    digests: Mapping[str, bytes]
    changes: tuple[Change, ...] = ()
    here: Mapping[str, bytes] = {}


@dataclass(frozen=True, slots=True)
class OperatorSettings:
    """The operator: its name and class (`module:Class`), parameters, seed of the graph, version of the seeding,
    threads of libraries, output ports, environment (`env:`)."""

    name: str
    use: str
    params: Mapping[str, Any]
    seed: int
    seeding: int
    threads: int
    outputs: Mapping[str, str]
    env: str | None = None


@dataclass(frozen=True, slots=True)
class Outcome:
    """The outcome of the last call, and the digests (by port) of `BEFORE` calls before it; `ports`: all outputs;
    `broken`: an earlier call raised."""

    firing: Firing
    ports: Sequence[str]
    outputs: Mapping[str, Message]
    error: BaseException | None
    before: Sequence[Mapping[str, bytes]] = ()
    broken: bool = False

    @property
    def digests(self) -> dict[str, bytes]:
        """Digests of the outputs, by port."""
        return {port: message.digest() for port, message in self.outputs.items()}

    def names(self) -> dict[str, Any]:
        """Names for an expression: `inp` and `out` by input and port (None where it is silent), `stamp` (ns),
        `error`."""
        given = {name: value_of(value) for name, value in self.firing.inputs.items()}
        return {
            "inp": SimpleNamespace(**given),
            "out": SimpleNamespace(**dict.fromkeys(self.ports) | dict(self.outputs)),
            "stamp": self.firing.stamp,
            "error": None if self.error is None else readable(self.error),
        }


@dataclass(frozen=True, slots=True)
class CapturedCalls:
    """Calls of one operator; the last one is that in which something is wrong. They begin with the `state`, if there is
    one, and the parameters that had been changed by then: before the last `setup()`, and `since`.

    Expected of it are the messages in `expected`, by port, or the error `recorded_error`, or, where there is a
    `predicate`, that this expression is false, and an error none but `recorded_error`; where none of these is given,
    that it raises nothing.
    """

    setting: OperatorSettings
    at_setup: Mapping[str, Any]
    since: Mapping[str, Any]
    state: bytes | None
    shots: tuple[CapturedCall, ...]
    expected: Mapping[str, Message] | None = None
    recorded_error: str = ""
    predicate: str = ""

    def play(self) -> Outcome:
        """Makes the calls with a new operator. Raises `OperatorFailure` where it cannot be set up; `StateError` for a
        state of another version of its class whose new fields have no default."""
        setting = self.setting
        node = Node(
            name=setting.name,
            use=setting.use,
            params=dict(setting.params),
            inputs={},
            outputs=dict(setting.outputs),
            live=Live("block", 64, {}),
            env=setting.env,
        )
        journal = RecordedJournal()
        with limited_threads(setting.threads):
            calls = Calls(node, node.make(), setting.seed, version=setting.seeding, effects=journal)
            try:
                set_up(calls, self.at_setup, self.since)
                if self.state is not None:
                    self._take_over(calls, self.state)
                return _made(calls, journal, self.shots)
            finally:
                close_quietly(calls.operator)

    def _take_over(self, calls: Calls, state: bytes) -> None:
        try:
            with of_another_version():
                calls.restore(state, (0, self.shots[0].firing.stamp - 1))
        except OperatorFailure as failure:
            if not isinstance(failure.__cause__, StateError):
                raise
            raise StateError(
                f"{self.setting.name}: the captured state does not fit the class as it is now: {failure.summary}; "
                "give new fields a default, or capture the call again"
            ) from failure

    def check(self) -> None:
        """Makes the calls; raises `AssertionError`, or the operator's own error, where the last one is wrong."""
        outcome = self.play()
        if outcome.error is not None and outcome.broken:
            raise outcome.error
        if self.predicate:
            self._check_predicate(outcome)
        elif self.recorded_error:
            error = "nothing" if outcome.error is None else readable(outcome.error)
            assert error == self.recorded_error, f"{self.setting.name}: raised {error}, expected {self.recorded_error}"
        elif outcome.error is not None:
            raise outcome.error
        elif self.expected is not None:
            found = "; ".join(_differences(self.expected, outcome.outputs))
            assert not found, f"{self.setting.name}: {found}"

    def _check_predicate(self, outcome: Outcome) -> None:
        name, predicate = self.setting.name, Predicate(self.predicate)
        if outcome.error is not None and readable(outcome.error) != self.recorded_error:
            raise outcome.error
        assert not predicate.is_true(outcome.names()), f"{name}: {self.predicate}"
        assert predicate.problem is None, (
            f"{name}: {self.predicate} raises {readable(predicate.problem)}: whether the call is right is not known; "
            "capture it by an expression that is false of a right call"
        )

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
            "at_setup": dict(self.at_setup),
            "since": dict(self.since),
            "state": self.state,
            "shots": shots,
            "expected": expected,
            "recorded_error": self.recorded_error,
            "predicate": self.predicate,
            "messages": messages,
        }
        return zlib.compress(pack_state(content), 6)

    @staticmethod
    def from_bytes(data: bytes) -> CapturedCalls:
        """Reads what `to_bytes` gave. Raises ValueError for anything else."""
        try:
            content = unpack_state(zlib.decompress(data))
        except zlib.error as error:
            raise ValueError(f"no captured call: {error}") from error
        if content["format"] != FORMAT:
            raise ValueError(f"a captured call of format {content['format']!r}; this version reads {FORMAT}")
        setting = OperatorSettings(**content["setting"])
        import_module(setting.use.partition(":")[0])  # declares its types of messages
        messages = {key: typed(Message, value) for key, value in content["messages"].items()}
        expected = content["expected"]
        return CapturedCalls(
            setting,
            content["at_setup"],
            content["since"],
            content["state"],
            tuple(_unpacked(shot, messages) for shot in content["shots"]),
            None if expected is None else {port: messages[key] for port, key in expected.items()},
            content["recorded_error"],
            content["predicate"],
        )


class Predicate:
    """An expression about a call. Raises SyntaxError for another text.

    It is not true where it raises. `problem` is the first error, None once it has raised none.
    """

    def __init__(self, text: str) -> None:
        self._code = compile(text, "<predicate>", "eval")
        self._answered = False
        self.problem: Exception | None = None

    def is_true(self, names: dict[str, Any]) -> bool:
        """Returns whether it is true of a call, given its names."""
        try:
            found = bool(eval(self._code, names))
        except Exception as error:
            self.problem = None if self._answered else self.problem or error
            return False
        self._answered, self.problem = True, None
        return found


def check(path: Path) -> None:
    """Makes a captured call again, from its file, in the environment of its operator. Where that is not this process,
    what the operator raises there becomes the text of an `AssertionError`.

    Raises `AssertionError`, or what the operator raises, where it is wrong still, and `EnvError`.
    """
    captured = CapturedCalls.from_bytes(path.read_bytes())
    env, threads = captured.setting.env, captured.setting.threads
    if env is None or is_environment(env):
        captured.check()
        return
    there = environment_of(env)
    command = [there.python, "-P", "-c", _CHECK, str(path.resolve())]
    variables = there.variables(environment(threads))
    done = subprocess.run(command, env=variables, capture_output=True, text=True, timeout=LONGEST, check=False)
    if done.returncode:
        raise AssertionError(f"in the environment {env}: {done.stderr.strip() or f'exit code {done.returncode}'}")


def _made(calls: Calls, journal: RecordedJournal, shots: Sequence[CapturedCall]) -> Outcome:
    """Makes the calls, to the last or to the first that raises."""
    ports = tuple(calls.node.outputs)
    before: deque[dict[str, bytes]] = deque(maxlen=BEFORE)
    outputs: dict[str, Message] = {}
    for left, shot in zip(range(len(shots) - 1, -1, -1), shots, strict=True):
        journal.begin(shot.effects)
        try:
            for change in shot.changes:
                make_change(calls, change)
            outputs = calls.process(shot.firing)
        except KeyboardInterrupt:
            raise
        except RAISED as error:
            return Outcome(shot.firing, ports, {}, error, tuple(before), broken=left > 0)
        if 0 < left <= BEFORE:
            before.append({port: message.digest() for port, message in outputs.items()})
    return Outcome(shots[-1].firing, ports, outputs, None, tuple(before))


def set_up(calls: Calls, at_setup: Mapping[str, Any], since: Mapping[str, Any]) -> None:
    """Sets an operator up, with the parameters that were changed before its `setup()` and `since`."""
    for name, value in at_setup.items():
        calls.parameter(name, value, (0, NEVER))
    calls.setup()
    for name, value in since.items():
        calls.parameter(name, value, (0, NEVER))


def make_change(calls: Calls, change: Change) -> None:
    """Changes a parameter, or resets. Raises what the operator raises."""
    if change.kind == "param":
        calls.parameter(change.name, change.value, change.place)
    else:
        calls.reset(change.name, change.place)


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


def _packed(shot: CapturedCall, kept: Any) -> dict[str, Any]:
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
        "changes": [[*change] for change in shot.changes],
    }


def _form(given: InputValue) -> str:
    if given is None:
        return "none"
    return "one" if isinstance(given, Entry) else "by stream" if isinstance(given, Mapping) else "all"


def _unpacked(values: Mapping[str, Any], messages: Mapping[str, Message]) -> CapturedCall:
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
    changes = tuple(Change(kind, name, value, tuple(place)) for kind, name, value, place in values["changes"])
    return CapturedCall(firing, values["effects"], {}, changes)
