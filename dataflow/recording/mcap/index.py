"""Finds every message of an MCAP file, from its index or, for torn and foreign files without one, by a pass.

The index takes 24 bytes of memory a message, whatever the messages hold; of a long file it takes some 50
bytes a chunk, and where their messages lie is read as it is needed.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from mcap.opcode import Opcode
from mcap.records import Header

from dataflow.recording.beginnings import HEAD_BYTES, beginning
from dataflow.recording.errors import DamagedError, RecordingError
from dataflow.recording.layout import PROGRAM, RECORDING
from dataflow.recording.limits import MAX_CHUNK_BYTES
from dataflow.recording.mcap.attachments import Attachment, Place, read_attachment
from dataflow.recording.mcap.cache import ChunkCache
from dataflow.recording.mcap.contents import UNCHUNKED, Contents, signed
from dataflow.recording.mcap.ending import MAGIC
from dataflow.recording.mcap.message_index import LoadedIndex, MessageIndex
from dataflow.recording.mcap.rawfile import RECORD, RawFile, Watch
from dataflow.recording.mcap.scan import scan
from dataflow.recording.mcap.seals import Seal, seal_of
from dataflow.recording.mcap.summary import TAIL_BYTES, Footer, MiscountedError, Summary, read_footer, read_summary
from dataflow.recording.notices import notice

NO_END = (
    "has no proper end: it is being written, or its writer died; what its writer had not stored is missing "
    "(`dataflow recover` saves what follows its last whole chunk)"
)
_MESSAGE = struct.Struct("<BQHIQQ")
_MESSAGE_FIXED = _MESSAGE.size - RECORD.size


class RawMessage(NamedTuple):
    """A message record as it stands in the file. `data` is a view of its chunk."""

    channel: int
    sequence: int
    log_time: int
    data: memoryview
    publish_time: int


class McapFile:
    """Random access to the messages of an MCAP file.

    `torn`: the file has no proper end; it holds what was written up to its last whole chunk. `damage`: what is damaged
    and was got round, or left out; `left_out`: chunks whose messages are not even counted; `unread_from`: the byte from
    which on it cannot be read. Raises `RecordingError` for a file that is no MCAP or is damaged otherwise.
    """

    def __init__(
        self, path: Path, *, lenient: bool = False, watch: Watch | None = None, cache: ChunkCache | None = None
    ) -> None:
        """`lenient`: what cannot be read of a file without a sound index is left out, with a note. `cache`: keeps the
        chunks of several files, which are closed together."""
        self._lenient = lenient
        self.header = Header("", "")
        self.torn = False
        self.lost_bytes = 0
        self.damage: list[str] = []
        self.unread_from: int | None = None
        self._sealed = False
        self._promised: Mapping[int, int] = {}
        self.path = path
        self._file = RawFile(path, watch)
        try:
            contents, self.index = self._load()
        except struct.error as error:
            self._file.close()
            raise self._file.damaged(f"a record is too short: {error}") from error
        except BaseException:
            self._file.close()
            raise
        self.schemas, self.channels = contents.schemas, contents.channels
        self.metadata = contents.metadata
        self.left_out = contents.left_out
        self._attachments = contents.attachments
        self._chunks = contents.chunks
        self._chunks.cache = cache or self._chunks.cache
        self._loose_bytes = contents.loose_bytes
        notice(path, [*([NO_END] if self.torn else ()), *self.damage])

    def close(self) -> None:
        """Closes the file. Idempotent."""
        self._file.close()
        self._chunks.cache.clear()

    @property
    def own(self) -> bool:
        """Returns whether this program wrote the file, or another one made it of such a file."""
        return self.header.library.startswith(PROGRAM) or any(name == RECORDING for name, _ in self.metadata)

    @property
    def lacking(self) -> list[str]:
        """Missing parts of the file whose messages are not counted anywhere, for people."""
        name = self.path.name
        behind = f"{name}: messages behind byte {self.unread_from or 0:,} of {self.nbytes:,}, if there were any"
        uncounted = f"{name}: chunks that cannot be read, and whose messages nothing counts: {self.left_out}"
        fewer = [
            f"{name}: its statistics count {count:,} messages of {self.channels[c].topic}, {there:,} are there"
            for c, count in self._promised.items()
            if c in self.channels and (there := self.index.count(c)) < count
        ]
        found = ((self.torn, f"{name} {NO_END}"), (self.left_out, uncounted), (self.unread_from is not None, behind))
        return [*(text for there, text in found if there), *fewer]

    @property
    def nbytes(self) -> int:
        """Bytes of the file."""
        return self._file.size

    @property
    def chunks(self) -> int:
        """Number of chunks."""
        return len(self._chunks)

    def read(self, channel: int, chunk: int, offset: int, log_time: int) -> RawMessage:
        """The message that an entry of the index points to. Raises `DamagedError` where another one is there."""
        if chunk == UNCHUNKED:
            data, start = memoryview(self._unchunked(offset)), 0
        else:
            data, start = memoryview(self._chunks.data(chunk)), offset
        if start < 0 or start + _MESSAGE.size > len(data):
            raise self._misplaced(chunk, offset, "outside it")
        opcode, length, found, sequence, time, published = _MESSAGE.unpack_from(data, start)
        end = start + RECORD.size + length
        if opcode != Opcode.MESSAGE or length < _MESSAGE_FIXED or end > len(data):
            raise self._misplaced(chunk, offset, "where no message is")
        if found != channel or signed(time) != log_time:
            raise self._misplaced(
                chunk, offset, f"a message of channel {found} at {time}, not of channel {channel} at {log_time}"
            )
        return RawMessage(channel, sequence, log_time, data[start + _MESSAGE.size : end], published)

    @property
    def attached(self) -> int:
        """Number of attachments that the file names."""
        return len(self._attachments)

    @cached_property
    def attachments(self) -> Sequence[Place]:
        """The attachments that can be read, in file order; those that cannot are noted in `damage`. Reads all of
        them."""
        sound = []
        for place in sorted(self._attachments, key=lambda p: p.offset):
            try:
                read_attachment(self._file, place)
                sound.append(place)
            except DamagedError as error:
                self.damage.append(f"{error.what}; it is left out")
        return sound

    def attachment(self, place: Place) -> Attachment:
        """The attachment at a place. Raises `DamagedError`."""
        return read_attachment(self._file, place)

    def message_bytes(self) -> dict[int, int]:
        """Bytes of message data by channel, before compression. Exact where chunks hold nothing but messages; of a file
        of many chunks, estimated from some of them."""
        entries, sampled = self.index.sample()
        chunked = [(c, e.chunks != UNCHUNKED, e) for c, e in entries.items() if len(e)]
        totals = dict(self._loose_bytes)
        if not chunked:
            return totals
        owner = np.concatenate([np.full(int(mask.sum()), c, np.int64) for c, mask, _ in chunked])
        chunks = np.concatenate([e.chunks[mask] for _, mask, e in chunked])
        offsets = np.concatenate([e.offsets[mask] for _, mask, e in chunked])
        order = np.lexsort((offsets, chunks))
        owner, chunks, offsets = owner[order], chunks[order], offsets[order]
        last = np.ones(len(chunks), bool)
        last[:-1] = chunks[1:] != chunks[:-1]
        ends = np.empty_like(offsets)
        ends[:-1] = offsets[1:]
        ends[last] = np.minimum(self._chunks.sizes[chunks[last]], MAX_CHUNK_BYTES)
        sizes = np.bincount(owner, weights=np.maximum(ends - offsets - _MESSAGE.size, 0))
        for channel, _, found in chunked:
            if channel < len(sizes):
                share = 1.0 if sampled is None else self.index.count(channel) / len(found)
                totals[channel] = totals.get(channel, 0) + round(float(sizes[channel]) * share)
        return totals

    def broken_chunks(self) -> dict[int, tuple[str, str]]:
        """The chunks that cannot be read, by number: where each lies, and why. Reads all of the file."""
        broken: dict[int, tuple[str, str]] = {}
        for number in range(len(self._chunks)):
            try:
                self._chunks.data(number)
            except DamagedError as error:
                broken[number] = self._chunks.where(number), error.what
        return broken

    def weights(self) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]:
        """Log times of all messages, and how many bytes of the file each takes, as its chunk is compressed."""
        found = [e for e in map(self.index.entries, self.channels) if len(e)]
        if not found:
            return np.empty(0, np.int64), np.empty(0)
        times, chunks, offsets = (
            np.concatenate(columns) for columns in zip(*((e.times, e.chunks, e.offsets) for e in found), strict=True)
        )
        order = np.lexsort((offsets, chunks))
        times, chunks, offsets = times[order], chunks[order], offsets[order]
        limits, lengths = (np.append(column, 1) for column in (self._chunks.sizes, self._chunks.lengths))
        last = np.append(chunks[1:] != chunks[:-1], True)
        sizes = np.append(offsets[1:], 0) - offsets
        chunked = chunks != UNCHUNKED
        sizes[last & chunked] = limits[chunks[last & chunked]] - offsets[last & chunked]
        sizes[last & ~chunked] = 0
        ratios = lengths / np.maximum(limits, 1)
        weights = sizes * np.where(chunked, ratios[chunks], 1.0)  # UNCHUNKED is -1: the last one, which is 1
        return times, weights

    def _load(self) -> tuple[Contents, MessageIndex]:
        head = self._file.read_up_to(0, HEAD_BYTES)
        if not head.startswith(MAGIC):
            path = self._file.path
            raise RecordingError(f"{path} is not an MCAP file: {beginning(path, head)}")
        self._load_header()
        footer = read_footer(self._file)
        self.torn = footer is None
        summary = None if footer is None else self._from_summary(footer)
        contents = self._from_scan() if summary is None else summary.contents
        contents.damage[:0] = self.damage
        self.damage = contents.damage
        undeclared = contents.undeclared()
        if undeclared and self._lenient:
            self.damage.append(f"messages of channels that it does not declare are left out: {undeclared[:20]}")
        elif undeclared:
            raise self._file.damaged(f"it holds messages of channels that it does not declare: {undeclared[:20]}")
        return contents, LoadedIndex(contents.entries()) if summary is None else summary.index

    def _load_header(self) -> None:
        """Loads the header, which also states whether records outside chunks have checksums."""
        file, start = self._file, len(MAGIC)
        head = file.read_up_to(start, RECORD.size)
        opcode, length = RECORD.unpack(head) if len(head) == RECORD.size else (0, 0)
        if opcode != Opcode.HEADER or start + RECORD.size + length > file.size:
            if file.size > start + TAIL_BYTES:
                self.damage.append(f"its header at byte {start} is damaged")
            return
        record = file.record(start, length)
        seal = seal_of(record)
        self._sealed = seal is not Seal.ABSENT
        if seal is Seal.BROKEN:
            self.damage.append(f"its header at byte {start} is damaged")
        else:
            self.header = file.parse(Header, record[RECORD.size :], start)

    def _from_summary(self, footer: Footer) -> Summary | None:
        try:
            return read_summary(self._file, footer, sealed=self._sealed)
        except DamagedError as error:
            self._promised = error.counts if isinstance(error, MiscountedError) else {}
            self.damage.append(f"{error.what}; all of its records were read instead")
        except struct.error as error:
            self.damage.append(f"a record of its summary is too short ({error}); all of its records were read instead")
        return None

    def _from_scan(self) -> Contents:
        """Returns what a pass finds. Message indexes are not believed once anything was damaged: every chunk is
        read."""
        found = scan(self._file, sealed=self._sealed, trusting=not self.damage, lenient=self._lenient)
        if self.torn:
            self.lost_bytes = self._file.size - found.end
        elif not found.whole:
            self.unread_from = found.end
            self.damage.append(f"it cannot be read beyond byte {found.end} of {self._file.size}")
        return found.contents

    def _unchunked(self, offset: int) -> bytes:
        _, length = RECORD.unpack(self._file.read(offset, RECORD.size))
        if length > MAX_CHUNK_BYTES:
            raise self._file.damaged(f"the message at byte {offset} has {length} bytes")
        return self._file.read(offset, RECORD.size + length)

    def _misplaced(self, chunk: int, offset: int, where: str) -> DamagedError:
        within = "the file" if chunk == UNCHUNKED else self._chunks.where(chunk)
        return self._file.damaged(f"its index points to byte {offset} of {within}, {where}")


def opened(path: Path, *, watch: Watch | None = None) -> McapFile:
    """Opens a file: of ours damage is an error, of another program's what cannot be read is left out."""
    if path.is_dir():
        raise RecordingError(
            f"{path} is a folder, which does not hold the parts of one recording; name one of its files"
        )
    file = McapFile(path, lenient=True, watch=watch)
    if not (file.own and (file.torn or file.damage)):
        return file
    file.close()
    return McapFile(path, watch=watch)
