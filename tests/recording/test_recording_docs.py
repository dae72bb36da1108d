"""The examples of docs/recordings.md run, in order, and print what the recording holds."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from dataflow.recording.codecs import codec_for
from dataflow.recording.foxglove import FOXGLOVE_SCHEMAS


def test_the_documented_snippets_run(
    repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (repository / "docs" / "recordings.md").read_text()
    snippets = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    assert len(snippets) == 2
    monkeypatch.chdir(tmp_path)
    for snippet in snippets:
        exec(compile(snippet, "docs/recordings.md", "exec"), {})
    lines = capsys.readouterr().out.splitlines()
    assert lines[:2] == [
        "robot1/imu/data 1700000000005000000 [0.  0.  0.1]",
        "robot1/imu/data 1700000000010000000 [0.  0.  0.2]",
    ]
    assert lines[2:] == [
        f"robot1/imu/data {1_700_000_000_000_000_000 + i * 5_000_000} [0.0, 0.0, 9.81]" for i in range(3)
    ]


def test_the_table_of_well_known_types_is_complete(repository: Path) -> None:
    text = (repository / "docs" / "recordings.md").read_text()
    listed = dict(re.findall(r"^\| `(\w+)` \| `(foxglove\.\w+)` \|", text, re.MULTILINE))
    assert listed == {cls.SCHEMA: schema.name for cls, schema in FOXGLOVE_SCHEMAS.items()}
    never = set(re.findall(r"^\| `(\w+)` .*\| never \|$", text, re.MULTILINE))
    assert never == {cls.SCHEMA for cls in FOXGLOVE_SCHEMAS if codec_for(cls).companion_schema() is None}
