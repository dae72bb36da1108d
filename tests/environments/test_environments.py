"""Operators in virtual environments of different packages: run, recorded and verified in them; what cannot serve."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import sysconfig
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from made_environments import environment, install, packages

from dataflow.capture.captured import check
from dataflow.debugging.debugger import Debugger
from dataflow.environments import EnvError, environment_of, lock
from dataflow.execution import threads
from dataflow.graph import Graph, GraphError
from dataflow.graph.load import load_text
from dataflow.recording import Recording
from dataflow.records.comparison import Difference, Verification
from dataflow.records.reading import FiringLog
from dataflow.reexecution.recorded_run import ReplayError, graph_that_is_here
from dataflow.supervision.core.report import RunFailed
from dataflow.supervision.run import run
from dataflow.tool_server import proof
from dataflow.tool_server.jobs import CallFailed, place_of
from dataflow.tool_server.tools import answer
from dataflow.verification.complete import complete
from dataflow.verification.places import env_of_chain
from dataflow.verification.report import VerifyReport
from dataflow.verification.verify import verify

TEXT = """
graph: gains
record: {record}
operators:
  count: {{use: "env_operators:Count"}}
  first: {{use: "env_operators:Gain", inputs: {{x: count/count}}, env: {folder}/one}}
  second: {{use: "env_operators:Gain", inputs: {{x: first/y}}, env: {folder}/two}}
"""


def graph(folder: Path, record: str = "all") -> Graph:
    return load_text(TEXT.format(folder=folder, record=record))


@pytest.fixture(scope="module")
def environments(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two environments that have the same package in two versions."""
    folder = tmp_path_factory.mktemp("environments")
    environment(folder / "one", "1.0", 2.0)
    environment(folder / "two", "2.0", 5.0)
    return folder


@contextmanager
def other_version(environments: Path) -> Iterator[None]:
    """Another version of the package in the first environment, meanwhile."""
    install(environments / "one", "1.5", 2.5)
    try:
        yield
    finally:
        install(environments / "one", "1.0", 2.0)


@pytest.fixture(scope="module")
def recorded(environments: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("run") / "run.mcap"
    run(graph(environments), record=path)
    return path


def test_each_operator_runs_with_the_packages_of_its_environment(recorded: Path) -> None:
    with Recording(recorded) as recording:
        values = [float(m.message.vectors[0, 0]) for m in recording.messages(["gains/second/y"])]
        packages = {
            name: next(iter(FiringLog.read(recording).ordered(node))).detail.get("packages")
            for name, node in graph(Path("x")).nodes.items()
        }

    assert values == [k * 2.0 * 5.0 for k in range(20)]
    assert packages == {"count": None, "first": {"tiny": "1.0"}, "second": {"tiny": "2.0"}}


def test_the_standard_library_of_this_installation_is_not_that_of_an_environment(environments: Path) -> None:
    path = environment_of(str(environments / "one")).variables(threads.environment(1))["PYTHONPATH"].split(os.pathsep)

    assert path[0] == str(packages(environments / "one"))
    assert [each for each in path if (Path(each) / "os.py").exists() or each.endswith(("lib-dynload", ".zip"))] == []
    assert sysconfig.get_path("purelib") in path


def test_verification_runs_operators_in_their_environments_and_names_other_versions(
    recorded: Path, environments: Path
) -> None:
    report = verify(recorded)
    assert report.identical
    assert [v.packages_changed for v in report.operators] == [[], []]

    with other_version(environments):
        report = verify(recorded)

    assert report.culprits == ("first",)
    assert [v.packages_changed for v in report.operators] == [["tiny 1.0 -> 1.5"], []]


def test_operators_of_two_environments_share_no_process(environments: Path) -> None:
    text = TEXT.format(folder=environments, record="all").replace("env:", "process: gains, env:")
    with pytest.raises(GraphError, match=r"process 'gains' is in two environments: first in .*one, second in .*two"):
        load_text(text)

    with pytest.raises(ValueError, match=r"process 'all' would be in several environments .*one.*two"):
        run(graph(environments), placement="one_process")


@pytest.fixture(scope="module")
def thin(environments: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("thin") / "thin.mcap"
    run(graph(environments, record="{exclude: first/y}"), record=path)
    return path


@pytest.mark.long
def test_operator_in_another_environment_than_its_producer_is_unverifiable(thin: Path) -> None:
    report = verify(thin)

    assert {v.operator: (v.verdict, v.missing) for v in report.operators} == {
        "first": ("identical", ""),
        "second": ("unverifiable", "gains/first/y"),
    }
    with pytest.raises(ReplayError, match=r"'first' and 'second' run in two environments, .* 'gains/first/y': record"):
        verify(thin, only=["second"])


def test_missing_environment_does_not_stop_the_verification_of_others(recorded: Path, environments: Path) -> None:
    (environments / "two").rename(environments / "away")
    try:
        report = verify(recorded)
    finally:
        (environments / "away").rename(environments / "two")

    assert not report.identical
    assert {v.operator: v.verdict for v in report.operators} == {"first": "identical"}
    assert "two' is no environment" in report.absent["second"]


def test_a_recording_of_several_environments_is_not_completed(thin: Path, tmp_path: Path) -> None:
    with pytest.raises(ReplayError, match=r"run in several environments \(.*one, .*two\), and a recording is"):
        complete(thin, tmp_path / "out.mcap")


def test_an_operator_is_not_made_in_a_process_of_another_environment(recorded: Path, environments: Path) -> None:
    wrong = r"operator 'first' needs the environment .*one', and this process is in that of"
    with pytest.raises(EnvError, match=wrong):
        graph(environments).nodes["first"].make()
    with Recording(recorded) as recording, pytest.raises(EnvError, match=wrong):
        Debugger(recording, "first").goto(0)


def command(*words: str, folder: Path) -> subprocess.CompletedProcess[str]:
    here = str(Path(__file__).resolve().parent)
    line = [sys.executable, "-m", "dataflow.cli.main", *words, "--path", here]
    return subprocess.run(line, capture_output=True, text=True, timeout=200, cwd=folder)


@pytest.mark.long
@pytest.mark.parametrize("operator", ["first", "second"])
def test_the_debugger_begins_in_the_environment_of_its_operator(operator: str, recorded: Path, tmp_path: Path) -> None:
    told = command("debug", str(recorded), operator, "--do", "goto 1", folder=tmp_path)

    assert told.returncode == 0, told.stderr
    assert f"{operator}  call 1 of " in told.stdout
    assert "as recorded" in told.stdout


@pytest.mark.long
def test_call_is_captured_and_tested_in_the_environment_of_its_operator(
    recorded: Path, environments: Path, tmp_path: Path
) -> None:
    with other_version(environments):
        told = command("capture", str(recorded), "--op", "first", "--to", str(tmp_path / "test_it.py"), folder=tmp_path)
        assert told.returncode == 0, told.stderr
        with pytest.raises(AssertionError, match=r"in the environment .*one: (.|\n)*first: y.vectors: "):
            check(tmp_path / "test_it.capture")
    check(tmp_path / "test_it.capture")


@pytest.mark.long
def test_blame_runs_in_the_environment_of_its_operators(recorded: Path, tmp_path: Path) -> None:
    told = command("blame", str(recorded), "--field", "first/y.vectors@0.01", folder=tmp_path)
    assert told.returncode == 0, told.stderr
    assert "first #10" in told.stdout

    mixed = command("blame", str(recorded), "--field", "second/y.vectors@0.01", folder=tmp_path)
    assert mixed.returncode == 2
    assert re.search(
        r"'second' runs in the environment '.*two', and what is in front of it in others: 'first' \(", mixed.stderr
    )


@pytest.mark.parametrize(
    ("tool", "arguments", "env"),
    [
        ("goto", {"operator": "first", "call": 1}, "one"),
        ("capture", {"operator": "second"}, "two"),
        ("blame", {"field": "first/y.vectors@0.01"}, "one"),
        ("blame", {"field": "first/y"}, None),  # no field: what the tool says
        ("verify", {}, None),
        (
            "prove",
            {"operator": "first", "call": 1},
            None,
        ),  # it verifies all; the calls of the mended one have a process
        ("mended", {"operator": "first", "call": 1}, "one"),
    ],
)
def test_a_tool_of_an_agent_runs_in_the_environment_of_its_operator(
    tool: str, arguments: dict[str, object], env: str | None, recorded: Path, environments: Path
) -> None:
    python, variables = place_of(tool, {"recording": str(recorded), **arguments})

    assert python == (sys.executable if env is None else str(environments / env / "bin/python"))
    assert (variables["PYTHONPATH"].split(os.pathsep)[0] == str(packages(environments / (env or "one")))) is bool(env)


@pytest.mark.long
def test_a_fix_is_proven_by_calls_in_the_environment_of_its_operator(recorded: Path, environments: Path) -> None:
    here = [str(Path(__file__).resolve().parent)]
    asked = {"recording": str(recorded), "operator": "first", "call": 3, "path": here}
    said: list[str] = []

    def prove(gain: float) -> dict[str, Any]:
        found: dict[str, Any] = answer("prove", {**asked, "expect": f"out.y.vectors[0, 0] == 3 * {gain}"}, said.append)
        return found

    assert prove(7.0)["reasons"][0] == "call 3 still gives what was recorded"
    with other_version(environments):
        proof, wrong = prove(2.5), prove(7.0)

    assert proof["proven"], proof["reasons"]
    assert proof["other_operators"] == {"identical": ["second"]}
    assert proof["changed_calls"]["count"] == 19  # of 20: 0 times a gain is 0
    assert wrong["reasons"] == ["call 3: expect is false: out.y.vectors[0, 0] == 3 * 7.0"]
    assert "call 3 of first made again; all its calls follow" in said
    with pytest.raises(CallFailed, match=r"expect='1 = 2'|no Python expression"):
        answer("prove", {**asked, "expect": "1 = 2"}, said.append)


def test_other_operator_is_judged_without_its_recorded_code(recorded: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = Difference(4, "fire", 0, "y", "aa", "bb")
    second = Verification("second", 20, 20, first=first, own_fault=True, code_changed=["env_operators"])
    report = VerifyReport((second,), (), (), 0, 0, 0.0, 0.0, repeated={"second": True})
    monkeypatch.setattr(proof, "recorded_code", lambda *given: {"env_operators": "abc"})
    monkeypatch.setattr(proof, "recorded_text", lambda code, file: (file.read_bytes(), "a commit"))
    with Recording(recorded) as recording:
        others = proof.judge(recording, report, graph_that_is_here(recording)[0], "first")

    assert others.reasons == {"second": "culprit: differs alike each time (code changed: env_operators)"}


def test_a_tool_that_would_need_two_environments_is_refused(recorded: Path) -> None:
    with pytest.raises(CallFailed, match=r"'second' runs in the environment"):
        place_of("blame", {"recording": str(recorded), "field": "second/y.vectors@0.01"})


def test_chain_leaving_its_environment_is_refused_with_the_askable_part(
    environments: Path,
) -> None:
    text = TEXT.format(folder=environments, record="all").replace(f", env: {environments}/two", "")
    wrong = r"'second' runs in the environment of dataflow itself, .* 'first' \('.*one'\); .* what comes out of first$"

    with pytest.raises(EnvError, match=wrong):
        env_of_chain(load_text(text), "second/y")
    first = env_of_chain(load_text(text), "first/y")
    assert first is not None
    assert first.folder == environments / "one"


def test_an_environment_whose_packages_break_the_engine_is_named_at_once(tmp_path: Path) -> None:
    broken = environment(tmp_path / "one", "1.0", 2.0)
    environment(tmp_path / "two", "1.0", 2.0)
    (packages(broken) / "msgpack.py").write_text("raise SystemExit(3)\n")

    with pytest.raises(RunFailed, match=f"starts the others in {re.escape(str(broken))} "):
        run(graph(tmp_path))


def test_an_environment_is_asked_once_until_it_changes(tmp_path: Path) -> None:
    python = tmp_path / "bin" / "python"
    python.parent.mkdir()
    python.write_text(f"#!/bin/sh\necho asked >> {tmp_path}/asked\necho '[{list(sys.version_info[:2])}, [], null]'\n")
    python.chmod(0o755)
    (packages := tmp_path / "lib" / "python3" / "site-packages").mkdir(parents=True)

    def asked() -> int:
        environment_of(str(tmp_path))
        return len((tmp_path / "asked").read_text().splitlines())

    assert [asked(), asked()] == [1, 1]
    (packages / "other.pth").touch()
    assert asked() == 2


def test_unusable_environment_is_refused_with_the_remedy(tmp_path: Path) -> None:
    with pytest.raises(EnvError, match=r"no environment: .*bin/python is missing; `.* -m venv .*none` makes one"):
        environment_of(str(tmp_path / "none"))

    python = tmp_path / "other" / "bin" / "python"
    python.parent.mkdir(parents=True)
    python.write_text("#!/bin/sh\necho '[[3, 9], [], null]'\n")
    python.chmod(0o755)
    with pytest.raises(EnvError, match=rf"has Python 3\.9, and this one is 3\.{sys.version_info[1]}: make it with"):
        environment_of(str(tmp_path / "other"))

    python.write_text("#!/bin/sh\necho no library >&2; exit 127\n")
    with pytest.raises(EnvError, match=r"its Python cannot be run: no library"):
        environment_of(str(tmp_path / "other"))

    python.write_text(f"#!/bin/sh\necho '[{list(sys.version_info[:2])}, [], \"/x/dataflow/__init__.py\"]'\n")
    with pytest.raises(EnvError, match=r"has another dataflow, /x/dataflow/__init__.py: uninstall it there"):
        environment_of(str(tmp_path / "other"))


def test_requirements_without_their_lock_or_environment_are_refused(tmp_path: Path) -> None:
    requirements = tmp_path / "gains.txt"

    def why() -> str:
        with pytest.raises(EnvError, match=r"`dataflow env GRAPH` builds it") as caught:
            environment_of(str(requirements))
        return str(caught.value)

    assert "there is no file" in why()
    requirements.write_text("tiny\n")
    assert "gains.lock is missing" in why()
    lock.write(requirements, (), {"tiny==1.0": ()})
    assert "gains.env is not built" in why()
    environment(tmp_path / "gains.env", "1.0", 2.0)
    lock.note_built(requirements)
    assert environment_of(str(requirements)).folder == tmp_path / "gains.env"
    lock.write(requirements, (), {"tiny==1.1": ()})
    assert "gains.env was built from another lock" in why()
    requirements.write_text("tiny>1\n")
    assert "gains.lock is out of date" in why()
