"""Folders of rosbag2: their metadata.yaml, read as far as it makes sense, and the files that are there."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

METADATA = "metadata.yaml"
COMPRESSED = (".zstd", ".zst")
"""Ends of the names of compressed files: as rosbag2 and as zstd's own program give them."""


@dataclass(slots=True)
class Folder:
    """The content of a metadata.yaml. `promised`: messages by topic; `notes`: what does not fit the folder."""

    promised: dict[str, int] = field(default_factory=dict)
    message_compression: bool = False
    named: tuple[str, ...] = ()
    notes: list[str] = field(default_factory=list)


def read_folder(path: Path) -> Folder:
    """Reads metadata.yaml. One that is missing promises nothing, one that cannot be read is noted."""
    found = Folder()
    file = path / METADATA
    if not file.is_file():
        return found
    try:
        told = YAML(typ="safe").load(file.read_text(encoding="utf-8"))
        facts = told["rosbag2_bagfile_information"] if isinstance(told, Mapping) else None
    except (YAMLError, UnicodeDecodeError, KeyError) as error:
        found.notes.append(f"{METADATA} cannot be read ({type(error).__name__}): the files count")
        return found
    if not isinstance(facts, Mapping):
        found.notes.append(f"{METADATA} does not describe a bag: the files count")
        return found
    for row in _rows(facts.get("topics_with_message_count")):
        topic, held = row.get("topic_metadata"), row.get("message_count")
        if isinstance(topic, Mapping) and isinstance(topic.get("name"), str) and isinstance(held, int):
            found.promised[topic["name"]] = found.promised.get(topic["name"], 0) + held
    mode, kind = str(facts.get("compression_mode") or ""), str(facts.get("compression_format") or "")
    found.message_compression = mode.lower() == "message" and kind == "zstd"
    if mode.lower() in ("message", "file") and kind != "zstd":
        found.notes.append(f"{METADATA} names the compression {kind!r}; zstd is known")
    paths = facts.get("relative_file_paths")
    found.named = tuple(dict.fromkeys(Path(str(p)).name for p in paths)) if isinstance(paths, list) else ()
    return found


def _rows(value: Any) -> list[Mapping[str, Any]]:
    return [row for row in value if isinstance(row, Mapping)] if isinstance(value, list) else []


def absent_parts(files: Sequence[Path]) -> list[str]:
    """Notes the gaps in the numbers at the end of the names of files, parts of one recording in their order."""
    numbers = [int(found[1]) for file in files if (found := re.search(r"_(\d+)\.[^_]*$", file.name))]
    absent = sorted({*range(min(numbers, default=0), max(numbers, default=0))} - {*numbers})
    if len(numbers) != len(files) or len(absent) >= len(numbers):
        return []
    return [f"the files are numbered, and {', '.join(map(str, absent))} is not there"] if absent else []


def natural(path: Path) -> list[tuple[int, str]]:
    """Sorts bag_2 before bag_10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", path.name)]


def bag_files(path: Path, suffix: str, folder: Folder) -> list[Path]:
    """The files of a suffix, compressed ones too, in the order of the numbers in their names.

    Files that metadata.yaml names and that are not there are noted; where some of those named are there, others are
    left out with a note.
    """
    found = sorted((file for end in ("", *COMPRESSED) for file in path.glob(f"*{suffix}{end}")), key=natural)
    plain = {file.name for file in found if file.suffix not in COMPRESSED}
    found = [file for file in found if file.suffix not in COMPRESSED or _uncompressed(file.name) not in plain]
    there = {file.name: file for file in found}
    named = [name for name in folder.named if _uncompressed(name).endswith(suffix)]
    present = [there[n] for n in (_held(name, there) for name in named) if n is not None]
    missing = [name for name in named if _held(name, there) is None]
    if found and missing:
        folder.notes.append(f"{METADATA} names {', '.join(missing)}, which the folder lacks")
    if present and not missing:
        others = [file.name for file in found if file not in present]
        if others:
            folder.notes.append(f"left out, since {METADATA} does not name them: {', '.join(others)}")
        return present
    folder.notes += [] if missing else absent_parts(found)
    return found


def _held(name: str, there: Mapping[str, Path]) -> str | None:
    plain = _uncompressed(name)
    options = (name, *(f"{plain}{end}" for end in COMPRESSED), plain)
    return next((option for option in options if option in there), None)


def _uncompressed(name: str) -> str:
    return Path(name).stem if Path(name).suffix in COMPRESSED else name
