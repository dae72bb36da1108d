"""Unpacks bags that are compressed: as whole files, or message by message."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import zstandard

from dataflow.interop.bag import BagError
from dataflow.interop.ros2_folder import COMPRESSED
from dataflow.recording.beginnings import HEAD_BYTES, ZSTD_MAGIC, head_of


@dataclass(slots=True)
class UnpackedFiles:
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


def unpack(files: Sequence[Path], *, strict: bool = False) -> UnpackedFiles:
    """Returns files as they are, those that are compressed unpacked: one that is not whole, as far as it goes.

    Raises `BagError` for one of which nothing can be unpacked, and where it is `strict` for one that is not whole.
    """
    packed = [file for file in files if file.suffix in COMPRESSED or head_of(file).startswith(ZSTD_MAGIC)]
    if not packed:
        return UnpackedFiles(list(files))
    folder = TemporaryDirectory(prefix="dataflow-bag-")
    found = UnpackedFiles([], folder)
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


def unpacked_message(data: Any) -> bytes:
    """The bytes of a message that is one zstd frame, whose size need not stand in it. Raises `zstandard.ZstdError`."""
    reader = zstandard.ZstdDecompressor().decompressobj()
    found = reader.decompress(data)
    if not reader.eof:
        raise zstandard.ZstdError("the frame is cut off")
    return found
