"""The tables of docs/recordings.md are those of the code."""

from __future__ import annotations

import re
from pathlib import Path

from dataflow.recording.streams.codecs import codec_for
from dataflow.recording.streams.foxglove import FOXGLOVE_SCHEMAS


def test_the_table_of_well_known_types_is_complete(repository: Path) -> None:
    text = (repository / "docs" / "recordings.md").read_text()
    listed = dict(re.findall(r"^\| `(\w+)` \| `(foxglove\.\w+)` \|", text, re.MULTILINE))
    assert listed == {cls.SCHEMA: schema.name for cls, schema in FOXGLOVE_SCHEMAS.items()}
    never = set(re.findall(r"^\| `(\w+)` .*\| never \|$", text, re.MULTILINE))
    assert never == {cls.SCHEMA for cls in FOXGLOVE_SCHEMAS if codec_for(cls).companion_schema is None}
