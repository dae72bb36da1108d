"""Opens bags of any format, by what the file or folder holds."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from dataflow.interop.bag import Bag, BagError, shortfalls, surpluses
from dataflow.interop.joined_bag import JoinedBag
from dataflow.interop.mcap_bag import McapBag
from dataflow.interop.unpacking import unpack, unpacked_head
from dataflow.recording.beginnings import RERUN_MAGICS, ROS1_MAGIC, SQLITE_MAGIC, ZSTD_MAGIC, beginning, head_of
from dataflow.recording.errors import RecordingError
from dataflow.recording.layout import PROGRAM
from dataflow.recording.mcap.ending import MAGIC
from dataflow.recording.mcap.index import McapFile
from dataflow.recording.notices import notice
from dataflow.recording.streams.part_folder import parts_in

LIBRARY_BYTES = 128
"""Of an MCAP, at its beginning, among which its header names the library."""
_PART = re.compile(r"(.*?)_?(?:\d{4}(?:-\d\d){5})?_\d+\.bag")
"""The name that `rosbag record --split` gives to a part: prefix, date and number."""
_DIGITS = re.compile(r"\d+|\.zstd?$")
"""Parts of the names of files by which those of one recording differ."""
DATASETS = "folders of datasets (TUM, EuRoC, KITTI) are read by sources of a graph: `dataflow operators` lists them"
_SUFFIXES = ((MAGIC, ".mcap"), (SQLITE_MAGIC, ".db3"), (ROS1_MAGIC, ".bag"))
BAG_SUFFIXES = (".bag", ".mcap", ".db3")


def open_bag(path: Path, *, strict: bool = False) -> Bag:
    """Opens a bag, and announces what is unusual about it (`notices`). Raises as `bag_at`."""
    bag = bag_at(path, strict=strict)
    bag.notes = (*bag.notes, *_timeless(bag))
    notice(path, [*bag.notes, *shortfalls(bag)])
    return bag


def _timeless(bag: Bag) -> list[str]:
    """A note where all messages have one log time, so that log times show nothing."""
    held = [topic for topic in bag.topics.values() if topic.count and topic.first is not None]
    times = {time for topic in held for time in (topic.first, topic.last)}
    if sum(topic.count for topic in held) < 2 or len(times) > 1:
        return []
    return [f"all messages have the log time {times.pop()}: those without a time in their header have none"]


def bag_at(path: Path, *, strict: bool = False) -> Bag:
    """Opens a ROS 1 bag, a ROS 2 bag (folder, .db3 or .mcap), any other MCAP file, or the video of a Rerun file.

    `strict`: damage is an error; else what it took is counted (`Bag.lost`).
    Raises `BagError` where there is none; the message names what is there instead. Raises `RecordingError` for a
    damaged MCAP file.
    """
    if path.is_dir():
        return _open_folder(path, strict)
    head = head_of(path)
    if head.startswith(MAGIC):
        return McapBag(path, [path], strict=strict)
    if head.startswith(ROS1_MAGIC):
        return _ros_bag(path, [_with_suffix(path, ".bag")], strict)
    if head.startswith(SQLITE_MAGIC):
        return _of_files(path, ".db3", [path], strict)
    if head.startswith(RERUN_MAGICS):
        from dataflow.interop.rerun_file import RerunFile  # the viewer takes long to import

        return RerunFile(path)
    if head.startswith(ZSTD_MAGIC):
        head = unpacked_head(path)
        suffix = next((end for magic, end in _SUFFIXES if head.startswith(magic)), None)
        if suffix is not None:
            return _of_files(path, suffix, [path], strict)
        raise BagError(f"{path} is a zstd file of something that is no bag: {beginning(path, head)}")
    raise BagError(
        f"{path} is not an MCAP file, nor another kind of bag: {beginning(path, head)}. Known are MCAP files, "
        "ROS 1 bags (.bag), ROS 2 bags (a folder with metadata.yaml, .db3 or .mcap) and Rerun files (.rrd)"
    )


def is_foreign(path: Path) -> bool:
    """Returns whether a file or folder is a recording of another program: anything but an MCAP that this one wrote."""
    if path.is_dir():
        parts = parts_in(path)
        return not parts or is_foreign(parts[0])
    with path.open("rb") as opened:
        head = opened.read(LIBRARY_BYTES)
    if not head.startswith(MAGIC):
        return True
    if PROGRAM.encode() in head:
        return False
    file = McapFile(path, lenient=True)
    try:
        return not file.own
    finally:
        file.close()


def is_ros_bag(path: Path) -> bool:
    """Returns whether a file is a ROS 1 bag or a database of a ROS 2 bag, whole or not."""
    return path.is_file() and head_of(path).startswith((ROS1_MAGIC, SQLITE_MAGIC))


def _ros_bag(path: Path, files: list[Path], strict: bool) -> JoinedBag[Any]:
    """Opens a ROS 1 bag; several files where their names say that they are parts of one (`rosbag record --split`)."""
    from dataflow.interop.ros_bags import RosBag  # rosbags takes long to import, and most files are no such bags

    if len({found[1] if (found := _PART.fullmatch(file.name)) else file.name for file in files}) > 1:
        raise BagError(f"{path} holds {len(files)} .bag files, which are separate recordings; name one")
    return RosBag(path, files, strict=strict)


def _with_suffix(path: Path, suffix: str) -> Path:
    if path.suffix != suffix:
        raise BagError(f"{path} holds what a {suffix} file does; rename it so that it ends in {suffix}")
    return path


def _open_folder(path: Path, strict: bool) -> Bag:
    from dataflow.interop.ros2_folder import METADATA, bag_files, read_folder  # reading YAML takes long to import

    folder = read_folder(path)
    files = {suffix: bag_files(path, suffix, folder) for suffix in BAG_SUFFIXES}
    kinds = [suffix for suffix in (".mcap", ".db3") if files[suffix]]
    if len(kinds) > 1:
        first, second = (", ".join(file.name for file in files[kind]) for kind in kinds)
        raise BagError(f"{path} holds bags of two kinds, {first} and {second}; name one of them")
    if kinds:
        if not folder.named and len({_DIGITS.sub("", file.name) for file in files[kinds[0]]}) > 1:
            named = ", ".join(file.name for file in files[kinds[0]][:4])
            raise BagError(f"{path} holds {len(files[kinds[0]])} files that are no parts of one ({named}): name one")
        bag = _of_files(path, kinds[0], files[kinds[0]], strict, compressed=folder.message_compression)
        bag.promised = {**bag.promised, **folder.promised}
        bag.notes = (*folder.notes, *bag.notes, *surpluses(bag))
        return bag
    if files[".bag"]:
        return _ros_bag(path, files[".bag"], strict)
    if folder.named:
        raise BagError(
            f"{path}: {METADATA} names {', '.join(folder.named)}, and the folder holds no .mcap or .db3 file"
        )
    inside = sorted(p.name for p in path.iterdir() if p.is_dir() and any(any(p.glob(f"*{s}")) for s in BAG_SUFFIXES))
    raise BagError(
        f"{path} is a folder without a bag: it holds no metadata.yaml, .mcap, .db3 or .bag file"
        + (f"; its folders {', '.join(inside)} do: name one" if inside else f"; {DATASETS}")
    )


def _of_files(path: Path, suffix: str, files: list[Path], strict: bool, *, compressed: bool = False) -> Bag:
    """Opens MCAP files, databases or a ROS 1 bag as one bag. Those compressed as files are unpacked for as long as it
    is open; of several, those that cannot be opened are left out."""
    from dataflow.interop.db3_bag import Db3Bag

    unpacked = unpack(files, strict=strict)

    def opened(some: list[Path]) -> JoinedBag[Any]:
        if suffix == ".bag":
            return _ros_bag(path, some, strict)
        return (McapBag if suffix == ".mcap" else Db3Bag)(path, some, compressed=compressed, strict=strict)

    try:
        try:
            bag, left_out = opened(unpacked.files), list[str]()
        except RecordingError:
            sound, left_out = ([], []) if strict else _sound(unpacked.files, opened)
            if not sound:
                raise
            bag = opened(sound)
    except BaseException:
        unpacked.close()
        raise
    bag.lost.parts += [*unpacked.damage, *left_out]
    bag.closing.callback(unpacked.close)
    bag.kind += ", zstd" if unpacked.copies is not None else ""
    return bag


def _sound(files: list[Path], opened: Callable[[list[Path]], JoinedBag[Any]]) -> tuple[list[Path], list[str]]:
    """Those of several files that can be opened, and why others are left out."""
    sound, broken = [], []
    for file in files:
        try:
            opened([file]).close()
            sound.append(file)
        except RecordingError as error:
            broken.append(f"{file.name} is left out: {error}")
    return sound, broken
