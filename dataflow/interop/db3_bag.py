"""ROS 2 bags with sqlite3 storage: one database, or those of a split recording."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Collection, Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from tempfile import TemporaryDirectory

from dataflow.interop.bag import BagError, Topic, is_latched
from dataflow.interop.joined_bag import BrokenFileError, SalvagedBag
from dataflow.interop.salvage import NO_SCHEMA, DamagedDatabase, Row
from dataflow.recording.streams.codecs import SchemaText


class Db3Bag(SalvagedBag):
    """Reads SQLite databases of rosbag2 whose topics belong together. The messages in a write-ahead log (`-wal`) count,
    and a rollback journal (`-journal`) takes back those that were half written. Damaged ones are read page by page."""

    kind = "ROS 2 bag (sqlite3)"
    _wreck = DamagedDatabase

    def _sound(self, file: Path, notes: list[str]) -> Database:
        database = Database(file)
        notes += database.notes
        return database


class Database:
    """One database, sound as far as SQLite has looked. Raises `BrokenFileError`, and `BagError` for another's."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.notes: list[str] = []
        self._closing = ExitStack()
        wal = path.with_name(f"{path.name}-wal")
        if wal.is_file() and wal.stat().st_size:
            self.notes.append(f"{path.name} was not closed by its recorder: what {wal.name} holds is read too")
        if _half_written(path):
            self.notes.append(f"{path.name} was not closed by its recorder: what it wrote last is taken back")
        try:
            self._database = self._connected(wal)
            self._topics = list(self._read_topics())
        except sqlite3.Error as error:
            self.close()
            raise BrokenFileError(path, str(error)) from error
        except BaseException:
            self.close()
            raise

    def _connected(self, wal: Path) -> sqlite3.Connection:
        """Opens it read-only; a copy of one that is rolled back, or that has a write-ahead log where its folder cannot
        be written to."""
        file = self.path
        logged, half = wal.is_file() and wal.stat().st_size > 0, _half_written(file)
        try:
            if not half:
                return self._closing.enter_context(_connected(file, "mode=ro" if logged else "immutable=1"))
        except sqlite3.OperationalError:
            if not logged:
                raise
        copy = Path(self._closing.enter_context(TemporaryDirectory(prefix="dataflow-db3-"))) / file.name
        shutil.copyfile(file, copy)
        beside = "-journal" if half else "-wal"
        shutil.copyfile(file.with_name(f"{file.name}{beside}"), copy.with_name(f"{copy.name}{beside}"))
        return self._closing.enter_context(_connected(copy, "mode=rw" if half else "mode=ro"))

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
        try:
            yield from self._database.execute(query, list(topics))
        except sqlite3.Error as error:
            raise BrokenFileError(self.path, str(error)) from error

    def close(self) -> None:
        """Closes it. Idempotent."""
        self._closing.close()


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


def _connected(file: Path, how: str) -> closing[sqlite3.Connection]:
    database = sqlite3.connect(f"{file.absolute().as_uri()}?{how}", uri=True, check_same_thread=False)
    try:
        database.execute("select count(*) from sqlite_master").fetchone()
    except sqlite3.Error:
        database.close()
        raise
    return closing(database)
