"""Programs in other languages are operators as any: the same messages, calls, failures and states."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import pytest
from example_messages import example
from program_operators import Faulty, Relay, faulty

import dataflow
from dataflow.execution.failure import OperatorFailure
from dataflow.messages import Image, Number
from dataflow.messages.base import Message, message_types
from dataflow.operator import Batch, Context, In, OperatorDefinitionError, Out, OutputError
from dataflow.program import Program, ProgramError
from dataflow.program.child import Child
from dataflow.state import StateError
from dataflow.testing import play

HERE = Path(__file__).parent
HEADER = Path(dataflow.__file__).parent / "program"


@pytest.fixture(scope="session")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    compiler = shutil.which("c++") or shutil.which("g++") or shutil.which("clang++")
    if compiler is None:
        pytest.skip("no C++ compiler is installed here")
    program = tmp_path_factory.mktemp("program") / "relay"
    command = [compiler, "-std=c++17", "-Wall", "-Wextra", "-Werror", f"-I{HEADER}", "-o", program, HERE / "relay.cpp"]
    subprocess.run(command, check=True, timeout=300)
    return program


@pytest.fixture
def relay(compiled: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Relay]:
    monkeypatch.setattr(Relay, "command", (str(compiled),))
    with started(operator := Relay(first=5, fail=9, crash=8)):
        yield operator


def number(stamp: int, value: float = 0.0) -> Number:
    return Number(stamp=stamp, value=value)


def call(operator: Program, stamp: int, **given: Message | tuple[Message, ...] | None) -> dict[str, Message]:
    outputs = operator.process(Context(stamp), **given)
    assert isinstance(outputs, dict)
    return outputs


@contextmanager
def started(operator: Program) -> Iterator[Program]:
    operator.setup()
    yield operator
    operator.close()


def test_messages_of_every_type_come_back_bit_for_bit_from_cpp(relay: Relay) -> None:
    shipped = [cls for cls in message_types().values() if cls.__module__.startswith("dataflow.")]
    for turn, cls in enumerate(shipped):
        message = example(cls, seed=turn)
        relay.on_reset("message")
        outputs = call(relay, message.stamp, message=message)
        assert outputs["back"].digest() == message.digest(), cls.SCHEMA
        assert outputs["count"] == Number(stamp=message.stamp, value=5.0, unit="messages")


def test_large_message_is_returned_by_the_program(relay: Relay) -> None:
    message = Image(stamp=1, frame="camera", data=np.arange(1200 * 1600 * 3, dtype=np.uint8).reshape(1200, 1600, 3))
    assert call(relay, 1, message=message)["back"].digest() == message.digest()


def test_state_reset_parameters_and_the_end(relay: Relay) -> None:
    call(relay, 1, message=number(1))
    state = relay.snapshot()
    assert state == {"program": b"\x06"}
    call(relay, 2, message=number(2))
    relay.restore(state)
    assert call(relay, 3, message=number(3))["count"] == Number(stamp=3, value=6.0, unit="messages")
    assert relay.finish() == {"total": Number(stamp=1_000_000, value=2.0)}
    relay.on_reset("message")
    assert call(relay, 4, message=number(4))["count"] == Number(stamp=4, value=5.0, unit="messages")
    relay.set_parameter("fail", 6)
    with pytest.raises(ProgramError, match=r"relay: process\(\) at 5 failed: no such count: 6"):
        call(relay, 5, message=number(5))


def test_a_crash_names_program_signal_and_call(relay: Relay) -> None:
    for stamp in range(3):
        call(relay, stamp, message=number(stamp))
    with pytest.raises(ProgramError, match=r"relay was killed by SIGABRT in process\(\) at 3"):
        call(relay, 3, message=number(3))


def test_two_runs_are_alike(compiled: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Relay, "command", (str(compiled),))
    given = [number(stamp, stamp / 3) for stamp in range(20)]
    runs = [play(Relay(), {"message": given}) for _ in range(2)]
    assert runs[0].digests() == runs[1].digests()
    assert runs[0].digests()["back"] == [m.digest().hex() for m in given]
    assert [m.value for m in runs[0]["total"]] == [20.0]


OWN = """
from dataflow.messages import Number
from dataflow.operator import Out, Source
from program_operators import Relay


class Numbers(Source):
    out: Out[Number] = Out(doc="numbers")

    def stream(self):
        for stamp in range(50):
            yield {"out": Number(stamp=stamp, value=stamp / 7)}


class Own(Relay):
    command = ("./relay",)
"""


def test_a_run_in_processes_verifies_and_a_changed_program_is_named(
    compiled: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program, recording = tmp_path / "relay", tmp_path / "run.mcap"
    shutil.copy(compiled, program)
    (tmp_path / "own_program.py").write_text(OWN)
    monkeypatch.syspath_prepend(tmp_path)
    graph = dataflow.Graph().add("numbers", "own_program:Numbers").add("relay", "own_program:Own")
    graph.connect("relay", message="numbers/out")
    dataflow.launch(graph, record=recording, placement="process_each")

    assert dataflow.verify(recording).identical
    with dataflow.open(recording) as streams:
        assert [m.value for m in streams["relay/total"]] == [50.0]
    program.write_bytes(program.read_bytes() + b"changed")
    (found,) = dataflow.verify(recording).report.operators
    assert found.files_changed == ["./relay"]


@pytest.mark.parametrize(
    ("fault", "text"),
    [
        ("text", r"no reply on standard output, which is for replies alone: b'hello from print\(\)"),
        ("outcome", r"no reply on standard output, .*x07"),
        ("frames", r"no reply on standard output, .*x80"),
        ("unasked", r"before process\(\) at 7 it wrote to its standard output unasked"),
        ("size", "a frame of 2147483648 bytes in the reply"),
        ("half", r"python\S* ended with exit code 3 in process\(\) at 7"),
    ],
)
def test_malformed_reply_ends_the_program(fault: str, text: str) -> None:
    with started(faulty(fault)()) as operator, pytest.raises(ProgramError, match=text):
        call(operator, 7, number=number(7))


@pytest.mark.parametrize(
    ("fault", "text"),
    [
        ("garbage", r"replied with what is no message: prelude: 11 bytes"),
        ("twice", "replied with no message, or two, on 'out'"),
    ],
)
def test_a_reply_that_is_no_message_is_refused(fault: str, text: str) -> None:
    with started(faulty(fault)()) as operator, pytest.raises(OutputError, match=text):
        call(operator, 7, number=number(7))


@pytest.mark.parametrize("fault", ["text", "half", "garbage"])
def test_program_errors_have_no_traceback_of_the_engine(fault: str) -> None:
    with pytest.raises(OperatorFailure, match="python") as raised:
        play(faulty(fault)(), {"number": [number(1)]})
    assert raised.value.traceback == ""


def test_a_port_that_is_not_declared_is_named() -> None:
    with pytest.raises(Exception, match="emitted on 'other'; its outputs: out"):
        play(faulty("port")(), {"number": [number(1)]})


def test_a_program_without_answer_is_killed_in_its_time() -> None:
    with (
        started(faulty("silent", patience=0.5)()) as operator,
        pytest.raises(ProgramError, match=r"process\(\) at 7: no answer in 0.5 s"),
    ):
        call(operator, 7, number=number(7))


def test_a_call_behind_the_end_writes_into_no_other_file(tmp_path: Path) -> None:
    operator = faulty("half")()
    operator.setup()
    with pytest.raises(ProgramError, match="ended with exit code 3"):
        call(operator, 7, number=number(7))
    with ExitStack() as stack:
        others = [stack.enter_context((tmp_path / str(k)).open("w+b")) for k in range(8)]
        with pytest.raises(ProgramError, match=r"has ended: process\(\) at 8 is not made"):
            call(operator, 8, number=number(8))
        assert [other.seek(0, 2) for other in others] == [0] * 8
    operator.close()


def test_an_interrupted_call_ends_the_program(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    operator = faulty("none")()
    operator.setup()
    with monkeypatch.context() as patched:
        patched.setattr(Child, "_read", interrupted)
        with pytest.raises(KeyboardInterrupt):
            call(operator, 7, number=number(7))
    with pytest.raises(ProgramError, match="has ended"):
        call(operator, 8, number=number(8))
    operator.close()


def test_a_program_without_states_gives_none() -> None:
    operator = Faulty(value=0.25)
    operator.setup()
    assert operator.snapshot() is None
    with pytest.raises(StateError, match="cannot restore"):
        operator.restore({"program": b""})
    assert call(operator, 3, number=number(3)) == {"out": Number(stamp=3, value=0.25, unit="m")}
    assert set(operator.files) == {"faulty.py"}
    operator.close()


def test_faults_of_the_declaration_and_the_start_are_named() -> None:
    class Nothing(Program):
        number: In[Number] = In(doc="anything")

    class Several(Program, merge=True):
        command = ("./program",)
        number: In[Number] = In(many=True, doc="anything")

    class Absent(Program):
        command = ("./not_there",)
        number: In[Number] = In(doc="anything")
        before: Batch[Number] = Batch(doc="what came since")
        out: Out[Number] = Out(doc="a result")

    with pytest.raises(OperatorDefinitionError, match=r"Nothing\.command is a tuple"):
        Nothing()
    with pytest.raises(OperatorDefinitionError, match=r"Several\.number: a program takes no input with many=True"):
        Several()
    with pytest.raises(ProgramError, match=r"\./not_there cannot be started: No such file"):
        Absent().setup()
    assert Absent.spec.process_takes == ("number", "before", "context")
