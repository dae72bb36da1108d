"""Opens bags of any format, by what the file or folder holds."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from dataflow.interop.bag import Bag, BagError, shortfalls, surpluses
from dataflow.interop.mcap_bag import McapBag
from dataflow.interop.unpacking import Unpacked, unpack
from dataflow.recording.errors import RecordingError
from dataflow.recording.layout import RECORDING
from dataflow.recording.mcap.ending import MAGIC
from dataflow.recording.mcap.index import McapFile
from dataflow.recording.notices import notice
from dataflow.recording.streams.part_folder import parts_in

ROS1_MAGIC = b"#ROSBAG V"
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
SQLITE_MAGIC = b"SQLite format 3\x00"
RERUN_MAGICS = (b"RRF2", b"RRIO")
WRITER = b"robot-dataflow/"
"""Our library in the header of an MCAP; what others made of one of our files may name theirs."""
HEAD_BYTES = 128
_PART = re.compile(r"(.*?)_?(?:\d{4}(?:-\d\d){5})?_\d+\.bag")
"""The name that `rosbag record --split` gives to a part: prefix, date and number."""
ARCHIVES = ((b"\x1f\x8b", "gzip"), (b"PK\3\4", "zip"), (b"BZh", "bzip2"), (b"\xfd7zXZ", "xz"))
OTHERS = (
    (b"\x89mcap", "it begins as an MCAP file does whose line ends a transfer as text has changed; fetch it as binary"),
    (b"version https:/", "it is a pointer of Git LFS, which `git lfs pull` replaces by the file"),
    (b"<!doctype html", "it is a page of the web, as servers send it in place of a file"),
    (b"<html", "it is a page of the web, as servers send it in place of a file"),
)
"""Beginnings of what is found in place of a bag, in small letters, and what it is."""
DATASETS = "folders of datasets (TUM, EuRoC, KITTI) are read by sources of a graph: `dataflow operators` lists them"
BAG_SUFFIXES = (".bag", ".mcap", ".db3")


def open_bag(path: Path, *, strict: bool = False) -> Bag:
    """Opens a bag, and announces what is unusual about it (`notices`). Raises as `bag_at`."""
    bag = bag_at(path, strict=strict)
    bag.notes = (*bag.notes, *_timeless(bag))
    notice(path, [*bag.notes, *shortfalls(bag)])
    return bag


def _timeless(bag: Bag) -> list[str]:
    """A note where all messages have one log time, so that log times tell nothing."""
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
    head = _head(path)
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
        return _of_files(path, Path(path.stem).suffix, [path], strict)
    begins = f"it begins with {head[:8].hex(' ')}" if head else "it is empty"
    begins = next((f"it is a {name} file, to be unpacked first" for m, name in ARCHIVES if head.startswith(m)), begins)
    begins = next((what for start, what in OTHERS if head.lower().startswith(start)), begins)
    raise BagError(
        f"{path} is not an MCAP file, nor another kind of bag: {begins}. Known are MCAP files, ROS 1 bags (.bag), "
        "ROS 2 bags (a folder with metadata.yaml, .db3 or .mcap) and Rerun files (.rrd)"
    )


def is_foreign(path: Path) -> bool:
    """Tells whether a file or folder is a recording of another program: anything but an MCAP that this one wrote."""
    if path.is_dir():
        parts = parts_in(path)
        return not parts or is_foreign(parts[0])
    with path.open("rb") as opened:
        head = opened.read(HEAD_BYTES)
    if not head.startswith(MAGIC):
        return True
    if WRITER in head:
        return False
    file = McapFile(path, lenient=True)
    try:
        return not any(name == RECORDING for name, _ in file.metadata)
    finally:
        file.close()


def is_ros_bag(path: Path) -> bool:
    """Tells whether a file is a ROS 1 bag or a database of a ROS 2 bag, whole or not."""
    return path.is_file() and _head(path).startswith((ROS1_MAGIC, SQLITE_MAGIC))


def _ros_bag(path: Path, files: list[Path], strict: bool) -> Bag:
    """Opens a ROS 1 bag; several files where their names say that they are parts of one (`rosbag record --split`)."""
    from dataflow.interop.ros_bags import RosBag  # rosbags takes long to import, and most files are no such bags

    if len({found[1] if (found := _PART.fullmatch(file.name)) else file.name for file in files}) > 1:
        raise BagError(f"{path} holds {len(files)} .bag files, which are separate recordings; name one")
    return RosBag(path, files, strict=strict)


def _head(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(len(SQLITE_MAGIC))


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
    """Opens MCAP files or databases as one bag. Those compressed as files are unpacked for as long as it is open; of
    several, those that cannot be opened are left out."""
    from dataflow.interop.db3_bag import Db3Bag

    unpacked = unpack(files, strict=strict)

    def opened(some: list[Path]) -> Bag:
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
    return Unpacked(bag, unpacked) if unpacked.copies is not None else bag


def _sound(files: list[Path], opened: Callable[[list[Path]], Bag]) -> tuple[list[Path], list[str]]:
    """Those of several files that can be opened, and why others are left out."""
    sound, broken = [], []
    for file in files:
        try:
            opened([file]).close()
            sound.append(file)
        except RecordingError as error:
            broken.append(f"{file.name} is left out: {error}")
    return sound, broken
