"""NAL units of a packet in Annex B form (ITU-T H.264 and H.265, Annex B), and the bits of their headers."""

from __future__ import annotations

from collections.abc import Iterator

START = b"\0\0\1"
"""Stands in front of every NAL unit."""


class VideoError(ValueError):
    """Raised for a stream that is not decoded: states what was found, and what would be right."""


class PacketError(VideoError):
    """Raised for one packet that cannot be decoded: it is damaged, or not one picture."""


def units(data: bytes) -> Iterator[bytes]:
    """Yields the NAL units of a packet, each with its header and without its start code."""
    at = data.find(START)
    while at >= 0:
        after = data.find(START, at + 3)
        unit = data[at + 3 : after if after >= 0 else len(data)].rstrip(b"\0")
        if unit:
            yield unit
        at = after


class Bits:
    """Reads the bits of a NAL unit's payload, as its header fields are coded. Raises `PacketError` at the end."""

    def __init__(self, payload: bytes) -> None:
        data = payload.replace(b"\0\0\3", b"\0\0")  # emulation prevention
        self._value, self._left = int.from_bytes(data, "big"), 8 * len(data)

    def u(self, count: int) -> int:
        """Returns an unsigned number of `count` bits."""
        if count > self._left:
            raise PacketError("a header is cut short")
        self._left -= count
        return (self._value >> self._left) & ((1 << count) - 1)

    def flag(self) -> bool:
        """Returns one bit."""
        return bool(self.u(1))

    def ue(self) -> int:
        """Returns an unsigned Exp-Golomb number."""
        zeros = 0
        while not self.u(1):
            zeros += 1
            if zeros > 32:
                raise PacketError("a header holds a number of more than 32 bits")
        return (1 << zeros) - 1 + self.u(zeros)

    def se(self) -> int:
        """Returns a signed Exp-Golomb number."""
        number = self.ue()
        return (number + 1) // 2 if number % 2 else -(number // 2)

    def skip_ue(self, count: int) -> None:
        """Passes over Exp-Golomb numbers."""
        for _ in range(count):
            self.ue()
