"""Message definitions of the ROS 2 distributions: their hashes, messages read by them, messages written by them.

Types and fields are mapped by `dataflow.interop.ros`, as those of bags are.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from functools import cache
from typing import Any, Literal

from rosbags.typesys import Stores
from rosbags.typesys.store import Typestore

from dataflow.interop.bag import Topic
from dataflow.interop.ros import CONVERSIONS
from dataflow.interop.ros.construction import typestore
from dataflow.interop.ros.to_ros2 import OUTWARD
from dataflow.interop.topics import TopicReader, reader_of
from dataflow.messages import Message
from dataflow.recording.errors import RecordingError
from dataflow.recording.streams.codecs import SchemaText
from dataflow.ros.message import RosMessage
from dataflow.ros.wire import NO_HASH

Distro = Literal["humble", "jazzy", "kilted", "lyrical"]
_STORES: dict[Distro, Stores] = {
    "humble": Stores.ROS2_HUMBLE,
    "jazzy": Stores.ROS2_JAZZY,
    "kilted": Stores.ROS2_KILTED,
    "lyrical": Stores.ROS2_LYRICAL,
}
CLOCK = "rosgraph_msgs/msg/Clock"
_INTEGERS = {"Int8", "Int16", "Int32", "Int64", "UInt8", "UInt16", "UInt32", "UInt64"}


def store_of(distro: Distro) -> Typestore:
    """The types of a distribution, and those that it does not ship and that are mapped."""
    return typestore(_STORES[distro])


@cache
def type_hash(type_: str, distro: Distro) -> str | None:
    """Returns the hash by which a distribution names a type's definition on the wire; None for an unknown type."""
    if distro == "humble":
        return NO_HASH
    store = store_of(distro)
    return store.hash_rihs01(type_) if type_ in store.fielddefs else None


def distros_of(type_: str, hash_: str) -> tuple[Distro, ...]:
    """Returns the distributions whose definition of a type has a hash, newest first."""
    return tuple(distro for distro in reversed(_STORES) if type_hash(type_, distro) == hash_)


def reader_for(topic: str, type_: str, distro: Distro) -> TopicReader:
    """Returns the reader of a topic's messages. Raises `RecordingError` for a type that is not mapped."""
    store = store_of(distro)
    if type_ not in CONVERSIONS or type_ not in store.fielddefs:
        raise RecordingError(f"{type_} has no counterpart here; use dataflow.ros:Ros2Source passes it on as it is")
    schema = SchemaText(type_, "ros2msg", store.generate_msgdef(type_, ros_version=2)[0].encode())
    return reader_of(Topic(topic, "cdr", schema, 0, None, None, None, False, {}))


def written(message: Message, type_: str, distro: Distro) -> tuple[str, str, bytes]:
    """Returns a message as ROS type, type hash and CDR. `type_`: the type wanted; "" takes the one that is usual.

    A type that is a part of the usual one, or made of its parts, may be wanted: a geometry_msgs/msg/Twist of a
    TwistWithCovarianceStamped. Raises `RecordingError`.
    """
    if isinstance(message, RosMessage):
        if type_ not in ("", message.type):
            raise RecordingError(f"a message of {message.type} came, and {type_} is to be sent")
        return message.type, message.hash, message.data.tobytes()
    make = OUTWARD.get(type(message))
    if make is None:
        raise RecordingError(f"{message.SCHEMA} has no counterpart in ROS")
    made = make(message)
    kind = type_ or made.__msgtype__
    store = store_of(distro)
    if kind not in store.fielddefs:
        raise RecordingError(f"{kind} is not a type of ROS 2 {distro} that is known here")
    chosen = _as(made, kind, store, message)
    hash_ = type_hash(kind, distro)
    assert hash_ is not None
    try:
        return kind, hash_, bytes(store.serialize_cdr(chosen, kind))
    except (struct.error, OverflowError, ValueError, TypeError) as error:
        raise RecordingError(f"a {message.SCHEMA} does not fit into {kind}: {error}") from error


def _as(made: Any, kind: str, store: Typestore, message: Message) -> Any:
    """A ROS message as another type: itself, a part of it, or one built of its parts."""
    found = next((part for part in _parts(made) if part.__msgtype__ == kind), None)
    names = [name for name, _ in store.fielddefs[kind][1]]
    if found is not None and all(hasattr(found, name) for name in names):
        return found
    if found is not None:  # a newer definition, whose further fields the message may have
        further = {n: getattr(message, n, None) or 0.0 for n in names if not hasattr(found, n)}
        return store.types[kind](**further, **{n: getattr(found, n) for n in names if n not in further})
    package, _, name = kind.rpartition("/")
    if package == "std_msgs/msg" and names == ["data"] and isinstance(getattr(made, "data", None), float):
        whole = made.data.is_integer()
        if name in _INTEGERS and not whole:
            raise RecordingError(f"{made.data} is no whole number, and {kind} is to be sent")
        return store.types[kind](data=int(made.data) if name in _INTEGERS else made.data)
    built = {}
    for field, (_, of) in store.fielddefs[kind][1]:
        part = next((p for p in _parts(made) if p.__msgtype__ == of), None)
        if part is None:
            raise RecordingError(f"a {message.SCHEMA} is sent as {made.__msgtype__} or its parts, and not as {kind}")
        built[field] = part
    return store.types[kind](**built)


def _parts(made: Any) -> Iterator[Any]:
    """A ROS message and the messages in it, from the outside in; those of a list where it has one alone."""
    yield made
    for value in vars(made).values():
        if isinstance(value, list) and len(value) == 1:
            value = value[0]
        if hasattr(value, "__msgtype__"):
            yield from _parts(value)


def clock_time(data: bytes) -> int:
    """Returns the time of a message of /clock, ns. Raises `RecordingError`."""
    if len(data) < 12:
        raise RecordingError(f"a {CLOCK} of {len(data)} bytes is too short")
    seconds, nanoseconds = struct.unpack_from("<iI" if data[1] & 1 else ">iI", data, 4)
    return int(seconds) * 10**9 + int(nanoseconds)
