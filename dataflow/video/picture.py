"""Facts that the headers of a packet give of its picture, before anything is decoded."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True, slots=True)
class Picture:
    """One packet by its headers.

    - `key`: decoding can begin with it, once its parameter sets are known.
    - `whole`: it is a key frame and holds its parameter sets, so that a file can begin with it.
    - `missing`: the reason why it cannot be decoded after the packets before it; empty where it can.
    - `sets`: the parameter sets in it, in Annex B form.
    - `pixels`: of one frame.
    - `since`: pictures from the last key frame at which numbers begin anew to it, at least; 0 for such a one. Where as
      many are lost before it, that key frame may be among them, and the number fits all the same.
    """

    key: bool
    whole: bool
    missing: str
    sets: bytes
    pixels: int
    since: int = 0


class Headers(Protocol):
    """Reads the headers of a stream's packets, in the order of the stream."""

    def learn(self, data: bytes) -> None:
        """Takes the parameter sets in some NAL units, and nothing else. Raises `PacketError`."""

    def read(self, data: bytes) -> Picture:
        """Returns the picture of the next packet. Raises `VideoError` for a packet or a stream that is not decoded."""


REORDERED = "encode it without B-frames (x264: bframes=0 or tune=zerolatency; NVENC: -bf 0)"
"""Advice for streams whose packets are not in the order of their pictures."""
