"""A graph over two machines does what it does on one, and its recording verifies on one."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil
import pytest
from joined_agents import HERE, Robot, end, join, taken, wait_until

from dataflow.graph import load_text
from dataflow.recording import Recording
from dataflow.supervision.core.report import RunFailed, RunReport
from dataflow.supervision.plan import Rendezvous
from dataflow.supervision.run import run
from dataflow.verification.verify import verify

RUNTIME = HERE.parent / "runtime"
sys.path.append(str(RUNTIME))
GRAPH = """\
graph: two
namespace: test
operators:
  sensor: {use: "machine_operators:Sensor", params: {steps: 120, size: SIZE}, machine: robot, MORE}
  here: {use: "machine_operators:Scale", inputs: {x: sensor/count}, live: {queue: block}}
  there: {use: "machine_operators:Scale", inputs: {x: here/y}, machine: robot, process: own, live: {queue: block}}
  beside: {use: "machine_operators:Scale", inputs: {x: sensor/count}, machine: robot, process: own,
    live: {queue: block}}
  witness: {use: "machine_operators:Witness", inputs: {x: here/y}, machine: robot, process: own}
  last: {use: "machine_operators:Scale", inputs: {x: there/y}, live: {queue: block}}
"""


PLAIN = GRAPH.replace("SIZE", "1").replace(", MORE", "")


def two(robot: Robot, text: str = GRAPH, **options: Any) -> RunReport:
    graph = load_text(text.replace("SIZE", "1").replace(", MORE", ""))
    return run(graph, machines=Rendezvous(robot.endpoint), **options)


@pytest.mark.parametrize("live", [pytest.param(False, marks=pytest.mark.long), True])
def test_a_run_over_two_machines_loses_nothing_and_its_recording_verifies_on_one(
    robot: Robot, live: bool, tmp_path: Path
) -> None:
    text = GRAPH.replace("SIZE", "20000")  # through shared memory on both sides of the link

    report = two(robot, text, live=live, record=tmp_path / "two.mcap")

    assert taken(report) == dict.fromkeys(("here", "there", "beside", "last"), 120)
    assert report.summaries["witness"]["folder"] == str(robot.folder)
    verified = verify(tmp_path / "two.mcap", jobs=1)
    assert verified.identical, verified.as_json()
    assert {v.operator for v in verified.operators} == {"here", "there", "beside", "last"}
    with Recording(tmp_path / "two.mcap") as recording:
        assert recording.metadata["dataflow:packages of robot"] == recording.metadata["packages"]
        assert recording.metadata["dataflow:machine of robot"]["python"] == platform.python_version()


AHEAD = 3600 * 1_000_000_000
SET = f"""\
import time
of_this_machine, seconds = time.time_ns, time.time
time.time_ns = lambda: of_this_machine() + {AHEAD}
time.time = lambda: seconds() + {AHEAD // 1_000_000_000}
"""
CLOCKS = """\
graph: clocks
operators:
  plain: {use: "machine_operators:Sensor", params: {steps: 30}, machine: robot}
  right: {use: "machine_operators:Sensor", params: {steps: 30}, machine: robot, live: {clock: corrected}}
  here: {use: "machine_operators:Scale", inputs: {x: right/count}, live: {queue: block}}
  other: {use: "machine_operators:Scale", inputs: {x: plain/count}, live: {queue: block}}
"""


@pytest.mark.long
def test_stamps_of_a_machine_whose_clock_is_wrong_are_corrected_where_the_graph_asks(tmp_path: Path) -> None:
    shutil.copytree(HERE, tmp_path / "code")
    (tmp_path / "code" / "sitecustomize.py").write_text(SET)
    endpoint = f"unixsock-stream/{tmp_path / 'meet'}"
    agent = join("robot", endpoint, tmp_path / "files", code=tmp_path / "code")
    began = time.time_ns()

    run(load_text(CLOCKS), machines=Rendezvous(endpoint), live=True, record=tmp_path / "clocks.mcap")

    ended = time.time_ns()
    end(agent)
    with Recording(tmp_path / "clocks.mcap") as recording:
        right, plain = (recording.streams[f"clocks/{name}/count"] for name in ("right", "plain"))
    assert right.count == plain.count == 30
    assert began < right.first < right.last < ended
    assert began + AHEAD < plain.first < plain.last < ended + AHEAD
    assert verify(tmp_path / "clocks.mcap", jobs=1).identical


def test_files_that_parameters_name_are_sent_and_code_that_differs_is_named(
    robot: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("models").mkdir()
    Path("models/factor.txt").write_text("3.5")
    with Path("models/large.bin").open("wb") as large:
        large.truncate(70 << 20)  # more than the link's process is given at once
    (robot.folder / "models").mkdir(parents=True, exist_ok=True)
    (robot.folder / "models/factor.txt.part").write_text("of a run that was killed")
    text = (
        GRAPH.replace("  there: {", "  there: {params: {weights: models/factor.txt, other: models/large.bin}, ")
        .replace("  here: {", f"  here: {{params: {{other: '{'no file ' * 40}'}}, ")
        .replace("  beside: {", f"  beside: {{params: {{other: '{'no file ' * 40}'}}, ")
    )

    report = two(robot, text)

    assert report.summaries["there"]["factor"] == 3.5
    assert (robot.folder / "models/factor.txt").read_text() == "3.5"
    assert (robot.folder / "models/large.bin").stat().st_size == 70 << 20
    assert not list((robot.folder / "models").glob("*.part"))
    Path("models/factor.txt").unlink()
    with pytest.raises(RunFailed, match=r"models/factor\.txt is missing where the run is started"):
        two(robot, text)
    theirs = robot.code / "machine_operators.py"
    before = theirs.read_text()
    theirs.write_text(before + "# changed there\n")
    descriptors = []
    for _ in range(2):
        with pytest.raises(RunFailed, match=r"machine 'robot' cannot take part: machine_operators\.py differs"):
            two(robot)
        descriptors.append(settled(psutil.Process(robot.process.pid).num_fds))
    theirs.write_text(before)
    assert descriptors[0] == descriptors[1]


@pytest.mark.long
def test_a_machine_that_lacks_a_module_is_named_let_go_and_takes_the_next_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its agent has not imported the operators then, and no process was begun."""
    for place in ("here", "there"):
        shutil.copytree(HERE, tmp_path / place)
        own = tmp_path / place / "scales"
        own.mkdir()
        (own / "gains.py").write_text("GAIN = 2.0\n")
        (tmp_path / place / "own_scale.py").write_text(
            "from machine_operators import Scale\nfrom scales.gains import GAIN\nclass OwnScale(Scale): pass\n"
        )
    (tmp_path / "there" / "scales" / "gains.py").unlink()
    monkeypatch.syspath_prepend(tmp_path / "here")
    endpoint = f"unixsock-stream/{tmp_path / 'meet'}"
    agent = join("robot", endpoint, tmp_path / "files", code=tmp_path / "there")
    other = PLAIN.replace('there: {use: "machine_operators:Scale"', 'there: {use: "own_scale:OwnScale"')

    with pytest.raises(RunFailed, match=r"machine 'robot' cannot take part: scales/gains\.py is missing"):
        run(load_text(other), machines=Rendezvous(endpoint))
    report = run(load_text(PLAIN), machines=Rendezvous(endpoint))
    with pytest.raises(RunFailed, match="is missing"):
        run(load_text(other), machines=Rendezvous(endpoint))

    assert report.summaries["there"]["taken"] == 120
    assert "was not heard" not in end(agent)


@pytest.mark.long
def test_dead_remote_process_is_restarted_there_or_ends_the_run(robot: Robot, tmp_path: Path) -> None:
    dying = GRAPH.replace("size: SIZE}", f"dies: '{tmp_path / 'died'}'}}")

    with pytest.raises(RunFailed, match=r"process 'sensor' was killed by SIGKILL"):
        two(robot, dying, live=True)
    (tmp_path / "died").unlink()
    policy = "live: {restart: {max: 2, backoff: 10ms}}"
    calibrated = (
        f"  calibrated: {{use: 'machine_operators:Calibrated', inputs: {{x: sensor/count, constant: sensor/constant}}, "
        f"params: {{dies: '{tmp_path / 'taker died'}'}}, {policy}}}\n"
    )
    report = two(robot, dying.replace("MORE", policy) + calibrated, live=True, record=tmp_path / "died.mcap")

    assert report.restarts == {"sensor": 1, "calibrated": 1}
    assert report.summaries["calibrated"]["taken"] > 20
    assert report.summaries["there"]["taken"] > 60
    assert verify(tmp_path / "died.mcap", jobs=1).identical


def test_a_machine_that_does_not_join_is_named_with_the_command_that_joins_it(tmp_path: Path) -> None:
    meeting = Rendezvous(f"unixsock-stream/{tmp_path / 'meet'}")
    with pytest.raises(RunFailed, match=r"machine 'robot' did not join\. On each: dataflow join NAME --connect unix"):
        run(load_text(PLAIN), machines=meeting, start_timeout=0.2)


@pytest.mark.long
def test_a_graph_that_names_machines_does_not_silently_run_on_one() -> None:
    graph = load_text(PLAIN)
    with pytest.raises(RunFailed, match=r"machine robot: say where machines join .* or run all of it here"):
        run(graph)
    assert run(graph, machines=None).summaries["there"]["taken"] == 120


@pytest.mark.long
def test_killed_supervisor_leaves_no_operators_and_the_machine_accepts_a_run(tmp_path: Path) -> None:
    endpoint = f"unixsock-stream/{tmp_path / 'meet'}"
    agent = join("robot", endpoint, tmp_path / "files", "--timeout", "2")
    graph = tmp_path / "two.yaml"
    graph.write_text(PLAIN.replace("steps: 120", "steps: 1000000"))
    command = [sys.executable, "-m", "dataflow.cli.main", "run", str(graph), "--live", "--listen", endpoint, "--quiet"]
    supervisor = subprocess.Popen(command, env={**os.environ, "PYTHONPATH": str(HERE)})
    there = psutil.Process(agent.pid)
    wait_until(lambda: any(child.name() == "sensor" for child in there.children(recursive=True)))

    supervisor.kill()

    supervisor.wait(timeout=20)
    wait_until(lambda: not there.children(recursive=True))
    assert run(load_text(PLAIN), machines=Rendezvous(endpoint)).summaries["there"]["taken"] == 120
    assert "was not heard for 2 s" in end(agent)


def settled(count: Callable[[], int]) -> int:
    """Returns a count once it has not changed in ten looks (bounded)."""
    seen = [count()]

    def still() -> bool:
        seen.append(count())
        return len(seen) > 10 and len(set(seen[-10:])) == 1

    wait_until(still)
    return seen[-1]


@pytest.mark.long
def test_streams_of_a_run_are_equal_on_one_two_and_three_machines(tmp_path: Path) -> None:
    endpoint = f"unixsock-stream/{tmp_path / 'meet'}"
    agents = [join(name, endpoint, tmp_path / name, code=RUNTIME) for name in ("robot", "arm")]
    steps = "params: {count: 200, ratio: 4}"
    digests = []
    for left, smooth in ((None, None), ("robot", None), ("robot", "arm")):
        places = {"LEFT": left, "SMOOTH": smooth}
        text = (
            "graph: three\nnamespace: test\noperators:\n"
            f"  left: {{use: 'runtime_operators:Counter', {steps}LEFT}}\n"
            "  smooth: {use: 'runtime_operators:Smooth', inputs: {x: left/fast}SMOOTH}\n"
            "  sum: {use: 'runtime_operators:Sum', inputs: {x: smooth/mean}}\n"
        )
        for word, machine in places.items():
            text = text.replace(word, f", machine: {machine}" if machine else "")
        digests.append(run(load_text(text), machines=Rendezvous(endpoint), window=(16, 1 << 20)).streams)

    for agent in agents:
        end(agent)
    assert digests[0] == digests[1] == digests[2]
    assert digests[0]["test/smooth/mean"][0] > 100


def test_a_placement_that_puts_two_machines_into_one_process_is_refused(robot: Robot) -> None:
    with pytest.raises(ValueError, match=r"process 'all' would be on several machines \(robot, this one\)"):
        two(robot, placement="one_process")
