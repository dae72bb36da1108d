"""Opens bags of any format, by what the file or folder holds."""

from __future__ import annotations

import re
from pathlib import Path

from dataflow.interop.bag import Bag, BagError
from dataflow.interop.mcap_bag import McapBag
from dataflow.recording.ending import MAGIC
from dataflow.recording.index import McapFile
from dataflow.recording.layout import RECORDING
from dataflow.recording.parts import parts_in

ROS1_MAGIC = b"#ROSBAG V"
SQLITE_MAGIC = b"SQLite format 3\x00"
WRITER = b"robot-dataflow/"
"""Our library in the header of an MCAP; what others made of one of our files may name theirs."""
HEAD_BYTES = 128
BAG_SUFFIXES = (".bag", ".mcap", ".db3")


def open_bag(path: Path) -> Bag:
    """Opens a ROS 1 bag, a ROS 2 bag (folder, .db3 or .mcap) or any other MCAP file.

    Raises `BagError` that says what else is there, `RecordingError` for a damaged MCAP file.
    """
    if path.is_dir():
        return _open_folder(path)
    head = _head(path)
    if head.startswith(MAGIC):
        return McapBag(path, [path])
    if head.startswith(ROS1_MAGIC):
        return _ros_bag(_with_suffix(path, ".bag"))
    if head.startswith(SQLITE_MAGIC):
        return _ros_bag(_with_suffix(path, ".db3"))
    begins = f"it begins with {head[:8].hex(' ')}" if head else "it is empty"
    raise BagError(
        f"{path} is not an MCAP file, nor another kind of bag: {begins}. Known are MCAP files, ROS 1 bags (.bag) and "
        "ROS 2 bags (a folder with metadata.yaml, .db3 or .mcap)"
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
    file = McapFile(path)
    try:
        return not any(name == RECORDING for name, _ in file.metadata)
    finally:
        file.close()


def _ros_bag(path: Path) -> Bag:
    from dataflow.interop.ros_bags import RosBag  # rosbags takes long to import, and most files are no such bags

    return RosBag(path)


def _head(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(len(SQLITE_MAGIC))


def _with_suffix(path: Path, suffix: str) -> Path:
    if path.suffix != suffix:
        raise BagError(f"{path} holds what a {suffix} file does; rename it so that it ends in {suffix}")
    return path


def _open_folder(path: Path) -> Bag:
    files = {suffix: sorted(path.glob(f"*{suffix}"), key=_natural) for suffix in BAG_SUFFIXES}
    if (path / "metadata.yaml").is_file():
        compressed = sorted(path.glob("*.zstd"))
        if files[".mcap"] and not compressed:
            return McapBag(path, files[".mcap"])
        return _ros_bag(path)
    if files[".mcap"]:
        return McapBag(path, files[".mcap"])
    for suffix in (".db3", ".bag"):
        if len(files[suffix]) == 1:
            return _ros_bag(files[suffix][0])
        if files[suffix]:
            raise BagError(
                f"{path} holds {len(files[suffix])} {suffix} files and no metadata.yaml that says how they belong "
                "together; name one of them, or restore the file (`ros2 bag reindex`)"
            )
    raise BagError(f"{path} is a folder without a bag: it holds no metadata.yaml, .mcap, .db3 or .bag file")


def _natural(path: Path) -> list[tuple[int, str]]:
    """Sorts bag_2 before bag_10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", path.name)]
