"""ROS message definitions as they stand in a bag, made into parsers and serialisers by the `rosbags` library."""

from __future__ import annotations

import re
from functools import cache
from typing import Any

from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from dataflow.recording.errors import RecordingError
from dataflow.recording.streams.codecs import SchemaText

HEADER = "std_msgs/msg/Header"
_IDL_SEPARATOR = "=" * 80 + "\n"
_RULE = re.compile(r"^={10,}[ \t]*$", re.MULTILINE)
_NAME = re.compile(r"^(\w+)/(?:msg/)?(\w+)$")


def ros_type(name: str) -> str:
    """Returns a ROS type by its name of ROS 2: `sensor_msgs/Imu` is `sensor_msgs/msg/Imu`."""
    found = _NAME.match(name.replace("::", "/"))
    return name if found is None else f"{found[1]}/msg/{found[2]}"


class RosType:
    """One ROS message type, as a bag defines it. Raises `RecordingError` where its definition cannot be read.

    A bag without definitions (sqlite3 before Iron) is of one of several distributions: the definition counts that
    fits the messages.
    """

    def __init__(self, name: str, encoding: str, schema: SchemaText) -> None:
        self.name = ros_type(name)
        self._ros1 = encoding == "ros1"
        self._stores = [store for store in _stores(self.name, encoding, schema) if self.name in store.fielddefs]
        if not self._stores:
            raise RecordingError(f"the definition of {self.name} is not in the bag, and the type is not known here")

    @property
    def _store(self) -> Typestore:
        return self._stores[0]

    @property
    def has_header(self) -> bool:
        """Returns whether its first field is a std_msgs/Header."""
        fields = self._store.fielddefs[self.name][1]
        return bool(fields) and fields[0][1][1] == HEADER

    @property
    def fields(self) -> tuple[str, ...]:
        """Names of its fields."""
        return tuple(name for name, _ in self._store.fielddefs[self.name][1])

    def as_ros2(self) -> SchemaText:
        """Returns its definition, and those that it needs, as ROS 2 writes them. Raises `RecordingError`."""
        try:
            text, _ = _as_ros2(self._store).generate_msgdef(self.name, ros_version=2)
        except TypesysError as error:
            raise RecordingError(f"the definition of {self.name} is broken: {error}") from error
        return SchemaText(self.name, "ros2msg", text.encode())

    def to_cdr(self, data: bytes | memoryview) -> bytes:
        """Returns a ROS 1 message as ROS 2 serialises it; raises `RecordingError`."""
        try:
            return bytes(_as_ros2(self._store).ros1_to_cdr(data, self.name))
        except Exception as error:  # the library's parsers raise whatever broken bytes make them raise
            raise RecordingError(f"not a {self.name}: {_shortly(error)}") from error

    def parse(self, data: bytes | memoryview) -> Any:
        """Returns the message as an object; raises `RecordingError`."""
        failed: Exception | None = None
        for store in self._stores:
            try:
                read = store.deserialize_ros1 if self._ros1 else store.deserialize_cdr
                message = read(data, self.name)
            except Exception as error:  # the library's parsers raise whatever broken bytes make them raise
                failed = failed or error
                continue
            if store is not self._stores[0]:
                self._stores = [store, *(other for other in self._stores if other is not store)]
            return message
        assert failed is not None
        raise RecordingError(f"not a {self.name}: {_shortly(failed)}") from failed


def _shortly(error: Exception) -> str:
    text = str(error)
    return f"{type(error).__name__}: {text}" if text else "its bytes do not fit the definition"


def same_layout(encoding: str, a: SchemaText, b: SchemaText) -> bool:
    """Returns whether two definitions, whatever their comments and constants, say the same of the bytes."""
    try:
        one, other = (_stores(ros_type(s.name), encoding, s)[0] for s in (a, b))
        return bool(_layout(one, ros_type(a.name)) == _layout(other, ros_type(b.name)))
    except (RecordingError, KeyError):
        return False


def _layout(store: Typestore, name: str) -> Any:
    """The fields of a type, those of the types that it holds in place of their names."""

    def of(description: Any) -> Any:
        node, what = int(description[0]), description[1]
        if node == 1:
            return what
        if node == 2:
            return _layout(store, what)
        return node, of(what[0]), what[1]

    return [(field, of(description)) for field, description in store.fielddefs[name][1]]


@cache
def _stores(name: str, encoding: str, schema: SchemaText) -> tuple[Typestore, ...]:
    """The definitions that may be meant, likeliest first."""
    text = _plain(schema.data.decode("utf-8", "replace"))
    if not text.strip() and schema.encoding in ("", "ros2msg", "ros1msg"):
        if encoding == "ros1" or schema.encoding == "ros1msg":
            return (get_typestore(Stores.ROS1_NOETIC),)
        return tuple(get_typestore(s) for s in (Stores.ROS2_HUMBLE, Stores.ROS2_FOXY, Stores.LATEST))
    store = get_typestore(Stores.EMPTY)
    try:
        store.register(_types(name, schema.encoding, text))
    except TypesysError as error:
        first = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise RecordingError(f"the definition of {name} in the bag cannot be read ({first})") from error
    return (store,)


@cache
def _as_ros2(store: Typestore) -> Typestore:
    """The same types with the header of ROS 2, which has no sequence number."""
    made = get_typestore(Stores.EMPTY)
    types = dict(store.fielddefs)
    if HEADER in types:
        constants, fields = types[HEADER]
        types[HEADER] = constants, [field for field in fields if field[0] != "seq"]
    made.register(types)
    return made


def _plain(text: str) -> str:
    """A definition with the line ends and separators that ROS writes, as an editor on another system leaves it."""
    return _RULE.sub(_IDL_SEPARATOR.rstrip(), text.removeprefix("\ufeff").replace("\r\n", "\n"))


def _types(name: str, encoding: str, text: str) -> Any:
    if encoding not in ("ros2idl", "omgidl"):
        return get_types_from_msg(text, name)
    if not text.startswith(f"{_IDL_SEPARATOR}IDL: "):
        return get_types_from_idl(text)
    found: dict[str, Any] = {}
    for part in text.split(_IDL_SEPARATOR)[1:]:
        found |= get_types_from_idl(part.partition("\n")[2])
    return found
