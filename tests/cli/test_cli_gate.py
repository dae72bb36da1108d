"""`dataflow verify` as a regression gate, and `replay --complete`: files, tables, exit codes."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from xml.etree import ElementTree

import pytest
from typer.testing import CliRunner

from dataflow.cli.main import app
from dataflow.recording import Recording, RecordingWriter
from dataflow.recording.layout import RESERVED_METADATA

NUDGED = '{use: "verified_operators:Nudged", inputs: {x: left/fast}}'
ADDED = '{use: "verified_operators:Chatty", inputs: {x: left/fast}}'
SMOOTH = '{use: "runtime_operators:Smooth", inputs: {x: left/fast}}'
ORIGINAL = """\
graph: gated
namespace: test
operators:
  left: {use: "runtime_operators:Counter", params: {count: 12}}
  one: SMOOTH
  two: {use: "runtime_operators:Broken", inputs: {x: one/mean}}
"""


def graph_of(folder: Path, name: str, one: str, two: str | None = None) -> Path:
    text = ORIGINAL.replace("SMOOTH", one)
    if two is not None:
        text = text.replace('"runtime_operators:Broken", inputs: {x: one/mean}', f'"{two}", inputs: {{x: one/mean}}')
    path = folder / name
    path.write_text(text)
    return path


@pytest.fixture(scope="module")
def folder(dataflow, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two recordings and a broken file, one of the recordings deeper down."""
    path = tmp_path_factory.mktemp("gate")
    made = path / "recordings"
    (made / "deep").mkdir(parents=True)
    graph_of(path, "same.yaml", SMOOTH)
    dataflow("run", path / "same.yaml", "--record", made / "first.mcap", "--one-process", "-q")
    shutil.copy(made / "first.mcap", made / "deep" / "second.mcap")
    return path


def gate(dataflow, folder: Path, *words: object, code: int):
    return dataflow("verify", folder / "recordings", "--jobs", "1", "-q", *words, code=code)


def test_a_folder_of_recordings_passes_with_a_row_each(dataflow, folder: Path) -> None:
    told = gate(dataflow, folder, code=0).stdout

    assert "2 of 2 recordings passed" in told
    for name in ("first.mcap", "deep/second.mcap"):
        assert any(line.split()[:2] == [name, "identical"] for line in told.splitlines())


@pytest.mark.long
def test_a_broken_file_ends_with_2_and_the_others_are_verified_all_the_same(
    dataflow, folder: Path, tmp_path: Path
) -> None:
    shutil.copytree(folder / "recordings", tmp_path / "recordings")
    (tmp_path / "recordings" / "broken.mcap").write_bytes(b"\x89MCAP0\r\nnothing of the kind")

    outcome = gate(dataflow, tmp_path, "--json", "--junit", tmp_path / "out" / "v.xml", code=2)

    result = json.loads(outcome.stdout)
    assert {r["recording"]: r["verdict"] for r in result["recordings"]} == {
        "broken.mcap": "could not run",
        "deep/second.mcap": "identical",
        "first.mcap": "identical",
    }
    assert result["passed"] is False
    root = ElementTree.parse(tmp_path / "out" / "v.xml").getroot()
    assert [s.get("errors") for s in root] == ["1", "0", "0"]
    error = root.find("testsuite[@name='broken.mcap']/testcase/error")
    assert error is not None
    assert "broken.mcap" in (error.get("message") or "")


@pytest.mark.long
def test_a_change_is_named_with_its_field_in_the_table_the_json_and_the_junit_file(
    dataflow, folder: Path, tmp_path: Path
) -> None:
    changed = graph_of(tmp_path, "changed.yaml", NUDGED)
    junit = tmp_path / "v.xml"

    told = gate(dataflow, folder, "--graph", changed, "--junit", junit, code=1).stdout

    assert "0 of 2 recordings passed (2 different)" in told
    assert "one: first difference in call" in told
    assert "mean.vectors[0, 2]: recorded" in told
    assert "machine, libraries, threads and devices are as when it was recorded" in told
    root = ElementTree.parse(junit).getroot()
    assert root.tag == "testsuites"
    for suite in root:
        assert [child.tag for child in suite] == ["properties", "testcase", "testcase", "system-out", "system-err"]
        needed = {"name", "package", "id", "timestamp", "hostname", "tests", "failures", "errors", "time"}
        assert needed <= set(suite.keys())
        cases = suite.findall("testcase")
        assert int(suite.get("tests", "")) == len(cases)
        assert int(suite.get("failures", "")) == len(suite.findall("testcase/failure"))
        assert all({"name", "classname", "time"} <= set(case.keys()) for case in cases)
        failure = suite.find("testcase[@name='one']/failure")
        assert failure is not None
        assert failure.get("type") == "culprit"
        assert "mean.vectors[0, 2]" in (failure.text or "")
    result = json.loads(gate(dataflow, folder, "--graph", changed, "--json", code=1).stdout)
    [one, *_] = result["recordings"][0]["operators"]
    [field] = one["comparison"]["first"][0]["fields"]
    assert (field["field"], field["index"]) == ("vectors", [0, 2])


@pytest.mark.long
def test_results_are_shown_also_when_their_file_cannot_be_written(dataflow, folder: Path) -> None:
    told = gate(dataflow, folder, "--junit", "/proc/v.xml", code=2)

    assert "/proc/v.xml" in told.stderr
    assert "2 of 2 recordings passed" in told.stdout


@pytest.mark.long
def test_an_accepted_change_passes_until_something_else_changes(dataflow, folder: Path, tmp_path: Path) -> None:
    baseline = tmp_path / "accepted.json"
    changed = graph_of(tmp_path, "changed.yaml", NUDGED)
    words = ["--graph", changed, "--baseline", baseline]
    shutil.copytree(folder / "recordings" / "deep", tmp_path / "recordings")

    gate(dataflow, tmp_path, *words, code=1)
    assert not baseline.exists()
    told = gate(dataflow, tmp_path, *words, "--accept", code=0)
    assert "second.mcap: one" in told.stderr
    assert "1 accepted" in gate(dataflow, tmp_path, *words, code=0).stdout
    further = graph_of(tmp_path, "further.yaml", NUDGED, two="verified_operators:Doubled")
    told = gate(dataflow, tmp_path, "--graph", further, "--baseline", baseline, code=1)
    rows = [line.split() for line in told.stdout.splitlines() if line.strip().startswith("second.mcap  ")]
    assert rows[0][1:2] + rows[0][-1:] == ["different", "two"]
    assert (
        "as recorded, but the baseline accepts another"
        in gate(dataflow, tmp_path, "--baseline", baseline, code=1).stdout
    )
    assert "second.mcap: one" in gate(dataflow, tmp_path, "--baseline", baseline, "--accept", code=0).stderr
    assert json.loads(baseline.read_text())["accepted"] == {}


def without_message(path: Path, stream: str, number: int, target: Path) -> None:
    """A copy of a recording in which one message of a stream is missing."""
    with Recording(path) as recording:
        metadata = {name: dict(v) for name, v in recording.metadata.items() if name not in RESERVED_METADATA}
        with RecordingWriter(target, metadata=metadata, namespace="test") as writer:
            for name, info in recording.streams.items():
                extra = {key: info.metadata[key] for key in ("operator", "port") if key in info.metadata}
                assert info.message_type is not None
                writer.add_stream(name, info.message_type, static=info.static, extra=extra)
            for operator, payload in recording.firings():
                writer.write_firings(operator, 0, payload)
            for found in recording.messages():
                if (found.stream, found.seq) != (stream, number):
                    writer.write(found.stream, found.message, seq=found.seq, incarnation=found.incarnation)


@pytest.mark.long
@pytest.mark.parametrize("one", [SMOOTH, NUDGED])
def test_unrepeatable_operator_is_not_accepted_and_ends_with_1(
    dataflow, folder: Path, tmp_path: Path, one: str
) -> None:
    torn, baseline = tmp_path / "torn.mcap", tmp_path / "accepted.json"
    without_message(folder / "recordings" / "first.mcap", "test/left/fast", 9, torn)
    words = ("verify", torn, "--graph", graph_of(tmp_path, "g.yaml", one), "--baseline", baseline, "-q")

    told = dataflow(*words, "--accept", code=1)

    assert "not accepted: torn.mcap: one" in told.stderr
    assert "one" not in json.loads(baseline.read_text())["accepted"].get("torn.mcap", {})
    dataflow(*words, "--only", "one", code=1)


@pytest.mark.long
def test_a_tolerance_passes_with_its_own_word_and_not_as_identical(dataflow, folder: Path, tmp_path: Path) -> None:
    changed = graph_of(tmp_path, "changed.yaml", NUDGED)
    one = folder / "recordings" / "first.mcap"

    words = ("verify", one, "--graph", changed, "--jobs", "1", "-q", "--tolerance")

    told = dataflow(*words, "1e-5")

    assert "within tolerance of 1e-05, not identical" in told.stdout
    assert not any(line.startswith("identical") for line in told.stdout.splitlines())
    assert re.search(r"× real time \([\d.]+ s in all\)", " ".join(told.stdout.split()))
    value = json.loads(dataflow(*words, "1e-5", "--json").stdout)
    assert (value["identical"], value["within_tolerance"], value["verdict"]) == (False, True, "within tolerance")
    dataflow(*words, "1e-9", code=1)


def test_an_operator_that_cannot_run_is_2_and_not_a_difference(dataflow, folder: Path, tmp_path: Path) -> None:
    broken = graph_of(tmp_path, "broken.yaml", '{use: "verified_operators:Unable", inputs: {x: left/fast}}')

    words = ["verify", folder / "recordings" / "first.mcap", "--graph", broken, "--jobs", "1", "-q"]
    told = CliRunner().invoke(app, [str(word) for word in words])

    assert told.exit_code == 2
    assert "operator 'one' failed in setup(): FileNotFoundError: no weights" in told.stderr
    assert "verified_operators.py" in told.stderr  # the operator's own traceback


@pytest.mark.long
def test_recorded_operators_that_the_graph_does_not_have_are_named(dataflow, folder: Path, tmp_path: Path) -> None:
    fewer = graph_of(tmp_path, "fewer.yaml", SMOOTH)
    fewer.write_text("".join(line for line in fewer.read_text().splitlines(True) if "two" not in line))

    told = gate(dataflow, folder, "--graph", fewer, "--json", code=0)

    for name in ("first.mcap", "deep/second.mcap"):
        assert f"note: {name}: recorded operators that the graph does not have: two" in told.stderr
    assert [r["not_in_graph"] for r in json.loads(told.stdout)["recordings"]] == [["two"], ["two"]]
    assert json.loads(gate(dataflow, folder, "--json", code=0).stdout)["recordings"][0]["not_in_graph"] == []


@pytest.mark.parametrize("words", [[], pytest.param(["--start", "0.05"], marks=pytest.mark.long)])
def test_a_recording_of_sources_alone_holds_nothing_to_verify(
    dataflow, folder: Path, tmp_path: Path, words: list[str]
) -> None:
    alone = graph_of(tmp_path, "alone.yaml", SMOOTH)
    alone.write_text("".join(line for line in alone.read_text().splitlines(True) if "one" not in line))
    dataflow("run", alone, "--record", tmp_path / "alone.mcap", "--one-process", "-q")

    told = dataflow("verify", tmp_path / "alone.mcap", "-q", *words, code=2).stderr

    assert "graph 'gated' holds nothing to verify: all its operators (left) are sources or external" in told


@pytest.mark.long
def test_a_thin_recording_is_completed_and_is_then_verified(dataflow, folder: Path, tmp_path: Path) -> None:
    same = folder / "same.yaml"
    thin_graph = tmp_path / "thin.yaml"
    thin_graph.write_text(same.read_text() + 'record: {topics: ["left/**"]}\n')
    thin, full = tmp_path / "thin.mcap", tmp_path / "full.mcap"
    dataflow("run", thin_graph, "--record", thin, "--one-process", "-q")

    told = dataflow("replay", thin, "--complete", full, "-q").stdout

    assert "computed again: test/one/mean, test/two/y" in told
    assert "identical" in dataflow("verify", full, "--jobs", "1", "-q").stdout
    assert "the same" in dataflow("diff", folder / "recordings" / "first.mcap", full).stdout
    assert "replace it with --overwrite" in dataflow("replay", thin, "--complete", full, code=2).stderr
    assert json.loads(dataflow("replay", thin, "--complete", full, "--overwrite", "--json", "-q").stdout)["whole"]
    assert "is the recording" in dataflow("replay", thin, "--complete", thin, "--overwrite", code=2).stderr
    assert (
        "--complete repeats a run as it was" in dataflow("replay", thin, "--complete", full, "--rate", 1, code=2).stderr
    )


def test_differing_completion_writes_nothing_and_names_operator(dataflow, folder: Path, tmp_path: Path) -> None:
    changed = graph_of(tmp_path, "changed.yaml", NUDGED)
    out = tmp_path / "out.mcap"

    told = dataflow(
        "replay", folder / "recordings" / "first.mcap", "--graph", changed, "--complete", out, "-q", code=1
    ).stdout

    assert "nothing written; look at one" in told
    assert "one: first difference in call" in told
    assert not out.exists()
