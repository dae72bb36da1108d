"""Cut, filter, split and recover on the command line: files, words, exit codes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from dataflow.recording import Recording

Recorded = tuple[Path, dict[str, Any]]


@pytest.mark.long
def test_cut_is_written_and_reports_its_content(dataflow, recorded: Recorded, tmp_path: Path) -> None:
    path = tmp_path / "part.mcap"

    told = json.loads(dataflow("cut", recorded[0], "--from", "50ms", "--duration", "0.1", "-o", path, "--json").stdout)

    assert told["path"] == str(path)
    assert told["unknown"] == ["gripper", "smooth", "sum"]
    assert told["span"][1] - told["span"][0] <= 100_000_000
    words = dataflow("cut", recorded[0], "--from", "0.05", "-o", tmp_path / "b.mcap")
    assert "no recorded state at or before the cut: gripper, smooth, sum" in " ".join(words.stderr.split())
    assert "is a part of run.mcap" in " ".join(dataflow("verify", path, code=1).stdout.split())
    dataflow("replay", path, "--one-process", "--quiet")


@pytest.mark.long
def test_filter_keeps_chosen_streams(dataflow, recorded: Recorded, tmp_path: Path) -> None:
    path = tmp_path / "part.mcap"

    dataflow("filter", recorded[0], "--stream", "left/*", "-o", path)

    with Recording(path) as opened:
        assert {s for s, i in opened.streams.items() if i.count} == {
            "test/left/constant",
            "test/left/fast",
            "test/left/slow",
        }
    assert "identical" in dataflow("verify", path).stdout
    dataflow("filter", recorded[0], "--without", "left/fast", "-o", tmp_path / "b.mcap")
    told = json.loads(dataflow("verify", tmp_path / "b.mcap", "--json", code=1).stdout)
    assert {o["operator"]: o["verdict"] for o in told["operators"]}["sum"] == "identical"
    assert {o["operator"]: o["missing"] for o in told["operators"]}["smooth"] == "test/left/fast"
    words = ("--stream", "left/*", "--without", "**", "-o", tmp_path / "c.mcap")
    assert "no stream is left" in dataflow("filter", recorded[0], *words, code=2).stderr


def test_a_split_is_as_long_and_as_large_as_asked(dataflow, recorded: Recorded, tmp_path: Path) -> None:
    told = json.loads(dataflow("split", recorded[0], "--every", "100ms", "-o", tmp_path / "t", "--json").stdout)
    assert [Path(one["path"]).name for one in told] == [f"run_{k:03}.mcap" for k in range(len(told))]
    by_size = json.loads(dataflow("split", recorded[0], "--size", "4kB", "-o", tmp_path / "s", "--json").stdout)
    assert len(by_size) > 1
    assert "say how" in dataflow("split", recorded[0], code=2).stderr
    assert "--size 5XB" in dataflow("split", recorded[0], "--size", "5XB", code=2).stderr


def test_recover_saves_a_torn_file_and_reports_it(dataflow, recorded: Recorded, tmp_path: Path) -> None:
    torn, saved = tmp_path / "torn.mcap", tmp_path / "saved.mcap"
    data = recorded[0].read_bytes()
    torn.write_bytes(data[: len(data) * 2 // 3])

    told = json.loads(dataflow("recover", torn, "-o", saved, "--json", code=1).stdout)

    assert told["torn"]
    with Recording(torn) as broken, Recording(saved) as opened:
        assert not opened.torn
        assert [(r.stream, r.sequence, r.data) for r in opened.raw()] == [
            (r.stream, r.sequence, r.data) for r in broken.raw()
        ]
    assert "no file" in dataflow("recover", tmp_path / "none.mcap", "-o", saved, code=2).stderr


def test_bag_that_is_no_mcap_is_refused_with_the_conversion(dataflow, tmp_path: Path) -> None:
    bag = tmp_path / "drive.bag"
    bag.write_bytes(b"#ROSBAG V2.0\n")

    assert "dataflow convert" in dataflow("cut", bag, "--to", "1", "-o", tmp_path / "a.mcap", code=2).stderr


def test_a_folder_of_parts_is_read_as_one_recording_and_edited_after_a_merge(
    dataflow, recorded: Recorded, tmp_path: Path
) -> None:
    folder = tmp_path / "parts"
    dataflow("split", recorded[0], "--every", "100ms", "-o", folder)

    assert "the same: 5 streams" in dataflow("diff", folder, recorded[0]).stdout
    for words in (["latency"], ["logs"], ["spans", "--to", tmp_path / "s.jsonl"], ["lint", "--quick"]):
        dataflow(words[0], folder, *words[1:])
    told = dataflow("cut", folder, "--duration", "1s", "-o", tmp_path / "c.mcap", code=2).stderr
    assert "dataflow merge" in told
    assert "parts/*.mcap" in "".join(told.split())
