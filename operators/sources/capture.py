"""Captures of packets (pcap, as tcpdump writes it): their records, and where one is damaged or breaks off."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

LONGEST = 262_144
"""Bytes of a record, at most: the longest that tcpdump writes."""
_MAGICS = {
    b"\xd4\xc3\xb2\xa1": ("<", 1000),
    b"\xa1\xb2\xc3\xd4": (">", 1000),
    b"\x4d\x3c\xb2\xa1": ("<", 1),
    b"\xa1\xb2\x3c\x4d": (">", 1),
}
"""First bytes of a capture: the order of its bytes, and the nanoseconds of its fractions of a second."""
_OTHERS = {
    b"\x0a\x0d\x0d\x0a": "it is a pcapng file; convert it: editcap -F pcap IN OUT",
    b"\x1f\x8b": "it is compressed; unpack it: gunzip",
}
_HEADER = 24


class CaptureError(ValueError):
    """A file is no capture, or damaged from some byte on; the message names it."""


def records(path: Path) -> Iterator[tuple[int, bytes]]:
    """Yields the time (ns) of each record of a capture, and its bytes. Raises `CaptureError`, `OSError`."""
    with path.open("rb") as file:
        head = file.read(_HEADER)
        order, fraction = _MAGICS.get(head[:4], ("", 0))
        if not order or len(head) < _HEADER:
            why = next((text for magic, text in _OTHERS.items() if head.startswith(magic)), "its header is another")
            raise CaptureError(f"{path} is no capture of packets (pcap): {why}")
        at = _HEADER
        while head := file.read(16):
            if len(head) < 16:
                raise CaptureError(f"{path} breaks off at byte {at}, in a record's header")
            seconds, part, length, _ = struct.unpack(f"{order}IIII", head)
            if length > LONGEST or part * fraction >= 10**9:
                raise CaptureError(f"{path} is damaged from byte {at} on: no record begins there")
            data = file.read(length)
            if len(data) < length:
                raise CaptureError(f"{path} breaks off at byte {at}, in a record of {length} bytes")
            yield seconds * 10**9 + part * fraction, data
            at += 16 + length
