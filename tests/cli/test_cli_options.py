"""Every option that `--help` names is accepted and used once, on a tiny recording; what another test tries is said.

Those of commands of other packages: `tests/operators/training/test_command_options.py`.
"""

from __future__ import annotations

import re
import signal
import socket
from pathlib import Path
from typing import Any

import pytest
from cli_commands import commands, untried
from needed_programs import need

from dataflow.machines import keys

TRIED: tuple[str, ...] = (
    "demo --to OUT.rrd --seconds 1 --quiet --json",
    "run GRAPH --one-process --record OUT.mcap --overwrite --compression lz4 --readable group --record-failure end"
    " --split-every 1h --split-size 1GB --keep-disk 3GB --set count=4 --path HERE --log-level info --paranoid"
    " --timeout 60 --quiet --json",
    "run GRAPH --set count=4 --place left=a --rate 1000 --verbose --view OUT.rrd --open --overwrite",
    "run GRAPH --set count=4 --here --quiet",
    "run GRAPH --set count=4 --process-each --live --chaos CHAOS --chaos-seed 3 --quiet",
    "replay RECORDING --one-process --record OUT.mcap --overwrite --compression none --readable all --quiet --json"
    " --record-failure end --split-every 1h --split-size 1GB --keep-disk 3GB --path HERE --paranoid --timeout 60",
    "replay RECORDING --graph GRAPH --set count=30 --process-each --rate 1000 --start 0 --end 10ms --quiet",
    "replay RECORDING --place left=a --verbose --view OUT.rrd --open --overwrite",
    "replay RECORDING --one-process --network --loop 2",
    "replay RECORDING --complete OUT.mcap",
    "verify RECORDING --jobs 1 --only sum --start 0 --paranoid --path HERE --junit OUT.xml --tolerance 1e-6"
    " --quiet --json",
    "verify RECORDING --graph GRAPH --set count=30 --jobs 2",
    "verify RECORDING --baseline OUT.json --accept --repeat 1 --make-effects",
    "debug RECORDING smooth --graph GRAPH --set count=30 --path HERE --do next --do inputs --json --make-effects",
    "debug RECORDING smooth --do next --view OUT.rrd",
    "capture RECORDING --op sum --firing 3 --predicate stamp --graph GRAPH --set count=30 --path HERE --to OUT.py"
    " --overwrite --json",
    "blame RECORDING --field mean@0 --budget 60 --tolerance 0.1 --graph GRAPH --set count=30 --path HERE --json",
    "env GRAPH --anew --path HERE",
    "check GRAPH --path HERE --set count=4 --json",
    "show GRAPH --path HERE --set count=4 --json",
    "show GRAPH --mermaid",
    "operators --path HERE --json",
    "messages --path HERE --json",
    "graphs --json",
    "info RECORDING --digests --metadata --json",
    "diff RECORDING RECORDING --stream mean --tolerance 0.1 --json",
    "cut RECORDING --from 0 --to 1ms --out OUT.mcap --overwrite --compression lz4 --bare --quiet --json",
    "cut RECORDING --out OUT.mcap --from 0 --duration 1ms",
    "filter RECORDING --stream left/* --without fast --out OUT.mcap --overwrite --compression lz4 --quiet --json",
    "split RECORDING --every 10ms --out OUT --overwrite --compression lz4 --quiet --json",
    "split RECORDING --out OUT --size 1MB",
    "merge RECORDING OTHER --prefix OTHER=other/ --out OUT.mcap --overwrite --compression lz4 --quiet --json",
    "recover RECORDING --out OUT.mcap --overwrite --compression lz4 --quiet --json",
    "latency RECORDING --path HERE --json",
    "spans RECORDING --path HERE --to OUT.jsonl --overwrite",
    "lint RECORDING --write-contract OUT.yaml --overwrite --quick --json",
    "lint RECORDING --contract CONTRACT",
    "view RECORDING --to OUT.rrd --overwrite --stream left/* --without fast --start 0 --end 1 --clock auto",
    "logs RECORDING --last 3 --level info --operator sum --json",
    "list --json",
    "devices --json",
    "new operator Near --kind timer --to OUT --json",
    "new graph near --to OUT --json",
    "new project near --to OUT --json",
    "new service GRAPH --name near --user robot --keep-disk 3GB --days 3 --to OUT --json",
    "keys new OUT",
    "keys add robot --authority AUTHORITY --serves 127.0.0.1 --serves localhost --out OUT",
    "keys add desk --authority AUTHORITY --tools --out OUT",
)
"""Commands as they are typed."""

UNANSWERED: tuple[str, ...] = (
    "echo sum/total --graph none --wait 0 --count 1 --once --field value --full --json",
    "hz --graph none --wait 0 --seconds 1 --window 5 --json",
    "top --graph none --wait 0 --every 1 --once --json",
    "logs --graph none --wait 0 --follow",
    "pub in/x {} --graph none --wait 0 --count 1 --rate 1 --timeout 1 --json",
    "pub in/x {} --graph none --stamp 1",
    "record --graph none --wait 0 --seconds 1 --out OUT.mcap --overwrite --compression lz4 --readable all --quiet"
    " --split-every 1h --split-size 1GB --json",
    "playback pause --graph none --wait 0 --json",
    "trigger --graph none --wait 0 --json",
    "view --graph none --wait 0 --every 2 --to OUT.rrd",
    "foxglove --graph none --wait 0 --port 0 --host 127.0.0.1",
    "param set sum.x 1 --graph none --wait 0 --timeout 1 --json",
    "param get sum.x --graph none --wait 0 --timeout 1 --json",
    "param list --all --graph none --wait 0 --timeout 1 --json",
    "param dump --all --graph none --wait 0 --timeout 1 --out OUT.yaml --overwrite",
    "param load VALUES --graph none --wait 0 --timeout 1",
    "spans --graph none --wait 0 --to OUT.jsonl",
    "health --graph none --wait 0 --rate sum=1 --losses 0.1 --free 1 --folder HERE --over 1 --json",
    "reload sum --graph none --wait 0 --timeout 1 --json",
)
"""Commands for a running graph, where none runs: `test_cli_live.py`, `test_param_top.py` and others have one."""

REMOTE: tuple[str, ...] = tuple(
    f"{line} --connect tls/127.0.0.1:1 --keys AUTHORITY/tools" for line in UNANSWERED if not line.startswith("logs")
)
"""Commands for a graph of another machine, where nothing listens: `tests/machines/test_links.py` has one."""

REFUSED: tuple[tuple[str, str], ...] = (
    (
        "join robot --connect tls/127.0.0.1:1 --keys HERE --folder OUT --path HERE --timeout 5 --once",
        "no authority.pem",
    ),
    ("run GRAPH --live --listen tls/127.0.0.1:1 --keys HERE", "place one there by `machine: NAME`"),
    ("new service GRAPH --listen tls/127.0.0.1:1 --keys HERE", "place one there by `machine: NAME`"),
    ("new agent robot --connect tls/127.0.0.1:1 --keys HERE --user robot --to OUT --json", "no authority.pem"),
    ("debug RECORDING smooth --dap TAKEN", "Address already in use"),
    ("metrics --port TAKEN --folder HERE", "cannot listen on port"),
    ("metrics --port 0 --connect tls/127.0.0.1:1 --keys HERE", "no authority.pem"),
    ("run GRAPH --record RECORDING", "replace it with --overwrite"),
    ("run GRAPH --record GRAPH --overwrite", "ends in .mcap"),
    ("run GRAPH --record FOLDER.mcap", "is a folder"),
    ("run GRAPH --view window", "expected spawn, serve, or a file name that ends in .rrd"),
    ("run GRAPH --view spawn", "there is no display"),
    ("run GRAPH --open", "needs --view FILE.rrd"),
    ("run GRAPH --open --view serve", "needs --view FILE.rrd"),
    *((f"run GRAPH --rate {rate}", "from 0.001 to 1,000") for rate in ("1e-300", "nan", "-1")),
    ("run GRAPH --timeout 0", "from 0.1 to 1,000,000"),
    ("run GRAPH --one-process --process-each", "exclude each other"),
    ("run GRAPH --place nobody=a", "left, smooth, gripper, sum"),
    ("run GRAPH --set cuont=3", "did you mean 'count'?"),
    ("run GRAPH --set smooth.sleep=soon", "sleep"),
    ("run GRAPH --live --step", "a live run cannot wait"),
    ("run GRAPH --compression lz4", "name one with --record"),
    ("run GRAPH --compression gzip", "'gzip' is not one of"),
    ("replay RECORDING --compression lz4", "name one with --record"),
    ("replay RECORDING --compression gzip", "'gzip' is not one of"),
    ("replay RECORDING --start 9", "ends 0.29 s after its first message"),
    ("replay RECORDING --start -1", "0 or more"),
    ("replay RECORDING --start 0.2 --end 0.1", "must be greater"),
    ("replay RECORDING --set count=3", "name it with --graph"),
    ("verify RECORDING --from smooth --only sum", "exclude each other"),
    ("verify RECORDING --accept", "name the file with --baseline"),
    ("verify RECORDING --accept --baseline b.json --only one", "leave --from and --only out"),
    ("verify RECORDING --baseline b.yaml", "ends in .json"),
    ("verify RECORDING --junit v.txt", "ends in .xml"),
    ("verify RECORDING --tolerance -1", "0 or more"),
    ("verify RECORDING --jobs 0", "--jobs 0: expected 1 to"),
    ("verify RECORDING --start 1 --baseline b.json", "--start and --baseline exclude each other"),
    *((f"verify RECORDING --start {at}", f"--start {at}: expected seconds") for at in ("nan", "inf", "-1")),
    ("verify RECORDING absent.mcap", "absent.mcap"),
    ("view RECORDING", "there is no display"),
    ("view absent.mcap", "no file"),
    ("view RECORDING --to window", "expected spawn, serve"),
    ("view RECORDING --to rerun+http://127.0.0.1:9/proxy", "no viewer listens"),
    ("view RECORDING --to OUT.rrd --stream left/fats", "did you mean 'left/fast'?"),
    ("view RECORDING --to OUT.rrd --stream left/fast --start 7", "ends 0.29 s after"),
    ("view RECORDING --to OUT.rrd --graph small", "running graph"),
    ("cut RECORDING -o OUT.mcap --from 1 --to 0.5", "before the beginning"),
    ("cut RECORDING -o OUT.mcap --from 1e6", "ends"),
    ("cut RECORDING -o OUT.mcap --to 1 --duration 1", "name one of them"),
    ("cut RECORDING -o OUT.mcap", "nothing to cut"),
    ("cut RECORDING -o OUT.mcap --from 2026-03-01T12:00:00", "which time zone"),
    ("cut RECORDING -o OUT.mcap --from soon", "--from soon"),
    ("convert RECORDING OUT.mcap --to mcap --depth depth=mm", "expected units a metre, such as 1000"),
    ("convert RECORDING OUT --to ros2 --depth depth", "--depth has no effect on ros2"),
    ("sweep GRAPH --recordings RECORDING --out OUT --what guess", "expected replay, verify or evaluate"),
    ("sweep GRAPH --recordings RECORDING --out OUT --jobs 0", "expected 1 to"),
    ("sweep GRAPH --recordings RECORDING --out OUT --set smooth.sleep", "expected NAME=VALUE"),
    ("sweep GRAPH --recordings RECORDING --out OUT --set smooth.slept=1", "slept"),
    ("sweep GRAPH --recordings nowhere --out OUT", "no file or folder nowhere"),
    ("sweep GRAPH --recordings file:///nowhere/at/all --out OUT", "no file or folder file:///nowhere/at/all"),
    ("compare GRAPH --recordings RECORDING --out OUT --set smooth.sleep", "expected NAME=VALUE"),
    ("compare GRAPH --recordings RECORDING --out OUT --set smooth.sleep=3", "A and B are the same"),
)
"""Commands that are refused, and the words that name the reason; the first would go on until they are ended."""

ELSEWHERE: dict[str, tuple[str, str]] = {
    "convert": ("*", "tests/cli/test_cli_convert.py has a table"),
    "sweep": ("*", "each recording is a process: test_cli_sweep.py"),
    "compare": ("*", "the same: test_cli_sweep.py"),
    "doctor": ("--json", "it measures the machine for seconds: tests/doctor"),
    "completion": ("--install", "it writes into the home folder: test_cli_completion.py"),
    "run": ("--step", "it needs a terminal's keys: tests of playback"),
    "replay": ("--step --map --clock --strict", "a terminal, bags: test_cli_bags.py"),
    "drops": ("*", "it needs losses: test_cli_drops.py"),
    "view": ("--import", "another file of Rerun: tests of the view"),
    "foxglove": ("--start --end --clock --speed --stream", "a server that goes on until Ctrl-C: tests/foxglove"),
    "verify": (
        "--from --why",
        "the state before a moment: tests/verification; causes: tests/causes",
    ),
}
"""By command, options that are not tried here, and why."""


@pytest.fixture(scope="module")
def places(small: Path, recorded: tuple[Path, Any], tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    folder = tmp_path_factory.mktemp("places")
    (folder / "chaos.yaml").write_text("faults:\n  - {at: 10s, kind: freeze, operator: smooth, for: 1s}\n")
    (folder / "contract.yaml").write_text("streams: {}\n")
    (folder / "values.yaml").write_text("sum: {x: 1}\n")
    (folder / "other.mcap").write_bytes(recorded[0].read_bytes())
    (folder / "folder.mcap").mkdir()
    need("openssl")
    keys.new_authority(folder / "authority")
    keys.issue(folder / "authority", folder / "authority" / "tools", keys.TOOLS)
    return {
        "AUTHORITY": str(folder / "authority"),
        "OTHER": str(folder / "other.mcap"),
        "FOLDER.mcap": str(folder / "folder.mcap"),
        "VALUES": str(folder / "values.yaml"),
        "GRAPH": str(small),
        "RECORDING": str(recorded[0]),
        "HERE": str(Path(__file__).parent),
        "CHAOS": str(folder / "chaos.yaml"),
        "CONTRACT": str(folder / "contract.yaml"),
    }


def typed(line: str, places: dict[str, str], tmp_path: Path) -> list[str]:
    found = []
    for word in line.split():
        first, *rest = re.split("([=/])", word, maxsplit=1)
        found.append(str(tmp_path / word) if word.startswith("OUT") else "".join((places.get(first, first), *rest)))
    return found


@pytest.mark.long
@pytest.mark.parametrize("line", TRIED, ids=lambda line: " ".join(line.split()[:3]))
def test_a_command_takes_its_options(dataflow, places: dict[str, str], tmp_path: Path, line: str) -> None:
    if ".rrd" in line:
        pytest.importorskip("rerun")

    dataflow(*typed(line, places, tmp_path))

    assert all(list(tmp_path.glob("OUT*")) for word in line.split() if word.startswith("OUT"))


@pytest.mark.parametrize("line", UNANSWERED, ids=lambda line: " ".join(line.split()[:2]))
def test_command_without_running_graph_is_refused(dataflow, places: dict[str, str], tmp_path: Path, line: str) -> None:
    said = dataflow(*typed(line, places, tmp_path), code=2).stderr

    assert "Usage" not in said
    assert "none" in said or "no graph" in said


@pytest.mark.parametrize("line", REMOTE, ids=lambda line: " ".join(line.split()[:2]))
def test_unreachable_endpoint_is_named(
    dataflow, places: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, line: str
) -> None:
    monkeypatch.setattr(keys, "CONNECT_WITHIN", 50)

    assert "no graph 'none' runs at tls/127.0.0.1:1" in dataflow(*typed(line, places, tmp_path), code=2).stderr


@pytest.mark.parametrize(("line", "reason"), REFUSED)
def test_command_that_cannot_begin_names_the_reason(
    dataflow, places: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, line: str, reason: str
) -> None:
    monkeypatch.setattr(signal, "signal", lambda *_: None)  # the handlers are those of a process that is the agent
    with socket.create_server(("127.0.0.1", 0)) as taken:
        places = {**places, "TAKEN": str(taken.getsockname()[1])}

        told = dataflow(*typed(line, places, tmp_path), code=2)

    assert reason in " ".join(told.stderr.split())
    assert told.stdout == ""
    assert not list(tmp_path.glob("OUT*.*"))


def test_every_option_of_every_built_in_command_is_tried() -> None:
    lines = (*TRIED, *UNANSWERED, *REMOTE, *(line for line, _ in REFUSED))
    assert untried(commands(built_in=True), lines, ELSEWHERE) == {}
