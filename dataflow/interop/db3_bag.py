"""ROS 2 bags with sqlite3 storage: one database, or those of a split recording."""

from __future__ import annotations

import heapq
import shutil
import sqlite3
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory

import zstandard

from dataflow.interop.bag import BagError, Lost, Stored, Topic, is_latched
from dataflow.interop.channels import join
from dataflow.interop.salvage import NO_SCHEMA, DatabaseWreck, Row
from dataflow.interop.zstd_frames import unpacked_message
from dataflow.recording.errors import RecordingError
from dataflow.recording.streams.codecs import SchemaText


class Db3Bag:
    """Reads SQLite databases of rosbag2 whose topics belong together. The messages in a write-ahead log (`-wal`) count,
    and a rollback journal (`-journal`) takes back those that were half written. Damaged ones are read page by page.

    `compressed`: each message is a zstd frame; `strict`: damage is an error.
    """

    def __init__(self, path: Path, files: Sequence[Path], *, compressed: bool = False, strict: bool = False) -> None:
        self.path, self.kind = path, "ROS 2 bag (sqlite3)" + (f", {len(files)} files" if len(files) > 1 else "")
        self.promised: Mapping[str, int] = {}
        self.lost, self._strict = Lost(), strict
        self._databases: list[Database | DatabaseWreck] = []
        self._copies = TemporaryDirectory(prefix="dataflow-db3-")
        self._decompress = unpacked_message if compressed else None
        notes: list[str] = []
        try:
            for file in files:
                self._databases.append(self._opened(file, notes))
            joined = join(
                ((number, identity), topic)
                for number, database in enumerate(self._databases)
                for identity, topic in database.topics()
            )
        except BaseException:
            self.close()
            raise
        self.topics, self._owner = joined.topics, joined.owner
        self.notes: tuple[str, ...] = (*notes, *joined.notes)

    def _opened(self, file: Path, notes: list[str]) -> Database | DatabaseWreck:
        try:
            database = Database(file, Path(self._copies.name))
        except sqlite3.Error as error:
            if self._strict:
                raise _broken(file, error) from error
            wreck, told, lacks = self._wrecked(file, str(error))
            (self.lost.parts if lacks else notes).append(told)
            return wreck
        notes += database.notes
        return database

    def _wrecked(self, file: Path, reason: str) -> tuple[DatabaseWreck, str, bool]:
        """A damaged database, page by page; what is told of it; whether anything is known to be missing.

        Raises `BagError` where nothing is left of it.
        """
        try:
            wreck = DatabaseWreck(file)
        except (RecordingError, ValueError) as error:
            raise BagError(f"{file}: {reason}; {error}") from error
        if not wreck.counts():
            wreck.close()
            raise BagError(f"{file}: {reason}; no whole message is left in it")
        told = [f"{file.name}: {reason}", "its pages are read one by one", *wreck.losses()]
        return wreck, "; ".join(told), len(told) > 2

    def messages(self, topics: Collection[str]) -> Iterator[Stored]:
        """Every message of some topics, in the order of log times; equal ones as they were written. Those that damage
        keeps from being read are counted in `lost`; where it was opened strictly, they raise `BagError`."""
        counters = {name: count() for name in topics}
        lost: Counter[str] = Counter()
        merged = heapq.merge(
            *(self._one(number, topics, lost) for number in range(len(self._databases))), key=lambda row: row[0]
        )
        for log_time, name, data in merged:
            yield Stored(name, next(counters[name]), log_time, data)

    def _one(self, number: int, topics: Collection[str], lost: Counter[str]) -> Iterator[tuple[int, str, bytes]]:
        names = {place[1]: name for place, name in self._owner.items() if place[0] == number and name in topics}
        file = self._databases[number].path
        for log_time, identity, data in self._rows(number, names) if names else ():
            try:
                yield log_time, names[identity], data if self._decompress is None else self._decompress(data)
            except zstandard.ZstdError as error:
                what = f"{file.name}, a message at {log_time} that is no zstd frame: {error}"
                if self._strict:
                    raise BagError(f"{self.path}: topic {names[identity]}: {what}") from error
                lost[names[identity]] += 1
                self.lost.take(names[identity], lost[names[identity]], what)

    def _rows(self, number: int, names: Mapping[int, str]) -> Iterator[Row]:
        """The rows of one database; behind the first that cannot be read, those that its pages still hold."""
        database = self._databases[number]
        last, since = None, 0
        try:
            for row in database.rows(list(names)):
                since = since + 1 if row[0] == last else 1
                last = row[0]
                yield row
            return
        except sqlite3.Error as error:
            if self._strict:
                raise _broken(database.path, error) from error
            counted = {identity: topic.count for identity, topic in database.topics()}
            database.close()
            database, told, _ = self._wrecked(database.path, str(error))
            self._databases[number] = database
            self.lost.parts.append(told)
            found = database.counts()
            for identity, held in counted.items():
                if (missing := held - found.get(identity, 0)) > 0 and (number, identity) in self._owner:
                    self.lost.take(self._owner[number, identity], missing, f"{database.path.name}: {error}")
        yield from database.rows(list(names), last, since)

    def close(self) -> None:
        """Closes the databases. Idempotent."""
        self.lost.announce(self.path)
        for database in self._databases:
            database.close()
        self._databases.clear()
        self._copies.cleanup()


class Database:
    """One database, sound as far as SQLite has looked. Raises `sqlite3.Error`, and `BagError` for another's."""

    def __init__(self, path: Path, copies: Path) -> None:
        """`copies`: a folder for a copy of a database that cannot be opened where it lies."""
        self.path = path
        self.notes: list[str] = []
        wal = path.with_name(f"{path.name}-wal")
        if wal.is_file() and wal.stat().st_size:
            self.notes.append(f"{path.name} was not closed by its recorder: what {wal.name} holds is read too")
        if _half_written(path):
            self.notes.append(f"{path.name} was not closed by its recorder: what it wrote last is taken back")
        self._database = self._connected(wal, copies)
        try:
            self._topics = list(self._read_topics())
        except BaseException:
            self.close()
            raise

    def _connected(self, wal: Path, copies: Path) -> sqlite3.Connection:
        """Opens it read-only; a copy of one that is rolled back, or that has a write-ahead log where its folder cannot
        be written to."""
        file = self.path
        logged, half = wal.is_file() and wal.stat().st_size > 0, _half_written(file)
        try:
            if not half:
                return _connected(file, "mode=ro" if logged else "immutable=1")
        except sqlite3.OperationalError:
            if not logged:
                raise
        copy = copies / file.name
        shutil.copyfile(file, copy)
        beside = "-journal" if half else "-wal"
        shutil.copyfile(file.with_name(f"{file.name}{beside}"), copy.with_name(f"{copy.name}{beside}"))
        return _connected(copy, "mode=rw" if half else "mode=ro")

    def topics(self) -> Iterator[tuple[int, Topic]]:
        """The topics by number: those that are declared, and those that hold a message."""
        return iter(self._topics)

    def _read_topics(self) -> Iterator[tuple[int, Topic]]:
        file, database = self.path, self._database
        tables = {row[0] for row in database.execute("select name from sqlite_master where type = 'table'")}
        if not {"messages", "topics"} <= tables:
            raise BagError(f"{file} is no ROS 2 bag: its tables are {', '.join(sorted(tables)) or 'none'}")
        columns = {row[1] for row in database.execute("pragma table_info(topics)")}
        qos = "offered_qos_profiles" if "offered_qos_profiles" in columns else "''"
        texts = "select topic_type, encoding, encoded_message_definition from message_definitions"
        rows = database.execute(texts) if "message_definitions" in tables else ()
        definitions = {row[0]: SchemaText(row[0], row[1], row[2].encode()) for row in rows}
        times = f"select topic_id, count(*), min(timestamp), max(timestamp) from messages where {_WHOLE} group by 1"
        spans = {row[0]: row[1:] for row in database.execute(times)}
        (odd,) = database.execute(f"select count(*) from messages where not {_WHOLE}").fetchone()
        if odd:
            self.notes.append(f"{file.name}: rows without a whole time or bytes, which are no messages: {odd:,}")
        query = f"select id, name, type, serialization_format, {qos} from topics"
        for identity, name, kind, encoding, profiles in database.execute(query):
            held, first, last = spans.pop(identity, (0, None, None))
            schema = definitions.get(kind, SchemaText(kind, "", b""))
            channel = {"offered_qos_profiles": profiles} if profiles else {}
            latched = is_latched(name, profiles or "")
            yield identity, Topic(name, encoding, schema, held, first, last, None, latched, channel)
        for identity, (held, first, last) in spans.items():
            name = f"topic {identity} that {file.name} does not name"
            yield identity, Topic(name, "", NO_SCHEMA, held, first, last, None, False, {})

    def rows(self, topics: Collection[int]) -> Iterator[Row]:
        """The messages of some topics by log time; equal ones as they were written."""
        marks = ", ".join("?" * len(topics))
        query = (
            f"select timestamp, topic_id, data from messages where topic_id in ({marks}) and {_WHOLE} "
            "order by timestamp, id"
        )
        yield from self._database.execute(query, list(topics))

    def close(self) -> None:
        """Closes it. Idempotent."""
        self._database.close()


def _broken(file: Path, error: sqlite3.Error) -> BagError:
    return BagError(f"{file}: {error}; `dataflow recover {file} -o OUT.mcap` saves the messages that can be read")


_WHOLE = "(typeof(timestamp) = 'integer' and typeof(data) = 'blob')"
"""Of a row that is a message; SQLite takes values of any type in any column."""
_JOURNAL = bytes.fromhex("d9d505f920a163d7")


def _half_written(file: Path) -> bool:
    """Returns whether a rollback journal beside a database waits to be played back (SQLite file format 3)."""
    journal = file.with_name(f"{file.name}-journal")
    if not journal.is_file():
        return False
    with journal.open("rb") as opened:
        return opened.read(len(_JOURNAL)) == _JOURNAL


def _connected(file: Path, how: str) -> sqlite3.Connection:
    database = sqlite3.connect(f"{file.absolute().as_uri()}?{how}", uri=True, check_same_thread=False)
    try:
        database.execute("select count(*) from sqlite_master").fetchone()
    except sqlite3.Error:
        database.close()
        raise
    return database
