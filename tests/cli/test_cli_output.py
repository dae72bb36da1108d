"""Numbers, units, stream names and files, as the command line writes and reads them."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console
from rich.text import Text

from dataflow.cli.support.arguments import chosen_streams, existing, graph_file, output_file, window
from dataflow.cli.support.output import about_a_file, friendly_errors, plural, seconds, size, table
from dataflow.cli.support.progress import RunDisplay, shown, waiting_for
from dataflow.cli.support.report import is_lacking, print_report, report_json
from dataflow.execution.failure import OperatorFailure
from dataflow.supervision.core.report import OperatorCounts, RunFailed, RunReport, Status
from dataflow.text import jsonable


@pytest.mark.parametrize(
    ("written", "text"),
    [
        *((size(n), text) for n, text in ((0, "0 B"), (999, "999 B"), (1000, "1.0 kB"), (999_960, "1.0 MB"))),
        *((seconds(n), text) for n, text in ((0.634, "0.63 s"), (9.999, "10.0 s"), (59.97, "1 min 00 s"))),
        (size(3.21e9), "3.2 GB"),
        (seconds(245), "4 min 05 s"),
        (seconds(7380), "2 h 03 min"),
        (plural(1, "stream"), "1 stream"),
        (plural(1200, "stream"), "1,200 streams"),
    ],
)
def test_quantities_are_written_with_their_unit(written: str, text: str) -> None:
    assert written == text


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=8,
)


@settings(max_examples=100, deadline=None)
@given(values)
def test_everything_becomes_json_that_others_can_parse(value: object) -> None:
    def refuse(word: str) -> None:
        raise AssertionError(word)

    json.loads(json.dumps(jsonable(value), allow_nan=False), parse_constant=refuse)


def test_arrays_and_numpy_numbers_become_json_values() -> None:
    assert jsonable({"a": np.array([1.5, np.nan]), "n": np.int64(3), "p": Path("x")}) == {
        "a": [1.5, "NaN"],
        "n": 3,
        "p": "x",
    }


STREAMS = ["robot1/camera/image", "robot1/camera/depth", "robot1/odometry/odometry", "/tf"]


@pytest.mark.parametrize(
    ("words", "found"),
    [
        (["camera/image"], STREAMS[:1]),  # relative to the namespace
        (["robot1/camera/image"], STREAMS[:1]),  # in full
        (["/robot1/camera/image"], STREAMS[:1]),  # absolute
        (["camera/*"], STREAMS[:2]),
        (["odometry/*", "camera/depth"], STREAMS[1:3]),  # in the order of the recording
        (["/tf"], STREAMS[3:]),  # as foreign recordings name them
        (["tf"], STREAMS[3:]),
        (["depth"], STREAMS[1:2]),  # by its last part
        (None, STREAMS),
    ],
)
def test_streams_are_named_in_short_in_full_or_with_wildcards(words, found) -> None:
    assert chosen_streams(words, STREAMS, "robot1") == found


@pytest.mark.parametrize(
    ("word", "message"),
    [("camera/imag", "did you mean 'camera/image'"), ("nothing/*", "no stream 'nothing/*'"), ("a//b", "empty part")],
)
def test_a_stream_that_does_not_exist_is_answered_with_the_nearest(capsys, word: str, message: str) -> None:
    with pytest.raises(typer.Exit) as ended:
        chosen_streams([word], STREAMS, "robot1")

    assert ended.value.exit_code == 2
    assert message in capsys.readouterr().err


def test_a_missing_file_is_answered_with_the_nearest(tmp_path: Path, capsys) -> None:
    (tmp_path / "kitchen.mcap").touch()
    for path, message in (
        (tmp_path / "kichen.mcap", "did you mean"),
        (tmp_path, "is a folder"),
        (tmp_path / "no" / "run.mcap", "there is no folder"),
    ):
        with pytest.raises(typer.Exit):
            existing(path, "a recording")
        assert message in capsys.readouterr().err


def test_a_misspelt_graph_that_comes_with_it_is_answered_with_the_nearest(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    for word, message in (
        ("sythetic_rgbd", "no file sythetic_rgbd; did you mean synthetic_rgbd?"),
        ("xyzzy", "no file xyzzy; expected a graph file (dataflow graphs lists"),
    ):
        with pytest.raises(typer.Exit):
            graph_file(Path(word))
        assert message in " ".join(capsys.readouterr().err.split())


def test_an_output_file_never_replaces_anything_unasked(tmp_path: Path, capsys) -> None:
    file = tmp_path / "new" / "run.mcap"
    assert output_file(file, ".mcap", overwrite=False, option="--record") == file
    assert file.parent.is_dir()
    file.touch()
    with pytest.raises(typer.Exit):
        output_file(file, ".mcap", overwrite=False, option="--record")
    assert "--overwrite" in capsys.readouterr().err
    output_file(file, ".mcap", overwrite=True, option="--record")
    with pytest.raises(typer.Exit):  # whatever is asked: a graph file is no recording
        output_file(tmp_path / "graph.yaml", ".mcap", overwrite=True, option="--record")


def test_start_and_end_are_seconds_from_the_first_message(capsys) -> None:
    whole, path = (10**9, 3 * 10**9), Path("run.mcap")

    assert window(whole, 0.5, 1.5, path) == (1_500_000_000, 2_500_000_000)
    assert window(whole, None, None, path) == (None, None)
    for start, end in ((-1.0, None), (2.1, None), (1.0, 1.0), (float("nan"), None)):
        with pytest.raises(typer.Exit):
            window(whole, start, end, path)


@pytest.mark.parametrize("width", [80, 120])
def test_the_summary_of_a_run_fits_the_terminal(width: int) -> None:
    report = RunReport(
        graph="rgbd_perception",
        streams={},
        operators={"trajectory_metrics": OperatorCounts(1_234_567, 7_654_321, 1_000, 10**12)},
        drops={"camera": (("", "past", 7),), "trajectory_metrics": (("ground_truth", "unmatched", 1_000),)},
        summaries={"trajectory_metrics": {"ate_rmse_m": 0.0123, "ate": "not computed: " + "too few poses " * 12}},
        transport={},
        files={"@recorder": {"path": "out/run.mcap", "messages": 1, "bytes": 5_000_000}},
        first=0,
        last=10**10,
        wall=5.0,
        interrupted=False,
        notes=(),
    )
    file = io.StringIO()

    print_report(Console(file=file, width=width), report, verbose=True)

    lines = file.getvalue().splitlines()
    assert max(map(len, lines)) <= width
    assert any(line.split() == ["ate", "rmse", "0.0123", "m"] for line in lines)
    assert any(line.split()[:4] == ["camera", "dropped:", "past", "7"] for line in lines)
    assert "dropped: unmatched" not in file.getvalue()
    assert "10.0 s of event time in 5.00 s, 2.00 × real time" in lines[0]
    assert "wrote   out/run.mcap (1 message, 5.0 MB)" in lines


def test_progress_without_a_start_shows_no_duration() -> None:
    console = Console(file=io.StringIO(), width=100)
    with shown(console, RunDisplay(console), quiet=False) as watch:
        assert watch is not None
        watch(Status("running", operators={"smooth": OperatorCounts(3)}))

    assert console.file.getvalue().split() == ["running", "3", "firings"]


@pytest.mark.parametrize("quiet", [True, False])
def test_notes_are_printed_as_they_come_each_once_and_not_those_of_the_end(quiet: bool) -> None:
    console = Console(file=io.StringIO(), width=100)
    status = Status("running")
    with shown(console, RunDisplay(console), quiet=quiet) as watch:
        watch(status)
        status.notes.append("source 'robot' has fallen behind the clock: reading it takes longer than real time")
        watch(status)
        at_once = console.file.getvalue()
        watch(status)
        status.phase = "closing"
        status.notes.append("source 'robot' was 15.0 s behind the clock at the end, 16.0 s at most")
        watch(status)

    note = "note: source 'robot' has fallen behind the clock: reading it takes longer than real time"
    assert note in at_once.splitlines()
    whole = console.file.getvalue()
    assert whole.count("behind the clock") == 1


def text_of(console: Console) -> list[str]:
    """The lines that were printed."""
    return [line.rstrip() for line in console.file.getvalue().splitlines()]


def lossy_report() -> RunReport:
    """A run in which messages were dropped, waits were given up, and messages came late."""
    return RunReport(
        graph="robot",
        streams={},
        operators={
            "camera": OperatorCounts(500, 500, cpu_ns=10**9, wall_ns=2 * 10**9),
            "fusion": OperatorCounts(100, 100, dropped=14, cpu_ns=5 * 10**8, wall_ns=30 * 10**9),
        },
        drops={"fusion": (("image", "late", 2), ("image", "unmatched", 12))},
        summaries={},
        transport={},
        files={},
        first=0,
        last=10**10,
        wall=10.0,
        interrupted=False,
        notes=(),
        waits={"fusion": (("image", "late", 5), ("image", "timeout", 3))},
    )


@pytest.mark.parametrize("width", [80, 120])
def test_report_distinguishes_drops_timeouts_and_late_messages(width: int) -> None:
    console = Console(file=io.StringIO(), width=width)

    print_report(console, lossy_report(), verbose=True)

    lines = text_of(console)
    assert max(map(len, lines)) <= width
    told = [text.split() for text in lines]
    headings = "operator firings out Hz dropped timeouts late CPU s ms each wall s"
    assert headings.split() in told
    assert ["fusion", "100", "100", "9.9", "2", "3", "5", "0.50", "5.00", "30.00"] in told
    text = "\n".join(" ".join(words) for words in told)
    assert "fusion.image dropped: late 2 came after its firing" in text
    assert "fusion.image unmatched 12 no partner of its stamp" in text
    assert "fusion.image late 3 after its firing, for later ones" in text  # of 5, 2 were dropped
    assert "fusion.image timeout 3 wait given up, nothing dropped" in text


def test_a_report_without_losses_has_no_columns_for_them() -> None:
    console = Console(file=io.StringIO(), width=80)
    report = lossy_report()
    counts = {name: replace(c, dropped=0) for name, c in report.operators.items()}

    print_report(console, replace(report, operators=counts, drops={}, waits={}), verbose=True)

    told = console.file.getvalue()
    assert "dropped" not in told
    assert "timeout" not in told


def printed(report: RunReport, width: int = 200) -> list[str]:
    console = Console(file=io.StringIO(), width=width)
    print_report(console, report, verbose=False)
    return text_of(console)


def test_summary_lists_rates_losses_and_files_first() -> None:
    wrote = {"path": "out/a_000.mcap", "parts": ["out/a_000.mcap", "out/a_001.mcap"], "messages": 9, "bytes": 5_000_000}
    report = replace(lossy_report(), files={"@recorder": wrote}, sources=("camera",))

    lines = printed(report)

    assert lines[1:] == [
        "rates   camera 49.9 Hz, fusion 9.9 Hz",
        "lost    2 messages dropped: 2 fusion.image (came after its firing)",
        "wrote   out/a_000.mcap to a_001.mcap (2 files, 9 messages, 5.0 MB)",
    ]
    scores = {"metrics": {"matched": 120, "path_m": 2.4, "ate_rmse_m": 0.001, "ate_max_m": 0.5}}
    assert "scores  metrics: ate rmse 0.001 m" in printed(replace(report, summaries=scores))


def test_scores_of_many_operators_are_one_of_each_and_no_lists() -> None:
    summary = {"class_iou": "box 0.378, mug 0.394", "iou": 0.5, "accuracy": 0.9}
    report = replace(lossy_report(), summaries={f"score_{i}": summary for i in range(4)})

    assert printed(report)[1] == "scores  score_0: iou 0.5; score_1: iou 0.5; score_2: iou 0.5; score_3: iou 0.5"


def test_runtime_processes_are_printed_by_their_role() -> None:
    operators = {"@log": OperatorCounts(100, 100, 0, 0, 0)} | dict(lossy_report().operators)
    report = replace(lossy_report(), operators=operators)
    status = Status(waiting=("@log", "odometry", "@recorder"))

    assert printed(report)[1].startswith("rates   recording 9.9 Hz, ")
    assert waiting_for(status) == "waiting for recording, odometry, recorder"


def lacking(messages: int, firings: int, *spans: list[int | None]) -> dict[str, Any]:
    """The files of a recorder whose disk was full."""
    lost = {"messages": messages, "firings": firings, "spans": spans, "reasons": ["a.mcap: no space"], "streams": {}}
    return {"@recorder": {"path": "a.mcap", "messages": 9, "bytes": 5_000_000, "lost": lost}}


@pytest.mark.parametrize(
    ("changed", "line"),
    [
        ({"summaries": {"check": {"n": 9, "finding": "displaced by 2 cm"}}}, "found   check: displaced by 2 cm"),
        ({"drops": {"fusion": (("image", "unmatched", 12),)}}, "lost    nothing"),  # a miss is no loss
        (
            {"drops": {}, "files": lacking(7, 3, [2 * 10**9, None])},
            "lost    7 messages and 3 calls not recorded, from 2.000000000s to the end (a.mcap: no space)",
        ),
        ({"drops": {}, "files": lacking(0, 0)}, "lost    the end of a file (a.mcap: no space)"),
        ({"notes": ("late", "late")}, "note: late"),
    ],
)
def test_summary_has_findings_losses_and_notes_once(changed: dict[str, Any], line: str) -> None:
    assert printed(replace(lossy_report(), **changed)).count(line) == 1


def test_failed_flight_recordings_are_listed_among_the_losses() -> None:
    """Not among what it has kept, though its name stands there."""
    kept = {"path": "a.mcap", "reasons": [{"what": "asked for"}], "bytes": 5_000_000}
    failed = {"path": "b.mcap", "reasons": [{"what": "asked for"}], "bytes": 0, "error": "no space"}
    facts = {"path": "flight", "kept": [kept, failed], "not_kept": 2}

    lines = printed(replace(lossy_report(), drops={}, files={"@recorder": facts}))

    assert "lost    what b.mcap was to keep (asked for): no space" in lines
    assert "kept    a.mcap (asked for, 5.0 MB)" in lines
    assert "        2 more triggers came, of which nothing is kept: raise files:" in lines
    assert not any(line.startswith("kept    b.mcap") for line in lines)
    assert is_lacking(facts)
    assert not is_lacking({**facts, "kept": [kept]})


def test_the_json_report_has_cpu_and_wall_time() -> None:
    fusion = report_json(lossy_report())["operators"]["fusion"]

    assert (fusion["cpu_ms"], fusion["wall_ms"], fusion["dropped"]) == (500.0, 30_000.0, 2)


def test_a_missing_file_of_an_operator_is_one_message_without_a_traceback(monkeypatch, capsys) -> None:
    trace = "Traceback (most recent call last):\n  File 'x.py', line 1\nFileNotFoundError: Detector: no file 'm.onnx'\n"
    failure = RunFailed("operator 'd' failed in setup(): FileNotFoundError: Detector: no file 'm.onnx'", trace, "d")

    for asked in ("0", "1"):
        monkeypatch.setenv("DATAFLOW_TRACEBACK", asked)
        with pytest.raises(typer.Exit), friendly_errors():
            raise failure
        assert ("Traceback" in capsys.readouterr().err) == (asked == "1")


@pytest.mark.parametrize(
    ("last", "file"),
    [
        ("dataflow.ports.SourceError: pose.txt: not a rigid motion:\n[[1 0]\n [0 1]]", True),  # text of several lines
        ("PermissionError: [Errno 13] Permission denied: 'a.png'", True),
        ("ValueError: SourceError: no", False),
        ("KeyError: 'a'", False),
    ],
)
def test_file_errors_are_recognised_by_class(last: str, file: bool) -> None:
    trace = f'Traceback (most recent call last):\n  File "x.py", line 1, in setup\n    read()\n    ^^^^^^\n{last}\n'

    assert about_a_file(trace) is file
    assert not about_a_file(last)


@pytest.mark.parametrize(
    ("error", "code", "told"),
    [
        (OperatorFailure("odometry", "setup()", KeyError("gain")), 2, "error: operator 'odometry' failed in setup(): "),
        (RunFailed("stopped before everything was drained", interrupted=True), 130, "stopped before everything was"),
    ],
)
def test_expected_errors_end_with_their_exit_code(capsys, error: Exception, code: int, told: str) -> None:
    with pytest.raises(typer.Exit) as ended, friendly_errors():
        raise error

    assert ended.value.exit_code == code
    assert capsys.readouterr().err.startswith(told)


def test_start_names_processes_it_waits_for() -> None:
    status = Status(waiting=("camera", "cloud", "detector", "odometry", "@recorder"))
    console = Console(file=io.StringIO(), width=100)
    with shown(console, RunDisplay(console), quiet=False) as watch:
        assert watch is not None
        watch(status)

    waiting = "starting waiting for camera, cloud, detector and 2 more"
    assert " ".join(console.file.getvalue().split()) == waiting


def test_a_line_break_in_a_name_makes_no_row() -> None:
    console = Console(file=io.StringIO(), width=120)
    made = table("stream", "messages")
    made.add_row(Text("imu\nforged/stream  1,000"), "3\n4")

    console.print(made)

    lines = console.file.getvalue().splitlines()
    assert [line for line in lines if "forged" in line] == [line for line in lines if "imu" in line]
    assert any("3\\n4" in line for line in lines)
