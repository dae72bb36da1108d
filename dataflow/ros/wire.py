"""Names and bytes of the wire that rmw_zenoh speaks: key expressions, liveliness tokens, attachments. Pure.

Source: rmw_zenoh_cpp (`liveliness_utils.cpp`, `attachment_helpers.cpp`, docs/design.md), Humble 0.1.8 and later.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from typing import NamedTuple, Self

import xxhash

NO_HASH = "TypeHashNotSupported"
"""In place of the type hash, in Humble."""
_SPACE = "@ros2_lv"
_ATTACHMENT = struct.Struct("<qqB16s")
_RELIABLE, _BEST_EFFORT = "1", "2"
_TRANSIENT_LOCAL, _VOLATILE = "1", "2"
_KEEP_LAST, _KEEP_ALL = "1", "2"
_DEPTH = "10"
_DEFAULTS = ",:,:,,"
"""Deadline, lifespan and liveliness, none of which is set."""


class WireError(ValueError):
    """Bytes or a name that rmw_zenoh would not have written."""


@dataclass(frozen=True, slots=True)
class Qos:
    """Quality of service of one end of a topic. `depth`: messages that are kept."""

    reliable: bool = True
    transient_local: bool = False
    keep_all: bool = False
    depth: int = 10

    def encoded(self) -> str:
        """The last part of a token, in which the defaults of ROS stand empty."""
        reliability = "" if self.reliable else _BEST_EFFORT
        durability = _TRANSIENT_LOCAL if self.transient_local else ""
        history = _KEEP_ALL if self.keep_all else ""
        depth = str(self.depth)
        return f"{reliability}:{durability}:{history},{'' if depth == _DEPTH else depth}:{_DEFAULTS}"

    @classmethod
    def decoded(cls, text: str) -> Self:
        """Reads the last part of a token; its deadline, lifespan and liveliness are passed over. Raises `WireError`."""
        try:
            reliability, durability, history, _, _, _ = text.split(":")
            kept, depth = history.split(",")
            return cls(
                (reliability or _RELIABLE) != _BEST_EFFORT,
                (durability or _VOLATILE) == _TRANSIENT_LOCAL,
                (kept or _KEEP_LAST) == _KEEP_ALL,
                int(depth or _DEPTH),
            )
        except ValueError:
            raise WireError(f"quality of service {text!r}: expected such as '2:1:1,5:,:,:,,'") from None


class Attachment(NamedTuple):
    """Goes with each message. `number`: counts from 1 for each publisher; `time`: of publication, ns since the epoch;
    `gid`: 16 bytes that name the publisher."""

    number: int
    time: int
    gid: bytes

    def encoded(self) -> bytes:
        """The 33 bytes on the wire."""
        return _ATTACHMENT.pack(self.number, self.time, len(self.gid), self.gid)

    @classmethod
    def decoded(cls, data: bytes) -> Self:
        """Reads the bytes on the wire. Raises `WireError`."""
        if len(data) != _ATTACHMENT.size or data[16] != 16:
            raise WireError(f"an attachment of {len(data)} bytes; rmw_zenoh writes {_ATTACHMENT.size}")
        number, time, _, gid = _ATTACHMENT.unpack(data)
        return cls(number, time, gid)


@dataclass(frozen=True, slots=True)
class Node:
    """A node of a ROS graph. `session`: id of its Zenoh session; `namespace` begins with a slash."""

    domain: int
    session: str
    namespace: str
    name: str

    @property
    def full_name(self) -> str:
        """The name as `ros2 node list` prints it."""
        return f"{self.namespace.rstrip('/')}/{self.name}"

    def token(self, id_: str = "0", kind: str = "NN") -> str:
        """The key of its liveliness token, or how that of one of its ends begins. It is the session's only node."""
        return f"{_SPACE}/{self.domain}/{self.session}/0/{id_}/{kind}/%/{_mangled(self.namespace)}/{self.name}"


@dataclass(frozen=True, slots=True)
class End:
    """A publisher (`MP`) or a subscription (`MS`) of a topic.

    `topic`: with its namespace and a leading slash; `type`: such as `std_msgs/msg/String`; `hash`: of its definition.
    """

    node: Node
    id: str
    kind: str
    topic: str
    type: str
    hash: str
    qos: Qos = field(default_factory=Qos)

    @property
    def key(self) -> str:
        """The key expression of its messages."""
        return f"{self.node.domain}/{self.topic.strip('/')}/{_type_on_wire(self.type)}/{self.hash}"

    @property
    def token(self) -> str:
        """The key of its liveliness token."""
        begin = self.node.token(self.id, self.kind)
        return f"{begin}/{_mangled(self.topic)}/{_type_on_wire(self.type)}/{self.hash}/{self.qos.encoded()}"

    @property
    def gid(self) -> bytes:
        """The 16 bytes by which attachments name it."""
        return gid_of(self.token)

    @classmethod
    def decoded(cls, token: str) -> Self:
        """Reads a token; what later versions add to it is passed over. Raises `WireError` for any other key."""
        parts = token.split("/")
        if len(parts) < 13 or parts[0] != _SPACE or not parts[1].isdecimal():
            raise WireError(f"liveliness token {token!r}: expected {_SPACE}/DOMAIN/… with 13 parts")
        _, domain, session, _, id_, kind, _, namespace, name, topic, type_, hash_, qos, *_ = parts
        node = Node(int(domain), session, _plain(namespace), name)
        return cls(node, id_, kind, _plain(topic), _type_of_wire(type_), hash_, Qos.decoded(qos))


def gid_of(token: str) -> bytes:
    """Returns the 16 bytes that name the holder of a token: its XXH3, as attachments have it."""
    return xxhash.xxh3_128_intdigest(token.encode()).to_bytes(16, "little")


def tokens_of(domain: int, topic: str = "", kind: str = "MP") -> str:
    """Returns the key expression of the tokens of a topic's ends; of all topics where none is named."""
    return f"{_SPACE}/{domain}/*/*/*/{kind}/*/*/*/{_mangled(topic) or '*'}/*/*/**"


def absolute(topic: str, namespace: str) -> str:
    """Returns a topic's full name: one without a leading slash lies in the namespace."""
    return topic if topic.startswith("/") else f"/{namespace.strip('/')}/{topic}".replace("//", "/")


def _mangled(name: str) -> str:
    return name.replace("/", "%")


def _plain(name: str) -> str:
    return name.replace("%", "/")


def _type_on_wire(name: str) -> str:
    package, _, type_ = name.rpartition("/")
    return f"{package.replace('/', '::')}::dds_::{type_}_"


def _type_of_wire(name: str) -> str:
    return name.replace("::dds_::", "/").replace("::", "/").removesuffix("_")
