"""Unpacks the files of bags that are compressed as whole files."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import zstandard

from dataflow.interop.bag import Bag, BagError, Stored, Topic
from dataflow.interop.mcap_bag import McapBag
from dataflow.recording.index import McapFile


class Unpacked:
    """A bag of unpacked copies, which are deleted when it is closed."""

    def __init__(self, bag: Bag, copies: TemporaryDirectory[str]) -> None:
        self._bag, self._copies = bag, copies
        self.path, self.kind = bag.path, f"{bag.kind}, zstd"
        self.notes, self.promised = bag.notes, bag.promised

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
        self._copies.cleanup()


def unpack(files: Sequence[Path]) -> tuple[list[Path], TemporaryDirectory[str] | None]:
    """Returns files as they are, those that end in `.zstd` as unpacked copies in a temporary folder.

    Raises `BagError` for one that is not whole.
    """
    if all(file.suffix != ".zstd" for file in files):
        return list(files), None
    folder = TemporaryDirectory(prefix="dataflow-bag-")
    found = []
    for file in files:
        if file.suffix == ".zstd":
            copy = Path(folder.name) / file.stem
            try:
                with file.open("rb") as packed, copy.open("wb") as unpacked:
                    zstandard.ZstdDecompressor().copy_stream(packed, unpacked)
            except zstandard.ZstdError as error:
                folder.cleanup()
                raise BagError(f"{file} is not a whole zstd file: {error}") from error
            file = copy
        found.append(file)
    return found, folder
