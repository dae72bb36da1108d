"""Taps: lossy, credit-limited copies of streams for viewers and tools, which can therefore never slow a producer.

A tap names the streams it wants and a window. A process sends it copies only while what it has not yet acknowledged
fits the window; beyond that the newest message of each stream waits, and older ones are skipped and counted. Copies
that Zenoh drops, for a full socket, are named by the acknowledgement; one that is still the newest of its stream is
sent again. Copies are encoded and sent by a separate thread. Here is what both sides share of the protocol;
`docs/wire-format.md` specifies it.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import msgpack
import zenoh

MAX_EXPRESSIONS: Final = 64
MAX_WINDOW_MESSAGES: Final = 1 << 16
MAX_WINDOW_BYTES: Final = 1 << 30
SPEC_BYTES: Final = 1 << 16

ATTACHMENT: Final = struct.Struct("<16sIQQQ")  # process, epoch, messages, bytes, skipped
ACKNOWLEDGEMENT: Final = struct.Struct("<IQQ")  # epoch, messages, bytes; numbers of lost messages follow, a u64 each
NUMBER_BYTES: Final = 8


@dataclass(frozen=True, slots=True)
class TapWindow:
    """Limits how much may be under way from one process to a tap, unacknowledged. It bounds the tap's memory."""

    messages: int = 64
    bytes: int = 16 << 20

    def __post_init__(self) -> None:
        if not (1 <= self.messages <= MAX_WINDOW_MESSAGES and 1 <= self.bytes <= MAX_WINDOW_BYTES):
            raise ValueError(
                f"tap window of {self.messages} messages and {self.bytes} bytes: "
                f"expected 1 to {MAX_WINDOW_MESSAGES} messages and 1 to {MAX_WINDOW_BYTES} bytes"
            )


def read_spec(data: bytes) -> tuple[tuple[zenoh.KeyExpr, ...], TapWindow]:
    """Returns the expressions and the window that a tap asks for; raises `ValueError`."""
    if len(data) > SPEC_BYTES:
        raise ValueError(f"tap request of {len(data)} bytes, at most {SPEC_BYTES}")
    try:
        spec: Any = msgpack.unpackb(data, raw=False, max_array_len=MAX_EXPRESSIONS, max_map_len=8, max_ext_len=0)
        expressions = tuple(zenoh.KeyExpr(str(e)) for e in spec["expressions"])
        return expressions, TapWindow(int(spec["messages"]), int(spec["bytes"]))
    except Exception as error:  # msgpack, Zenoh and the wrong types raise a dozen kinds
        raise ValueError(f"tap request: {error}") from None


def write_acknowledgement(epoch: int, messages: int, nbytes: int, lost: Sequence[int] = ()) -> bytes:
    """Returns the acknowledgement of all that was taken up to message number `messages`, without those `lost`."""
    return ACKNOWLEDGEMENT.pack(epoch, messages, nbytes) + struct.pack(f"<{len(lost)}Q", *lost)


def read_acknowledgement(data: bytes, window: int) -> tuple[int, int, int, frozenset[int]]:
    """Returns epoch, messages, bytes and the lost numbers, at most `window` of them; raises `ValueError`."""
    count, rest = divmod(len(data) - ACKNOWLEDGEMENT.size, NUMBER_BYTES)
    if rest or not 0 <= count <= window:
        raise ValueError(
            f"acknowledgement of {len(data)} bytes: expected {ACKNOWLEDGEMENT.size}, "
            f"and {NUMBER_BYTES} for each of at most {window} lost messages"
        )
    epoch, messages, nbytes = ACKNOWLEDGEMENT.unpack_from(data)
    return epoch, messages, nbytes, frozenset(struct.unpack_from(f"<{count}Q", data, ACKNOWLEDGEMENT.size))


def process_bytes(bus_id: str) -> bytes:
    """Returns a bus id (hexadecimal, up to 16 bytes) as 16 bytes."""
    return bytes.fromhex(bus_id.zfill(32))


def process_text(process: bytes) -> str:
    """Returns the bus id that `process_bytes` made."""
    return process.hex().lstrip("0")
