"""Unpacks the files of bags that are compressed as whole files."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

import zstandard

from dataflow.interop.bag import Bag, BagError, Stored, Topic
from dataflow.interop.mcap_bag import McapBag
from dataflow.interop.ros2_folder import COMPRESSED
from dataflow.recording.beginnings import HEAD_BYTES, ZSTD_MAGIC, head_of
from dataflow.recording.mcap.index import McapFile


@dataclass(slots=True)
class Plain:
    """Files as they are, and those that were compressed as copies in a temporary folder, if there is one.

    `damage`: by which compressed files are not whole, for people.
    """

    files: list[Path]
    copies: TemporaryDirectory[str] | None = None
    damage: list[str] = field(default_factory=list)

    def close(self) -> None:
        """Deletes the copies. Idempotent."""
        if self.copies is not None:
            self.copies.cleanup()


class Unpacked:
    """A bag of unpacked copies, which are deleted when it is closed."""

    def __init__(self, bag: Bag, plain: Plain) -> None:
        self._bag, self._plain = bag, plain
        self.path, self.kind = bag.path, f"{bag.kind}, zstd"
        self.notes, self.promised, self.lost = bag.notes, bag.promised, bag.lost

    @property
    def topics(self) -> Mapping[str, Topic]:
        """The topics by name, in alphabetical order."""
        return self._bag.topics

    @property
    def files(self) -> Sequence[McapFile]:
        """The MCAP files; none of other kinds."""
        return self._bag.files if isinstance(self._bag, McapBag) else ()

    def messages(self, topics: Collection[str]) -> Iterator[Stored]:
        """Every message of some topics, in the order of log times."""
        return self._bag.messages(topics)

    def close(self) -> None:
        """Closes and deletes the copies. Idempotent."""
        self._bag.close()
        self._plain.close()


def unpack(files: Sequence[Path], *, strict: bool = False) -> Plain:
    """Returns files as they are, those that are compressed unpacked: one that is not whole, as far as it goes.

    Raises `BagError` for one of which nothing can be unpacked, and where it is `strict` for one that is not whole.
    """
    packed = [file for file in files if file.suffix in COMPRESSED or head_of(file).startswith(ZSTD_MAGIC)]
    if not packed:
        return Plain(list(files))
    folder = TemporaryDirectory(prefix="dataflow-bag-")
    found = Plain([], folder)
    for file in files:
        copy = Path(folder.name) / (file.stem if file.suffix in COMPRESSED else file.name) if file in packed else file
        reason = _unpacked(file, copy) if file in packed else ""
        if reason and (strict or not copy.stat().st_size):
            folder.cleanup()
            raise BagError(f"{file} is not a whole zstd file: {reason}")
        if reason:
            found.damage.append(f"{file.name} is not a whole zstd file ({reason}): what is in front of that is read")
        found.files.append(copy)
    return found


def _unpacked(file: Path, copy: Path) -> str:
    """Unpacks a file as far as it goes; what is wrong behind that, nothing where it is whole."""
    reader, begun = zstandard.ZstdDecompressor().decompressobj(), False
    with file.open("rb") as packed, copy.open("wb") as unpacked:
        try:
            while block := packed.read(1 << 20):
                while block:
                    unpacked.write(reader.decompress(block))
                    block, begun = reader.unused_data, True
                    if reader.eof:
                        reader, begun = zstandard.ZstdDecompressor().decompressobj(), False
        except zstandard.ZstdError as error:
            return str(error)
    return "it is cut off" if begun else ""


def unpacked_head(path: Path) -> bytes:
    """The first `HEAD_BYTES` of what a compressed file holds, as far as they unpack."""
    with path.open("rb") as file, suppress(zstandard.ZstdError):
        return zstandard.ZstdDecompressor().stream_reader(file).read(HEAD_BYTES)
    return b""
