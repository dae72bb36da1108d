"""What cannot repeat is recorded at the call: re-execution gives the recorded answers, and nothing else."""

from __future__ import annotations

import asyncio
import itertools
import random
import sys
import urllib.error
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass
from email.message import Message as Headers
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from firing_operators import Collector, entry, node, run_all, value

from dataflow.execution.effects.answers import Answer, EffectError, EffectMiss, Key
from dataflow.execution.failure import OperatorFailure
from dataflow.execution.recorded import RecordedRunner
from dataflow.execution.runner import OperatorRunner
from dataflow.execution.snapshots import pack_state
from dataflow.messages import FeatureVector
from dataflow.operator import In, Operator, Out
from dataflow.recording.limits import MAX_EFFECT_BYTES
from dataflow.records.firing import decode_batch, encode_batch
from dataflow.records.repetition import Repetition, look_at

STREAM = "t/s/x"
MESSAGES = [entry(STREAM, 100, 0), entry(STREAM, 200, 1), entry(STREAM, 300, 2)]
WORLD = itertools.count(1)
"""Never answers twice alike."""


def ask(*question: Any, answer: Any = None) -> Any:
    random.random()
    return next(WORLD) if answer is None else answer


def refuse(error: BaseException) -> None:
    random.random()
    raise error


class Asking(Operator):
    """Emits what `body`, set by a test, makes of an input."""

    x: In[FeatureVector]
    out: Out[FeatureVector]

    def process(self, x: FeatureVector) -> FeatureVector:
        return value(x.stamp, BODY[0](self, x))

    def setup(self) -> None:
        SETUP[0](self)


Body = Callable[[Asking, FeatureVector], float]
BODY: list[Body] = []
SETUP: list[Callable[[Asking], Any]] = [lambda operator: None]


@pytest.fixture(autouse=True)
def _bodies(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr("firing_operators.Asking", Asking, raising=False)
    yield
    BODY.clear()
    SETUP[:] = [lambda operator: None]


def recorded(body: Body, *, fails: bool = False) -> Collector:
    BODY[:] = [body]
    collector = Collector()
    runner = OperatorRunner(node(Asking, {"x": [STREAM]}), collector, static=frozenset())
    runner.setup()
    for message in MESSAGES:
        runner.push(STREAM, message)
    runner.end(STREAM, None, "")
    with pytest.raises(OperatorFailure) if fails else nullcontext():
        run_all(runner)
    [*collector.records] = decode_batch(encode_batch(collector.records)).records
    return collector


def again(ran: Collector, body: Body | None = None, **options: Any) -> RecordedRunner:
    """Re-executes, without that anything is answered unless `options` ask for it."""
    BODY[:] = [body or BODY[0]]
    inputs = {STREAM: {(m.incarnation, m.seq): m.digest for m in MESSAGES}}
    asking = node(Asking, {"x": [STREAM]})
    repetition = Repetition(lambda: ran.records, stateless=asking.operator.stateless)
    look_at([repetition])
    runner = RecordedRunner(asking, Collector(), static=frozenset(), repetition=repetition, inputs=inputs, **options)
    runner.setup()
    for message in MESSAGES:
        runner.push(STREAM, message)
    runner.end(STREAM, None, "")
    run_all(runner)
    return runner


def line_of(text: str) -> int:
    lines = Path(__file__).read_text().splitlines()
    return next(n for n, line in enumerate(lines, 1) if text in line and "line_of" not in line)


def test_recorded_answers_are_given_again_without_a_call() -> None:
    ran = recorded(lambda operator, x: operator.effect(ask, "how far?", x) + operator.effect(ask, "how far?", x))
    before = next(WORLD)

    result = again(ran).result

    assert result.verdict == "identical"
    assert result.verified == 4
    assert result.effects == {"ask": {"given": 6, "missed": 0, "again": 0, "same": 0}}
    assert next(WORLD) == before + 1


def test_random_draws_after_an_effect_are_independent_of_it() -> None:
    ran = recorded(lambda operator, x: operator.effect(ask) + random.random() + operator.rng.random())

    assert again(ran).result.verdict == "identical"


def test_a_changed_argument_is_a_miss_with_call_and_line_never_the_next_answer() -> None:
    ran = recorded(lambda operator, x: operator.effect(ask, "A", x.stamp) + operator.effect(ask, "B", x.stamp))

    def changed(operator: Asking, x: FeatureVector) -> float:
        first = operator.effect(ask, "A", x.stamp)
        question = "B" if x.stamp == 100 else "C"
        return first + operator.effect(ask, question, x.stamp)  # the changed question

    result = again(ran, changed).result

    assert result.verdict == "culprit"
    assert result.first is not None
    assert result.first.stamp == 200
    assert result.first.got == (
        f"error: EffectMiss: miss at effect 3 (test_effects.py:{line_of('# the changed question')}), ask: "
        "argument 0 differs from the recorded call"
    )
    assert result.effects["ask"] == {"given": 4, "missed": 2, "again": 0, "same": 0}


class Client:
    """A client that counts its questions, and holds what may change them."""

    system = "You are a robot."

    def __init__(self, prompt: str, temperature: float = 0.0, token: str = "") -> None:
        self.prompt, self.temperature, self.api_token, self.asked = prompt, temperature, token, 0

    def ask(self) -> Any:
        self.asked += 1
        return next(WORLD)


class Terse(Client):
    """Another constant of the class."""

    system = "You are a terse robot."


def _closure(prompt: Any) -> Callable[[], Any]:
    def call() -> Any:
        return ask(prompt)

    return call


def _outer(prompt: str) -> Callable[[], Any]:
    inner = _closure(prompt)

    def call() -> Any:
        return inner()

    return call


def _default(prompt: str) -> Callable[[], Any]:
    def call(n: int = 1, *, prompt: str = prompt) -> Any:
        return ask(prompt)

    return call


def _holding(client: Client) -> Callable[[], Any]:
    def call() -> Any:
        return client.ask()

    return call


@pytest.mark.parametrize(
    ("one", "other", "place"),
    [
        (lambda: _closure("a?"), lambda: _closure("b?"), "closure.prompt"),
        (lambda: _closure(np.arange(9)), lambda: _closure(np.arange(9) + 1), "closure.prompt"),
        (lambda: _closure(partial(ask, "a?")), lambda: _closure(partial(ask, "b?")), "closure.prompt.args"),
        (lambda: _outer("a?"), lambda: _outer("b?"), "closure.inner.closure.prompt"),
        (lambda: _default("a?"), lambda: _default("b?"), "default.prompt"),
        (lambda: _holding(Client("a?")), lambda: _holding(Client("b?")), "closure.client.prompt"),
        (lambda: Client("a?").ask, lambda: Client("b?").ask, "self.prompt"),
        (lambda: Client("a?", 0.2).ask, lambda: Client("a?", 0.9).ask, "self.temperature"),
        (lambda: Client("a?").ask, lambda: Terse("a?").ask, "self.system"),
    ],
)
def test_a_prompt_that_a_call_sees_besides_its_arguments_is_a_miss_where_it_changes(
    one: Callable[[], Any], other: Callable[[], Any], place: str
) -> None:
    ran = recorded(lambda operator, x: operator.effect(one()))

    assert again(ran).result.first is None
    found = again(ran, lambda operator, x: operator.effect(other())).result.first
    assert found is not None
    assert f"{place} differs from the recorded call" in found.got


def test_effect_key_ignores_object_state_and_credentials() -> None:
    def body(token: str) -> Body:
        clients: list[Client] = []

        def asking(operator: Asking, x: FeatureVector) -> float:
            clients[:] = clients or [Client("a?", token=token)]
            return float(operator.effect(clients[0].ask))

        return asking

    assert again(recorded(body("of the robot")), body("of the desk")).result.first is None


@dataclass
class Turn:
    """One text of a conversation."""

    role: str
    content: str


Said = Callable[[str, str], Any]


class Conversation:
    """A client that keeps what was said, and since when it has been silent."""

    def __init__(self, prompt: str, said: Said) -> None:
        self.messages, self.since = [said("system", prompt)], random.random()

    def ask(self) -> Any:
        self.messages.append(self.messages[0])
        self.since = random.random()
        return next(WORLD)


@pytest.mark.parametrize("said", [Turn, lambda role, content: {"role": role, "content": content}])
def test_a_conversation_that_begins_with_another_prompt_is_a_miss(said: Said) -> None:
    def body(prompt: str) -> Body:
        clients: list[Conversation] = []

        def asking(operator: Asking, x: FeatureVector) -> float:
            clients[:] = clients or [Conversation(prompt, said)]
            return float(operator.effect(clients[0].ask))

        return asking

    ran = recorded(body("a?"))

    assert again(ran, body("a?")).result.first is None
    found = again(ran, body("b?")).result
    assert found.first is not None
    assert found.first.index == 1
    assert "self.messages differs from the recorded call" in found.first.got


def test_a_plain_namespace_is_looked_into() -> None:
    def key(prompt: str) -> Key:
        operator = Asking()
        vars(operator).update(config=SimpleNamespace(prompt=prompt))
        return Key.of(operator.setup, (), {})

    assert key("b?").missing(key("a?")) == ["self.config.prompt"]


def test_clocks_and_counts_of_an_operator_are_no_part_of_the_key_of_its_methods() -> None:
    def key(prompt: str, began: float) -> Key:
        operator = Asking()
        vars(operator).update(prompt=prompt, began=began, latencies=[began], client=Client("a?"))
        return Key.of(operator.setup, (), {})

    assert key("a?", 1.0) == key("a?", 2.0)
    assert key("b?", 1.0).missing(key("a?", 1.0)) == ["self.prompt"]
    assert "self.client.prompt" in key("a?", 1.0).arguments


@pytest.mark.parametrize("caught", [Exception, BaseException])
def test_a_miss_is_no_failure_of_the_service_and_cannot_be_passed_over(caught: type[BaseException]) -> None:
    ran = recorded(lambda operator, x: operator.effect(ask, "A"))

    def careless(operator: Asking, x: FeatureVector) -> float:
        try:
            return float(operator.effect(ask, "B"))
        except caught:
            return 1.0

    result = again(ran, careless).result

    assert result.verdict == "culprit"
    assert result.first is not None
    assert "EffectMiss: miss at effect 0" in result.first.got


def test_a_miss_cannot_hide_behind_the_error_that_was_recorded() -> None:
    def asking(question: str) -> Body:
        def gone(question: str) -> None:
            raise OSError("gone")

        def body(operator: Asking, x: FeatureVector) -> float:
            try:
                return float(operator.effect(gone, question))
            except BaseException:
                raise RuntimeError("no service") from None

        return body

    ran = recorded(asking("A"), fails=True)

    assert again(ran).result.verdict == "identical"
    result = again(ran, asking("B")).result
    assert result.verdict == "culprit"
    assert result.first is not None
    assert "EffectMiss: miss at effect 0" in result.first.got


GRID = np.arange(6, dtype=np.float32).reshape(2, 3)


@pytest.mark.parametrize(
    "other", [GRID.reshape(3, 2), GRID.astype(np.float64), GRID.T.copy(), GRID + 1, GRID.tolist(), GRID[:0]]
)
def test_array_keys_differ_by_type_shape_and_values(other: Any) -> None:
    def key(value: Any) -> Key:
        return Key.of(ask, (value,), {})

    assert key(np.asfortranarray(GRID)) == key(GRID)
    assert key(other) != key(GRID)


def test_calls_may_be_left_out_or_made_in_another_order() -> None:
    ran = recorded(lambda operator, x: 0 * operator.effect(ask, "A") + operator.effect(ask, "B"))

    assert again(ran, lambda operator, x: operator.effect(ask, "B")).result.verdict == "identical"
    swapped = again(ran, lambda operator, x: operator.effect(ask, "B") + 0 * operator.effect(ask, "A"))
    assert swapped.result.verdict == "identical"


def test_effect_answers_are_equal_in_run_and_reexecution() -> None:
    seen: list[Any] = []
    given = {"list": (1, [2.5, None]), "array": np.arange(6, dtype=np.int16).reshape(2, 3), "bytes": b"\x00"}

    def look(operator: Asking, x: FeatureVector) -> float:
        seen.append(operator.effect(ask, answer=given))
        seen[-1]["array"][0, 0] = x.stamp  # an own copy, which may be written to
        return float(seen[-1]["array"].sum())

    ran = recorded(look)

    assert again(ran).result.verdict == "identical"
    assert [repr(one) for one in seen[:3]] == [repr(one) for one in seen[3:]]
    assert seen[0]["list"] == [1, [2.5, None]]


class Declined(ConnectionError):
    """An error with attributes, and another constructor than its base."""

    def __init__(self, code: int, reply: object) -> None:
        super().__init__(f"code {code}")
        self.code, self.reply = code, reply


class Unreachable(ConnectionError):
    """An error with a text that needs an attribute which is not recorded."""

    def __init__(self, place: object) -> None:
        super().__init__(111, "refused")
        self.place = [place]

    def __str__(self) -> str:
        return f"cannot connect to {type(self.place[0]).__name__}"


class Textless(LookupError):
    """An error whose text cannot be made."""

    def __str__(self) -> str:
        return str(self.absent)


def _local() -> Exception:
    class Local(LookupError):
        pass

    return Local("not importable")


def _cyclic() -> Exception:
    error = ValueError("loop")
    error.origin = error
    error.all = loop = []
    loop.append(loop)
    return error


def _caught(call: Callable[[], Any]) -> Exception:
    try:
        call()
    except Exception as error:
        return error
    raise AssertionError


@pytest.mark.parametrize(
    ("error", "kind", "text"),
    [
        (TimeoutError("timed out"), TimeoutError, "timed out"),
        (OSError(110, "Connection timed out"), TimeoutError, "[Errno 110] Connection timed out"),
        (KeyError("absent"), KeyError, "'absent'"),
        (Declined(7, object()), Declined, "code 7"),
        (urllib.error.URLError(TimeoutError("t")), urllib.error.URLError, "<urlopen error t>"),
        (urllib.error.HTTPError("u", 503, "busy", Headers(), None), urllib.error.HTTPError, "HTTP Error 503: busy"),
        (_local(), LookupError, "not importable"),
        (_caught(Path("absent/x").open), FileNotFoundError, "[Errno 2] No such file or directory: 'absent/x'"),
        (_caught(b"\xff".decode), UnicodeDecodeError, "'utf-8' codec can't decode byte 0xff in position 0: "
         "invalid start byte"),
        (Unreachable(object()), ConnectionError, "cannot connect to object"),
        (OSError("bad name \udcff"), OSError, "bad name \\udcff"),
        (Textless("x"), LookupError, "(its text cannot be made: AttributeError)"),
        (_cyclic(), ValueError, "loop"),
        (asyncio.CancelledError("late"), asyncio.CancelledError, "late"),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, BaseException) else "",
)  # fmt: skip
def test_errors_are_raised_again_alike(error: BaseException, kind: type[BaseException], text: str) -> None:
    seen: list[BaseException] = []

    ran = recorded(lambda operator, x: _tried(operator, error, seen))

    assert again(ran).result.verdict == "identical"
    assert len(seen) == 6
    for met in seen:
        assert type(met) is kind
        assert str(met) == text
        if (name := FIELDS.get(kind)) is not None:
            assert getattr(met, name) == getattr(error, name)


FIELDS = {Declined: "code", urllib.error.HTTPError: "code", FileNotFoundError: "errno", UnicodeDecodeError: "start"}


def _tried(operator: Asking, error: BaseException, seen: list[BaseException]) -> float:
    def raising() -> None:
        refuse(error)

    try:
        operator.effect(raising)
    except BaseException as met:
        seen.append(met)
    return random.random()


def test_an_error_that_ends_the_firing_is_re_executed() -> None:
    BODY[:] = [lambda operator, x: _refused(operator)]
    with pytest.raises(OperatorFailure, match="TimeoutError: gone") as raised:
        recorded(BODY[0])

    assert raised.value.where.startswith("test_effects.py:")


def _refused(operator: Asking) -> float:
    def gone() -> None:
        raise TimeoutError("gone")

    operator.effect(gone)
    return 0.0


@pytest.mark.parametrize(
    ("answer", "told"),
    [
        (object(), "answer of ask is a object; recorded are numbers, strings"),
        ([1, {"a": {2: 3}}], r"answer of ask\[1\].a: key 2 is no string"),
        (2**70, "answer of ask: "),
        (bytes(MAX_EFFECT_BYTES), "answer of ask: 16,777,.* bytes; a firing records 16,777,216 more"),
    ],
)
def test_an_answer_that_cannot_be_recorded_is_an_error_which_is_recorded(answer: Any, told: str) -> None:
    def answering() -> Any:
        return answer

    def tries(operator: Asking, x: FeatureVector) -> float:
        with pytest.raises(EffectError, match=told.replace("ask", ".*answering")):
            operator.effect(answering)
        return random.random()

    ran = recorded(tries)

    assert again(ran).result.verdict == "identical"


def test_the_answers_of_one_firing_are_bounded_together() -> None:
    def tries(operator: Asking, x: FeatureVector) -> float:
        operator.effect(ask, answer=bytes(MAX_EFFECT_BYTES - 100))
        with pytest.raises(EffectError, match="a firing records"):
            operator.effect(ask, answer=bytes(100))
        return 0.0

    assert again(recorded(tries)).result.verdict == "identical"


def test_effects_without_key_or_firing_are_refused() -> None:
    def tries(operator: Asking, x: FeatureVector) -> float:
        with pytest.raises(EffectError, match="a call is known by its name"):
            operator.effect(lambda: 1)
        with pytest.raises(EffectError, match=r"effect: ask\(0\) is a object"):
            operator.effect(ask, object())
        return 0.0

    SETUP[:] = [lambda operator: operator.effect(ask)]
    with pytest.raises(OperatorFailure, match="EffectError: n: effect\\(\\) is for process\\(\\) and finish\\(\\)"):
        recorded(tries)
    SETUP[:] = [lambda operator: None]
    assert again(recorded(tries)).result.verdict == "identical"


def test_an_effect_within_an_effect_is_refused() -> None:
    def tries(operator: Asking, x: FeatureVector) -> float:
        def outer() -> Any:
            return operator.effect(ask)

        with pytest.raises(EffectError, match=r"n: effect\(\) inside an effect"):
            operator.effect(outer)
        return float(operator.effect(ask)) + random.random()

    assert again(recorded(tries)).result.verdict == "identical"


def test_an_effect_on_another_thread_is_refused() -> None:
    def several(questions: list[str]) -> list[Any]:
        with ThreadPoolExecutor(2) as pool:
            return [*pool.map(ask, questions)]

    def tries(operator: Asking, x: FeatureVector) -> float:
        with ThreadPoolExecutor(2) as pool, pytest.raises(EffectError, match="on another thread than process"):
            pool.submit(operator.effect, ask, "A").result()
        return float(sum(operator.effect(several, ["A", "B"])))

    assert again(recorded(tries)).result.verdict == "identical"


def test_an_effect_behind_a_firing_is_refused_and_the_verdict_comes(capsys: pytest.CaptureFixture[str]) -> None:
    class Closing(Asking):
        def close(self) -> None:
            self.effect(ask, "goodbye")

    SETUP[:] = [lambda operator: setattr(operator, "close", Closing.close.__get__(operator))]
    runner = again(recorded(lambda operator, x: 1.0))
    runner.close()

    assert runner.result.verdict == "identical"
    assert "EffectError: n: effect() is for process() and finish()" in capsys.readouterr().err


def test_the_number_of_a_call_counts_from_the_beginning_of_its_firing() -> None:
    def body(operator: Asking, x: FeatureVector) -> float:
        def interrupted() -> None:
            raise KeyboardInterrupt

        if x.stamp == 100:
            with pytest.raises(KeyboardInterrupt):
                operator.effect(interrupted)
            return 0.0
        operator.effect(ask)
        return random.random()

    ran = recorded(body)

    assert again(ran, lambda operator, x: 0.0 if x.stamp == 100 else body(operator, x)).result.verdict == "identical"


def test_functions_of_two_modules_have_two_keys() -> None:
    other = type(ask)(ask.__code__, {"__name__": "other"}, "ask")
    other.__qualname__, other.__module__ = "ask", "other"

    assert Key.of(other, (), {}) != Key.of(ask, (), {})
    assert Key.of(other, (), {}).differing([Key.of(ask, (), {})]) == f"recorded there: {ask.__module__}:ask"


def test_an_error_of_a_recording_imports_no_package() -> None:
    described = [[["antigravity", "Any"], ["dataflow.doctor", "Any"], ["builtins", "ValueError"]], "t", ["t"], {}, {}]

    error = Answer(True, pack_state({"": described})).error()

    assert type(error) is ValueError
    assert "antigravity" not in sys.modules


def test_an_error_of_a_recording_calls_no_function(capsys: pytest.CaptureFixture[str]) -> None:
    described = [[["builtins", "print"], ["builtins", "ValueError"]], "t", ["t"], {}, {}]

    error = Answer(True, pack_state({"": described})).error()

    assert type(error) is ValueError
    assert not capsys.readouterr().out


def test_without_a_run_the_call_is_made() -> None:
    assert Asking().effect(ask, answer=3) == 3


def test_calls_that_are_made_again_are_compared_and_misses_get_new_answers() -> None:
    ran = recorded(lambda operator, x: operator.effect(ask, "A") + operator.effect(ask, "B", answer=1))

    alike = again(ran, make_effects=True)
    assert alike.result.verdict == "identical"
    assert alike.result.effects == {"ask": {"given": 6, "missed": 0, "again": 6, "same": 3}}

    changed = again(ran, lambda operator, x: operator.effect(ask, "C"), make_effects=True)
    assert changed.result.verdict == "culprit"
    assert changed.result.first is not None
    assert changed.result.first.port == "out"
    assert changed.result.effects["ask"]["missed"] == 3


def test_a_firing_without_effects_leaves_its_record_as_it_is() -> None:
    ran = recorded(lambda operator, x: 1.0)

    assert all(not record.detail for record in ran.records if record.kind == "fire")
    assert "EffectMiss" in again(ran, lambda operator, x: operator.effect(ask)).result.first.got


def test_a_miss_is_no_exception_that_operators_expect() -> None:
    assert not issubclass(EffectMiss, Exception)
