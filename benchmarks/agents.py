"""Do the tools of `dataflow mcp` lead to the call and the line of a bug, and does `prove` know its fix? Prints tables.

python benchmarks/agents.py [--seed N] [--bugs N]

Ten operators that ship run on two seconds of the bundled recording, in a copy of their package with a git commit.
Faults are drawn from the modules that one of them alone uses (`tools/mutants.py`), from lines that run in its calls or
are in no function; one that changes no output, or fails before the first call, is drawn again. A fixed policy then
calls tools alone: `verify` names the operator, `diff` the call, `lines` the line; `prove` judges the right fix, and for
one fault of each operator a wrong one: another fault in the same function. Which call differs first is read beside
that, from the records of a run with the fault.
Exit code 1 where an operator or a call is missed, more than a quarter of the lines are, or a fix is misjudged.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import itertools
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path.append(str(REPOSITORY / "tools"))
os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "DATAFLOW_THREADS"), "1")

from mutants import Mutant, mutants_of  # noqa: E402

from dataflow.debugging.debugger import Debugger  # noqa: E402
from dataflow.debugging.lines import Lines, homes_of  # noqa: E402
from dataflow.graph import load_graph  # noqa: E402
from dataflow.graph.code import code_now  # noqa: E402
from dataflow.recording import Recording  # noqa: E402
from dataflow.records.firing import CALLS  # noqa: E402
from dataflow.records.reading import FiringLog  # noqa: E402
from dataflow.reexecution.recorded_run import resolved_graph  # noqa: E402
from dataflow.text import json_text  # noqa: E402
from dataflow.tool_server.jobs import MOST_BYTES  # noqa: E402
from dataflow.tool_server.tools import answer  # noqa: E402
from dataflow.tool_server.work import explained  # noqa: E402

PRELOADED = (
    "dataflow.api.runs",
    "dataflow.graph",
    "dataflow.verification.verify",
    "dataflow.debugging.suspects",
    "scipy.stats",
)
"""Modules that each process has from the beginning: none is the operators'."""

DEMO = REPOSITORY / "recordings" / "demo.mcap"
GRAPH = """
graph: agents
namespace: robot1
operators:
  robot:
    use: operators.simulator:SimulatedRobot
    params:
      duration: 21s
      first_stamp: 1700000000000000000
      color_camera: {rate: 10, width: 320, height: 240, output: jpeg, jpeg_quality: 80}
      depth_camera: {rate: 10, output: png}
      lidar: {rate: 5}
      inertial: {rate: 100}
      wheels: {rate: 20}
      truth: {poses: 10, boxes: true, masks: true, relations: 1, activities: 5}
  wheels:
    use: operators.odometry:WheelOdometry
    inputs: {wheels: robot/wheel_ticks}
    params: {track: 0.4, odometry_frame: odom}
  orientation: {use: "operators.fusion:OrientationFilter", inputs: {imu: robot/imu}, params: {heading: relative}}
  fusion:
    use: operators.fusion:EkfFusion
    inputs: {measurements: [robot/imu, robot/wheel_odometry], extrinsics: robot/extrinsics}
    params: {start: origin, sensors: {robot/wheel_odometry: {use: wheels, sigma: 0.03}}}
  metrics:
    use: operators.evaluation:TrajectoryMetrics
    inputs: {estimate: fusion/odometry, ground_truth: robot/true_base}
  watch: {use: "operators.monitoring:ScanWatch", inputs: {cloud: robot/points}}
  thin:
    use: operators.cloud:CloudFilter
    inputs: {cloud: robot/points}
    params: {voxel: 0.15, outlier_neighbours: 12, outlier_ratio: 3.0}
  planes:
    use: operators.cloud:PlaneSegmenter
    inputs: {cloud: thin/filtered, pose: robot/true_base, extrinsics: robot/extrinsics}
    params: {period: 0.5}
  things: {use: "operators.cloud:Clusterer", inputs: {cloud: planes/rest}}
  tracker: {use: "operators.tracking:MultiObjectTracker", inputs: {detections: robot/objects}}
  movers:
    use: operators.tracking:MultiObjectTracker3D
    inputs: {boxes: robot/boxes, pose: fusion/odometry, extrinsics: robot/extrinsics}
"""
OPERATORS = ("wheels", "orientation", "fusion", "metrics", "watch", "thin", "planes", "things", "tracker", "movers")
SPAN = 2.0
"""Seconds of the recording."""
LIMIT = 120
"""Seconds of a run; a fault by which it takes longer is drawn again."""
DIED = f"died, or takes longer than {LIMIT} s"
MOST_CPU = 20
"""Seconds of CPU time of one operator's calls, which take up to 0.2 s without a fault."""
MOST_DRAWN = 40
"""Faults drawn for a bug."""
WHOLE = (1, 10**9)
"""Lines of what is in no function."""
COLUMNS = ("operator", "call", "line", "line among changes", "line without git", "right fix", "wrong fix")
INNOCENT = 5
"""Most changes without effect that `lines` is shown along with the bug."""


@dataclass
class Bug:
    """A fault, the first call that it changes, and what the tools answered."""

    operator: str
    mutant: Mutant
    first: int
    recording: Path
    again: list[Mutant] = field(default_factory=list)
    """Faults drawn before it that change nothing."""
    answers: dict[str, str] = field(default_factory=dict)


class Bench:
    """A copy of the operators that faults are written into, with the recording that the right ones made."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.checkout = folder, folder / "checkout"
        shutil.copytree(REPOSITORY / "operators", self.checkout / "operators")
        (self.checkout / "agents.yaml").write_text(GRAPH)
        git = ["git", "-C", str(self.checkout), "-c", "user.name=bench", "-c", "user.email=bench@localhost"]
        for words in (["init", "-q"], ["add", "operators"], ["commit", "-qm", "The right operators"]):
            subprocess.run([*git, *words], check=True, timeout=60)
        os.chdir(self.checkout)
        sys.path.insert(0, str(self.checkout))
        for module in PRELOADED:
            importlib.import_module(module)
        self.calls: list[tuple[str, float, int]] = []
        self.good = folder / "good.mcap"
        sys.dont_write_bytecode = False  # once, of the right operators: a fault may have the size and second of another
        if (wrong := self.run(self.good)) is not None:
            raise SystemExit(f"the right operators fail: {wrong}")
        sys.dont_write_bytecode = True
        self.right = {name: self.outcomes(self.good, name) for name in OPERATORS}
        self.files = {n: [Path(f) for f in files] for n, files in forked(_files, self.checkout).items()}

    def run(self, record: Path) -> str | None:
        """Runs the operators as they are in the copy; returns why it did not end well, if it did not."""
        told = forked(_replayed, record)
        return told["error"] if isinstance(told, dict) else None

    def outcomes(self, recording: Path, operator: str) -> list[Any]:
        """Returns what each call of an operator gave, by its records."""
        told = forked(_outcomes, recording, operator)
        return told if isinstance(told, list) else []

    def first_difference(self, recording: Path, operator: str) -> int | None:
        """Returns the number of the first call that gave another result than the right operators."""
        right, here = self.right[operator], self.outcomes(recording, operator)
        for number, pair in enumerate(zip(right, here, strict=False)):
            if pair[0] != pair[1]:
                return number
        return len(here) if len(here) < len(right) else None

    def ask(self, tool: str, **arguments: Any) -> Any:
        """Calls a tool in its own process, as the server does; returns the answer, or the text of an error."""
        began = time.monotonic()
        found = forked(answer, tool, arguments, lambda text: None)
        self.calls.append((tool, time.monotonic() - began, len(json_text(found).encode())))
        return found["error"] if isinstance(found, dict) and found.keys() == {"error"} else found

    def drawn(self, operator: str, seed: int) -> Iterator[Mutant]:
        """Yields the faults of an operator's own modules in random order, equal ones for equal seeds."""
        ran = {(Path(file), line) for file, line in forked(_ran, self.good, operator)}
        every = [
            mutant
            for file in self.files[operator]
            for mutant in mutants_of(file, file.read_bytes())
            if (self.checkout / file, mutant.line) in ran or function_of(mutant) == WHOLE
        ]
        random.Random(f"{seed} {operator}").shuffle(every)
        yield from every[:MOST_DRAWN]

    def tried(self, operator: str, mutant: Mutant, recording: Path) -> int | str:
        """Returns the first call that a fault changes; in words why there is none.

        A fault that changes no call of the operator, given what it was given then, is not run.
        """
        with written([mutant]):
            alone = forked(_changes, self.good, operator)
            if alone is False or (isinstance(alone, dict) and alone["error"] == DIED):
                return DIED if alone else "changes no output"
            recording.unlink(missing_ok=True)
            wrong = self.run(recording)
        if wrong == DIED:
            return wrong
        first = self.first_difference(recording, operator) if recording.exists() else None
        if first is None or first >= len(self.outcomes(recording, operator)):
            return "changes its figures alone" if wrong is None else f"fails before a call: {wrong[:80]}"
        return first


def forked(function: Callable[..., Any], *arguments: Any) -> Any:
    """Calls a function in a process that has not imported the operators yet; returns its values as JSON has them, or
    `{"error": ...}`."""
    begin, end = os.pipe()
    child = os.fork()
    if child == 0:
        os.setsid()
        os.close(begin)
        quiet = os.open(os.devnull, os.O_WRONLY)
        os.dup2(quiet, 1)
        os.dup2(quiet, 2)
        try:
            found = function(*arguments)
        except BaseException as error:
            found = {"error": explained(error)}
        with os.fdopen(end, "w") as told:
            told.write(json_text(found))
        os._exit(0)
    os.close(end)
    timer = threading.Timer(LIMIT, os.killpg, [child, signal.SIGKILL])
    timer.start()
    with os.fdopen(begin) as told:
        text = told.read()
    timer.cancel()
    os.waitpid(child, 0)
    return json.loads(text) if text else {"error": DIED}


def _replayed(record: Path) -> str:
    import dataflow

    dataflow.replay(DEMO, graph="agents.yaml", end=SPAN, record=record, overwrite=True)
    return "done"


def _changes(recording: Path, operator: str) -> bool:
    """Returns whether an operator makes anything else than recorded of the recorded inputs."""
    resource.setrlimit(resource.RLIMIT_CPU, (MOST_CPU, MOST_CPU))
    with Recording(recording) as opened, closing(Debugger(opened, operator)) as debugger:
        return debugger.first_difference() is not None


def _outcomes(recording: Path, operator: str) -> list[Any]:
    with Recording(recording) as opened:
        graph = resolved_graph(opened)
        assert graph is not None
        node = next(node for name, node in graph.nodes.items() if name.rpartition("/")[2] == operator)
        records = [record for record in FiringLog.read(opened).ordered(node) if record.kind in CALLS]
    return [[r.outcome, [None if o is None else o.digest.hex() for o in r.outputs or ()]] for r in records]


def _ran(recording: Path, operator: str) -> list[tuple[str, int]]:
    """Returns the lines that ran in the calls of an operator."""
    found = set[tuple[str, int]]()

    def at_line(frame: FrameType, _: int) -> None:
        found.add((frame.f_code.co_filename, frame.f_lineno))

    with Recording(recording) as opened, closing(Debugger(opened, operator)) as debugger:
        through = Lines(at_line, homes_of(debugger.node.operator.__module__)).through
        for _ in debugger.each(0, len(debugger.calls) - 1, through):
            continue
    return sorted(found)


def _files(checkout: Path) -> dict[str, list[str]]:
    """Returns the files of the modules that one operator alone uses."""
    nodes = load_graph("agents.yaml").nodes
    found = {n.rpartition("/")[2]: [*code_now(node.operator).digests] for n, node in nodes.items()}
    return {
        name: [
            str(Path(sys.modules[module].__file__ or "").relative_to(checkout))
            for module in modules
            if module in sys.modules and sum(module in others for others in found.values()) == 1
        ]
        for name, modules in found.items()
    }


class written:
    """The faults in their files, until the end of the block; they do not overlap."""

    def __init__(self, mutants: list[Mutant]) -> None:
        self._mutants = sorted(mutants, key=lambda each: -each.start)
        self._before = {m.file: (m.file.read_bytes(), m.file.stat().st_mtime_ns) for m in mutants}

    def __enter__(self) -> None:
        for mutant in self._mutants:
            mutant.file.write_bytes(mutant.written(mutant.file.read_bytes()))

    def __exit__(self, *_: object) -> None:
        for file, (text, written_at) in self._before.items():
            file.write_bytes(text)
            os.utime(file, ns=(written_at, written_at))


def function_of(mutant: Mutant) -> tuple[int, int]:
    """Returns the first and last line of the innermost function around a fault; those of the file for none."""
    spans = [
        (node.lineno, node.end_lineno or 0)
        for node in ast.walk(ast.parse(mutant.file.read_bytes()))
        if isinstance(node, ast.FunctionDef) and node.lineno <= mutant.line <= (node.end_lineno or 0)
    ]
    return max(spans, default=WHOLE)


def apart(mutant: Mutant, others: list[Mutant]) -> bool:
    """Returns whether a fault lies on lines that neither those of others nor their neighbours are."""
    return all(
        last_line(mutant) + 1 < each.line or last_line(each) + 1 < mutant.line
        for each in others
        if each.file == mutant.file
    )


def last_line(mutant: Mutant) -> int:
    return int(mutant.line + mutant.file.read_bytes().count(b"\n", mutant.start, mutant.end))


def named(found: Any, bug: Bug) -> str:
    """Judges the answer of `lines`: what it names first, and whether the fault is in it."""
    if isinstance(found, str):
        return f"missed: {found[:80]}"
    if found["changes"]:
        first = found["changes"][0]
        place, span = first["file"], (first["first"], max(first["first"], first["last"]))
    elif found["raised"]:
        place, span = found["raised"][0], (found["raised"][1],) * 2
    else:
        spans = [(file, *pair) for file, pairs in (found["alone"] or found["ran"]).items() for pair in pairs]
        inside = any(Path(f).match(str(bug.mutant.file)) and a <= bug.mutant.line <= b for f, a, b in spans)
        return f"{'among' if inside else 'missed by'} {sum(b - a + 1 for _, a, b in spans)} lines"
    hit = Path(place).match(str(bug.mutant.file)) and span[0] <= bug.mutant.line <= span[1]
    return ("found" if hit else f"missed: {Path(place).name}:{span[0]}") + (
        f" ({span[1] - span[0] + 1} lines)" if span[1] > span[0] else ""
    )


def draw(bench: Bench, operator: str, seed: int) -> Iterator[Bug]:
    """Draws bugs of an operator; prints the faults that were drawn again."""
    again = list[Mutant]()
    for number, mutant in enumerate(bench.drawn(operator, seed)):
        recording = bench.folder / f"{operator}_{number}.mcap"
        first = bench.tried(operator, mutant, recording)
        if isinstance(first, int):
            yield Bug(operator, mutant, first, recording, again)
        else:
            print(f"- {operator}: `{mutant}`: {first}", flush=True)
            again += [mutant] if first == "changes no output" else []


def look(bench: Bench, bug: Bug) -> None:
    """Asks the tools for the operator, the call and the line, by nothing but the good recording."""
    good = str(bench.good)
    with written([bug.mutant]):
        told = bench.ask("verify", recording=good)
        culprits = told if isinstance(told, str) else [name.rpartition("/")[2] for name in told.get("culprits", ())]
        bug.answers["operator"] = "found" if culprits == [bug.operator] else f"missed: {culprits}"
        operator = culprits[0] if isinstance(culprits, list) and culprits else bug.operator
        told = bench.ask("diff", recording=good, operator=operator)
        number = told if isinstance(told, str) else told["number"]
        bug.answers["call"] = "found" if number == bug.first else f"missed: {str(number)[:80]}"
        bug.answers["line"] = named(bench.ask("lines", recording=good, operator=operator), bug)
        (bench.checkout / ".git").rename(bench.folder / "hidden")
        try:
            bug.answers["line without git"] = named(bench.ask("lines", recording=good, operator=operator), bug)
        finally:
            (bench.folder / "hidden").rename(bench.checkout / ".git")
    innocent = beside(bench, bug)
    with written([bug.mutant, *innocent]):
        found = bench.ask("lines", recording=good, operator=bug.operator)
        bug.answers["line among changes"] = f"{named(found, bug)}, {len(innocent)} others"


def beside(bench: Bench, bug: Bug) -> list[Mutant]:
    """Returns faults that change nothing alone, in whose company the bug still shows."""
    found = list[Mutant]()
    for each in bug.again:
        if len(found) < INNOCENT and apart(each, [bug.mutant, *found]):
            with written([bug.mutant, *found, each]):
                if forked(_changes, bench.good, bug.operator) is True:
                    found.append(each)
    return found


def judge(bench: Bench, bug: Bug, wrong: bool, seed: int) -> None:
    """Asks for the proof of the right fix, and of a wrong one."""
    arguments = {"recording": str(bug.recording), "operator": bug.operator, "call": str(bug.first)}
    arguments |= {"expect": "error is None", "right": str(bench.good)}
    told = bench.ask("prove", **arguments)
    bug.answers["right fix"] = "accepted" if not isinstance(told, str) and told["proven"] else f"refused: {told}"[:300]
    if not wrong:
        return
    begin, end = function_of(bug.mutant)
    others = [
        each
        for each in mutants_of(bug.mutant.file, bug.mutant.file.read_bytes())
        if begin <= each.line <= end and each != bug.mutant
    ]
    random.Random(seed).shuffle(others)
    for other in others[:MOST_DRAWN]:
        if not isinstance(bench.tried(bug.operator, other, bench.folder / "other.mcap"), int):
            continue
        with written([other]):
            told = bench.ask("prove", **arguments)
        accepted = not isinstance(told, str) and told["proven"]
        why = told if isinstance(told, str) else "; ".join(told["reasons"])
        why = " ".join(why.replace(str(bench.folder), "").split())[:110]
        bug.answers["wrong fix"] = "ACCEPTED" if accepted else f"rejected: `{other}`: {why}"
        return
    bug.answers["wrong fix"] = "none: no other fault of the function changes an output"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--bugs", type=int, default=2, help="of each operator")
    given = parser.parse_args()
    bugs, rows = list[Bug](), list[str]()
    with tempfile.TemporaryDirectory() as name:
        bench = Bench(Path(name).resolve())
        try:
            drawing = {operator: draw(bench, operator, given.seed) for operator in OPERATORS}
            for number, operator in itertools.product(range(given.bugs), OPERATORS):
                if (bug := next(drawing[operator], None)) is None:
                    print(f"- {operator}: no bug {number} among {MOST_DRAWN} faults")
                    continue
                look(bench, bug)
                judge(bench, bug, number == 0, given.seed)
                cells = " | ".join(bug.answers.get(column, "") for column in COLUMNS)
                rows.append(f"| {operator}: `{bug.mutant}` | {bug.first} | {cells} |".replace("||", "\\|\\|"))
                print(rows[-1], flush=True)
                bugs.append(bug)
        finally:
            os.chdir(REPOSITORY)
        longest = max(bench.calls, key=lambda call: call[1])
        largest = max(size for _, _, size in bench.calls)
    print("\n| fault | first call |", " | ".join(COLUMNS), "|\n| --- | ---: |", " --- |" * len(COLUMNS))
    print(*rows, sep="\n")
    print(f"\nLongest call: {longest[1]:.1f} s (`{longest[0]}`); behind 4.5 s the server answers by a job.")
    print(f"Largest answer: {largest} bytes; behind {MOST_BYTES} it comes in parts.")
    hits = {c: sum(b.answers.get(c, "").startswith(("found", "accepted", "rejected")) for b in bugs) for c in COLUMNS}
    given_wrong = sum("wrong fix" in bug.answers for bug in bugs)
    print(f"{len(bugs)} faults of {len(OPERATORS)} operators, seed {given.seed}; found, or judged rightly:", hits)
    whole = all(hits[c] == len(bugs) for c in ("operator", "call", "right fix")) and hits["wrong fix"] == given_wrong
    lines = min(hits["line"], hits["line among changes"])
    return int(not whole or lines * 4 < len(bugs) * 3 or len(bugs) < given.bugs * len(OPERATORS))


if __name__ == "__main__":
    sys.exit(main())
