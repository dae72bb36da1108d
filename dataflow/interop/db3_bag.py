"""ROS 2 bags with sqlite3 storage: one database, or those of a split recording."""

from __future__ import annotations

import heapq
import shutil
import sqlite3
from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory

import zstandard

from dataflow.interop.bag import BagError, Stored, Topic, is_latched
from dataflow.interop.channels import join
from dataflow.interop.zstd_frames import unpacked_message
from dataflow.recording.streams.codecs import SchemaText

NO_SCHEMA = SchemaText("", "", b"")


class Db3Bag:
    """Reads SQLite databases of rosbag2 whose topics belong together. What a write-ahead log (`-wal`) holds counts, and
    a rollback journal (`-journal`) takes back what was half written.

    `compressed`: each message is a zstd frame.
    """

    def __init__(self, path: Path, files: Sequence[Path], *, compressed: bool = False) -> None:
        self.path, self.kind = path, "ROS 2 bag (sqlite3)" + (f", {len(files)} files" if len(files) > 1 else "")
        self.promised: Mapping[str, int] = {}
        self._databases: list[tuple[Path, sqlite3.Connection]] = []
        self._copies = TemporaryDirectory(prefix="dataflow-db3-")
        self._decompress = unpacked_message if compressed else None
        notes: list[str] = []
        try:
            for file in files:
                self._databases.append((file, self._open(file)))
                wal = file.with_name(f"{file.name}-wal")
                if wal.is_file() and wal.stat().st_size:
                    notes.append(f"{file.name} was not closed by its recorder: what {wal.name} holds is read too")
                if _half_written(file):
                    notes.append(f"{file.name} was not closed by its recorder: what it wrote last is taken back")
            joined = join(
                ((number, identity), topic)
                for number, (file, database) in enumerate(self._databases)
                for identity, topic in self._channels(file, database, notes)
            )
        except BaseException:
            self.close()
            raise
        self.topics, self._owner = joined.topics, joined.owner
        self.notes: tuple[str, ...] = (*notes, *joined.notes)

    def _open(self, file: Path) -> sqlite3.Connection:
        """Opens a database read-only; a copy of one that is rolled back, or that has a write-ahead log where its folder
        cannot be written to."""
        wal = file.with_name(f"{file.name}-wal")
        logged, half = wal.is_file() and wal.stat().st_size > 0, _half_written(file)
        try:
            if not half:
                return _connected(file, "mode=ro" if logged else "immutable=1")
        except sqlite3.Error as error:
            if not logged or not isinstance(error, sqlite3.OperationalError):
                raise self._broken(file, error) from error
        copy = Path(self._copies.name) / file.name
        shutil.copyfile(file, copy)
        beside = "-journal" if half else "-wal"
        shutil.copyfile(file.with_name(f"{file.name}{beside}"), copy.with_name(f"{copy.name}{beside}"))
        try:
            return _connected(copy, "mode=rw" if half else "mode=ro")
        except sqlite3.Error as error:
            raise self._broken(file, error) from error

    def _channels(self, file: Path, database: sqlite3.Connection, notes: list[str]) -> Iterator[tuple[int, Topic]]:
        try:
            tables = {row[0] for row in database.execute("select name from sqlite_master where type = 'table'")}
            if not {"messages", "topics"} <= tables:
                raise BagError(f"{file} is no ROS 2 bag: its tables are {', '.join(sorted(tables)) or 'none'}")
            columns = {row[1] for row in database.execute("pragma table_info(topics)")}
            qos = "offered_qos_profiles" if "offered_qos_profiles" in columns else "''"
            definitions = (
                {
                    row[0]: SchemaText(row[0], row[1], row[2].encode())
                    for row in database.execute(
                        "select topic_type, encoding, encoded_message_definition from message_definitions"
                    )
                }
                if "message_definitions" in tables
                else {}
            )
            spans = {
                row[0]: row[1:]
                for row in database.execute(
                    f"select topic_id, count(*), min(timestamp), max(timestamp) from messages where {_WHOLE} group by 1"
                )
            }
            (odd,) = database.execute(f"select count(*) from messages where not {_WHOLE}").fetchone()
            if odd:
                notes.append(f"{file.name}: rows without a whole time or bytes, which are no messages: {odd:,}")
            query = f"select id, name, type, serialization_format, {qos} from topics"
            for identity, name, kind, encoding, profiles in database.execute(query):
                held, first, last = spans.pop(identity, (0, None, None))
                yield (
                    identity,
                    Topic(
                        name,
                        encoding,
                        definitions.get(kind, SchemaText(kind, "", b"")),
                        held,
                        first,
                        last,
                        None,
                        is_latched(name, profiles or ""),
                        {"offered_qos_profiles": profiles} if profiles else {},
                    ),
                )
            for identity, (held, first, last) in spans.items():
                name = f"topic {identity} that {file.name} does not name"
                yield identity, Topic(name, "", NO_SCHEMA, held, first, last, None, False, {})
        except sqlite3.Error as error:
            raise self._broken(file, error) from error

    def messages(self, topics: Collection[str]) -> Iterator[Stored]:
        """Every message of some topics, in the order of log times; equal ones as they were written."""
        counters = {name: count() for name in topics}
        merged = heapq.merge(
            *(self._one(number, topics) for number in range(len(self._databases))), key=lambda row: row[0]
        )
        for log_time, name, data in merged:
            yield Stored(name, next(counters[name]), log_time, data)

    def _one(self, number: int, topics: Collection[str]) -> Iterator[tuple[int, str, bytes]]:
        file, database = self._databases[number]
        names = {place[1]: name for place, name in self._owner.items() if place[0] == number and name in topics}
        if not names:
            return
        marks = ", ".join("?" * len(names))
        query = (
            f"select topic_id, timestamp, data from messages where topic_id in ({marks}) and {_WHOLE} "
            "order by timestamp, id"
        )
        try:
            for identity, log_time, data in database.execute(query, list(names)):
                yield log_time, names[identity], data if self._decompress is None else self._decompress(data)
        except sqlite3.Error as error:
            raise self._broken(file, error) from error
        except zstandard.ZstdError as error:
            raise BagError(f"{file}: a message of {names[identity]} at {log_time} is no zstd frame: {error}") from error

    def _broken(self, file: Path, error: sqlite3.Error) -> BagError:
        return BagError(f"{file}: {error}; `dataflow recover {file} -o OUT.mcap` saves the messages that can be read")

    def close(self) -> None:
        """Closes the databases. Idempotent."""
        for _, database in self._databases:
            database.close()
        self._databases.clear()
        self._copies.cleanup()


_WHOLE = "(typeof(timestamp) = 'integer' and typeof(data) = 'blob')"
"""What a row has to hold; SQLite takes values of any type in any column."""
_JOURNAL = bytes.fromhex("d9d505f920a163d7")


def _half_written(file: Path) -> bool:
    """Tells whether a rollback journal beside a database waits to be played back (SQLite file format 3)."""
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
