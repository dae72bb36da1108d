"""How what is written is named and compressed, alike in all commands."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

Recorded = tuple[Path, dict[str, Any]]


def compressions(path: Path) -> set[str]:
    """How the chunks of a file are compressed, as the mcap library reads it."""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert summary.chunk_indexes
    return {chunk.compression for chunk in summary.chunk_indexes}


@pytest.mark.long
@pytest.mark.parametrize(("word", "named"), [("zstd", "zstd"), ("lz4", "lz4"), ("none", "")])
def test_a_run_is_recorded_with_the_compression_that_is_asked_for(
    dataflow, small: Path, recorded: Recorded, tmp_path: Path, word: str, named: str
) -> None:
    path = tmp_path / "run.mcap"

    dataflow("run", small, "--record", path, "--compression", word, "--one-process", "--quiet")

    assert compressions(path) == {named}
    dataflow("diff", recorded[0], path)  # bit for bit


def test_a_replay_is_recorded_with_the_compression_that_is_asked_for(
    dataflow, recorded: Recorded, tmp_path: Path
) -> None:
    path = tmp_path / "again.mcap"

    dataflow("replay", recorded[0], "--record", path, "--compression", "lz4", "--one-process", "--quiet")

    assert compressions(path) == {"lz4"}
    dataflow("diff", recorded[0], path)


@pytest.mark.parametrize(
    ("command", "words"),
    [("cut", ["--to", "1"]), ("filter", ["--stream", "left/*"]), ("recover", []), ("split", ["--every", "10s"])],
)
def test_parts_are_compressed_as_is_asked_for(
    dataflow, recorded: Recorded, tmp_path: Path, command: str, words: list[str]
) -> None:
    out = tmp_path / ("parts" if command == "split" else "part.mcap")

    dataflow(command, recorded[0], *words, "-o", out, "--compression", "lz4")

    files = list(out.iterdir()) if out.is_dir() else [out]
    assert files
    assert all(compressions(file) == {"lz4"} for file in files)


def test_a_merge_is_compressed_as_is_asked_for(dataflow, recorded: Recorded, tmp_path: Path) -> None:
    dataflow("split", recorded[0], "--every", "0.1", "-o", tmp_path / "parts")
    parts = sorted((tmp_path / "parts").iterdir())
    assert len(parts) > 1

    dataflow("merge", *parts, "-o", tmp_path / "whole.mcap", "--compression", "none")

    assert compressions(tmp_path / "whole.mcap") == {""}
    dataflow("diff", recorded[0], tmp_path / "whole.mcap")


def test_a_merge_passes_over_parts_that_are_empty(dataflow, recorded: Recorded, tmp_path: Path) -> None:
    """As a recorder leaves them that is killed once it has created the next file."""
    for name in ("a.mcap", "b.mcap"):
        (tmp_path / name).touch()
    whole = tmp_path / "whole.mcap"

    told = dataflow("merge", recorded[0], tmp_path / "a.mcap", "-o", whole, "--json").stdout

    assert f"{tmp_path / 'a.mcap'} holds nothing: its writer died as it began the file" in json.loads(told)["notes"]
    dataflow("diff", recorded[0], whole)
    nothing = dataflow("merge", tmp_path / "a.mcap", tmp_path / "b.mcap", "-o", tmp_path / "none.mcap", code=2)
    assert "nothing is in any of these files" in nothing.stderr


def test_every_command_names_its_output_by_out(dataflow, recorded: Recorded, tmp_path: Path) -> None:
    dataflow("convert", recorded[0], "--to", "csv", "--stream", "left/fast", "-o", tmp_path / "csv")
    dataflow("convert", recorded[0], tmp_path / "former", "--to", "csv", "--stream", "left/fast")
    dataflow("view", recorded[0], "--out", tmp_path / "a.rrd")
    dataflow("view", recorded[0], "--to", tmp_path / "former.rrd")
    dataflow("new", "graph", "mine", "-o", tmp_path / "graphs")

    tables = [[f.read_bytes() for f in sorted((tmp_path / name).rglob("*.csv"))] for name in ("csv", "former")]
    assert tables[0]
    assert tables[0] == tables[1]
    assert all((tmp_path / name).stat().st_size for name in ("a.rrd", "former.rrd", "graphs/mine.yaml"))


def test_output_is_given_exactly_once(dataflow, recorded: Recorded, tmp_path: Path) -> None:
    twice = dataflow("convert", recorded[0], tmp_path / "a", "--to", "csv", "-o", tmp_path / "b", code=2).stderr
    never = dataflow("convert", recorded[0], "--to", "csv", code=2).stderr

    assert "both name what to write" in " ".join(twice.split())
    assert "no output given: name a file or folder" in never
    assert not list(tmp_path.iterdir())
