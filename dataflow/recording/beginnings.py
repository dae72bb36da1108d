"""Beginnings of files: what a file is that is no MCAP."""

from __future__ import annotations

from pathlib import Path

ROS1_MAGIC = b"#ROSBAG V"
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
SQLITE_MAGIC = b"SQLite format 3\x00"
RERUN_MAGICS = (b"RRF2", b"RRIO")
BAGS = (
    (ROS1_MAGIC, "a ROS 1 bag"),
    (SQLITE_MAGIC, "a SQLite database, as ROS 2 bags are"),
    (ZSTD_MAGIC, "a zstd file"),
    *((magic, "a Rerun file") for magic in RERUN_MAGICS),
)
ARCHIVES = ((b"\x1f\x8b", "gzip"), (b"PK\3\4", "zip"), (b"BZh", "bzip2"), (b"\xfd7zXZ", "xz"))
OTHERS = (
    (b"\x89mcap", "it begins as an MCAP file does whose line ends a transfer as text has changed; fetch it as binary"),
    (b"version https:/", "it is a pointer of Git LFS, which `git lfs pull` replaces by the file"),
    (b"<!doctype html", "it is a page of the web, as servers send it in place of a file"),
    (b"<html", "it is a page of the web, as servers send it in place of a file"),
)
"""Beginnings of what is found in place of a bag, in small letters, and what it is."""
HEAD_BYTES = 16


def head_of(path: Path) -> bytes:
    """The first `HEAD_BYTES` of a file."""
    with path.open("rb") as file:
        return file.read(HEAD_BYTES)


def beginning(path: Path, head: bytes) -> str:
    """Returns what a file is instead of an MCAP, by its first `HEAD_BYTES`."""
    if not head:
        return "it is empty"
    for magic, name in BAGS:
        if head.startswith(magic):
            return f"it is {name}; `dataflow convert {path} OUT.mcap --to mcap` makes one of it"
    for magic, name in ARCHIVES:
        if head.startswith(magic):
            return f"it is a {name} file, to be unpacked first"
    found = next((what for start, what in OTHERS if head.lower().startswith(start)), None)
    return found or f"it begins with {head[:8].hex(' ')}"
