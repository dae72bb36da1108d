"""RVL, the lossless compression of depth images that compressed_depth_image_transport and Kinect tools write.

Wilson, "Fast Lossless Depth Image Compression", ISS 2017.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from dataflow.recording.errors import RecordingError

MAX_PIXELS = 1 << 28
_MORE = 8
_DIGITS = 11
"""Groups of three bits that a value of 32 bits takes at most."""


def unpacked_rvl(data: npt.NDArray[np.uint8], pixels: int) -> npt.NDArray[np.uint16]:
    """The pixels of an image, flat; 0 where there is no return. Raises `RecordingError` for data that are none.

    The data are words of 32 bits, little-endian, of eight groups of four bits, the first one uppermost: three bits of a
    number, lowest ones first, and whether more follow. The numbers are: how many zeros, how many others, and of each of
    these how it differs from the one before.
    """
    if not 0 < pixels <= MAX_PIXELS:
        raise RecordingError(f"an RVL image of {pixels:,} pixels")
    numbers = _numbers(data)
    places, counts, heads = _runs(numbers.tolist(), pixels)
    held = np.ones(heads[-1] + 2 + counts[-1], bool)
    held[heads] = held[np.add(heads, 1)] = False
    coded = numbers[: len(held)][held]
    values = np.cumsum((coded >> 1) ^ -(coded & 1))
    before = np.cumsum(counts) - counts
    found = np.zeros(pixels, np.uint16)
    found[np.repeat(places - before, counts) + np.arange(len(values))] = values.astype(np.uint16)
    return found


def _runs(numbers: list[int], pixels: int) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], list[int]]:
    """Of each run of returns: its first pixel, how many they are, and the place of its two counts among the numbers."""
    places, counts, heads = [], [], []
    at = place = 0
    while place < pixels:
        if at + 2 > len(numbers):
            raise RecordingError(f"RVL data that end at pixel {place:,} of {pixels:,}")
        zeros, others = numbers[at], numbers[at + 1]
        place += zeros
        if place + others > pixels or at + 2 + others > len(numbers) or not zeros + others:
            raise RecordingError(f"RVL data that contradict themselves at pixel {place:,} of {pixels:,}")
        places.append(place)
        counts.append(others)
        heads.append(at)
        at, place = at + 2 + others, place + others
    return np.array(places, np.int64), np.array(counts, np.int64), heads


def _numbers(data: npt.NDArray[np.uint8]) -> npt.NDArray[np.int64]:
    words = np.ascontiguousarray(data[: len(data) // 4 * 4]).view("<u4")
    groups = ((words[:, None] >> np.arange(28, -1, -4, dtype=np.uint32)) & 0xF).astype(np.int64).reshape(-1)
    last = np.flatnonzero(groups < _MORE)
    if not len(last):
        return np.empty(0, np.int64)
    firsts = np.concatenate([[0], last[:-1] + 1])
    digits = np.arange(last[-1] + 1) - np.repeat(firsts, last - firsts + 1)
    if int(digits.max()) >= _DIGITS:
        raise RecordingError("RVL data with a number of more than 32 bits")
    return np.add.reduceat((groups[: last[-1] + 1] & 7) << (3 * digits), firsts)
