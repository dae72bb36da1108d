"""Scans the records of an MCAP file: for torn files, and those whose summary is no help."""

from __future__ import annotations

from mcap.opcode import Opcode

from dataflow.recording.errors import DamagedError
from dataflow.recording.limits import LIKELY_RATIO, MAX_IN_VAIN
from dataflow.recording.mcap.attachments import Place
from dataflow.recording.mcap.chunks import CHUNK_HEAD, ChunkRef, size_in_head
from dataflow.recording.mcap.contents import MESSAGE_BODY, Contents
from dataflow.recording.mcap.ending import MAGIC
from dataflow.recording.mcap.rawfile import RECORD, RawFile
from dataflow.recording.mcap.seals import Seal, seal_of


class Scan:
    """One pass over the records of a file, up to the last whole one.

    `end`: where it stopped; `whole`: whether that was at the end of the data. `trusting`: message indexes are believed
    where they are well formed; otherwise every chunk is read. `lenient`: chunks that cannot be read are left out, with
    a note. Raises `DamagedError`.
    """

    def __init__(self, file: RawFile, *, sealed: bool, trusting: bool, lenient: bool = False) -> None:
        self.contents = Contents(file)
        self.end = len(MAGIC)
        self.whole = False
        self.salvaged = ""
        self.believed = False  # that messages lie where an index puts them
        self._file = file
        self._in_vain = 0
        self._sealed, self._trusting, self._lenient = sealed, trusting, lenient
        self._pending: int | None = None
        """The chunk whose message indexes, `_indexes`, are being read."""
        self._indexes: list[bytes] = []

    def run(self) -> None:
        file = self._file
        while self.end + RECORD.size <= file.size:
            opcode, length = RECORD.unpack(file.near(self.end, RECORD.size))
            if opcode in (Opcode.DATA_END, Opcode.FOOTER):
                self.whole = True
                break
            if self.end + RECORD.size + length > file.size or opcode == 0:
                self._settle(torn=True)
                if opcode == Opcode.CHUNK and self._lenient:
                    self._salvage()
                break
            self._take(opcode, self.end, length)
            self.end += RECORD.size + length
        self._settle(torn=not self.whole)

    def _take(self, opcode: int, at: int, length: int) -> None:
        if opcode == Opcode.MESSAGE_INDEX and self._pending is not None:
            body = self._body(at, length)
            if body is not None:
                self._indexes.append(body)
            return
        self._settle()
        match opcode:
            case Opcode.CHUNK:
                if length < CHUNK_HEAD:
                    raise self._file.damaged(f"the chunk at byte {at} is too short")
                head = self._file.near(at + RECORD.size, CHUNK_HEAD)
                ref = ChunkRef(at + RECORD.size, length, size_in_head(head))
                self._pending, self._indexes = self.contents.chunks.add(ref), []
            case Opcode.SCHEMA | Opcode.CHANNEL:
                body = self._body(at, length)
                if body is not None:
                    self.contents.declare(opcode, body, at)
            case Opcode.METADATA:
                body = self._body(at, length)
                if body is not None:
                    self.contents.add_metadata(body, at)
            case Opcode.ATTACHMENT:
                self.contents.add_attachment(Place(at, RECORD.size + length))
            case Opcode.MESSAGE if not self._sealed:
                if length < MESSAGE_BODY.size:
                    raise self._file.damaged(f"the message at byte {at} is too short")
                self.contents.add_loose_message(at, length)
            case Opcode.HEADER:
                pass
            case _ if self._sealed:
                self.contents.damage.append(f"the record at byte {at} is none that this program writes; it is left out")

    def _salvage(self) -> None:
        """Takes the whole messages at the beginning of the chunk within which the file ends."""
        at = self.end + RECORD.size
        there = self._file.size - at
        if there < CHUNK_HEAD:
            return
        size = size_in_head(self._file.near(at, CHUNK_HEAD))
        number = self.contents.chunks.add(ChunkRef(at, there, size, torn=True))
        before = sum(self.contents.counts().values())
        try:
            self.contents.take_chunk(number)
        except DamagedError as error:
            self.contents.damage.append(f"{error.what}; nothing of it is saved")
            return
        saved = sum(self.contents.counts().values()) - before
        where = self.contents.chunks.where(number)
        self.salvaged = f"the file ends within {where}: {saved} whole messages and records of it are saved"

    def _body(self, at: int, length: int) -> bytes | None:
        """Returns the body of a record; None, and a note, where it fails its checksum."""
        record = self._file.record(at, length)
        if self._sealed and seal_of(record) is not Seal.SOUND:
            self.contents.damage.append(f"the record at byte {at} is damaged and left out")
            return None
        return record[RECORD.size :]

    def _settle(self, torn: bool = False) -> None:
        """Takes the messages of the chunk just passed; at a torn end its message indexes may be incomplete."""
        pending, self._pending = self._pending, None
        if pending is None:
            return
        contents = self.contents
        known = all(int.from_bytes(body[:2], "little") in contents.channels for body in self._indexes)
        if self._trusting and not torn and self._indexes and known:
            if contents.add_indexes(pending, self._indexes):
                self.believed = True
                return
            contents.damage.append(f"a message index of {contents.chunks.where(pending)} is damaged")
        if not self._sealed:  # what our writer writes expands as it may: a damaged recording can be read whole
            contents.chunks.check_ratio(pending)
        try:
            contents.take_chunk(pending)
        except DamagedError as error:
            if not self._lenient:
                raise
            ref = contents.chunks.ref(pending)
            self._in_vain += ref.uncompressed_size - LIKELY_RATIO * ref.length
            if self._in_vain > MAX_IN_VAIN:
                raise
            contents.damage.append(f"{error.what}; it is left out")
            contents.left_out += 1


def scan(file: RawFile, *, sealed: bool, trusting: bool, lenient: bool = False) -> Scan:
    """Scans `file` and returns the scan: where a trusting one meets damage, one that reads every chunk."""
    found = Scan(file, sealed=sealed, trusting=trusting, lenient=lenient)
    found.run()
    if found.believed and found.contents.damage:
        found.contents.chunks.cache.clear()  # or both passes' chunks would be in memory
        first, found = found, Scan(file, sealed=sealed, trusting=False, lenient=lenient)
        found.run()
        found.contents.damage[:] = list(dict.fromkeys([*first.contents.damage, *found.contents.damage]))
    if found.salvaged:
        found.contents.damage.append(found.salvaged)
    return found
