"""Headers of H.264 (ITU-T H.264, clauses 7.3 and E.1): key frames, B-frames, and gaps in the numbers of frames."""

from __future__ import annotations

from dataclasses import dataclass

from dataflow.video.bits import START, Bits, PacketError, VideoError, units
from dataflow.video.picture import REORDERED, Picture

IDR, SPS, PPS = 5, 7, 8
_SLICES = (1, 2, 5)
_WITH_CHROMA = {100, 110, 122, 244, 44, 83, 86, 118, 128, 138, 139, 134, 135}
"""Profiles whose parameter sets state the format of the chroma."""
_B_SLICES = (1, 6)
_EXTENDED_RATIO = 255
_HEADER = 64
"""Bytes of a slice that hold its first fields."""


def is_key(data: bytes) -> bool:
    """Returns whether a packet is a key frame with its parameter sets: a file can begin with it."""
    kinds = {unit[0] & 31 for unit in units(data)}
    return {IDR, SPS, PPS} <= kinds


@dataclass(frozen=True, slots=True)
class _Sequence:
    """A sequence parameter set."""

    frame_bits: int
    gaps: bool
    planes: bool
    reordered: int
    pixels: int


class H264Headers:
    """The parameter sets of a stream, and the number of its last reference frame."""

    def __init__(self) -> None:
        self._sequences: dict[int, _Sequence] = {}
        self._pictures: dict[int, int] = {}
        self._last: int | None = None

    def learn(self, data: bytes) -> None:
        """Takes the parameter sets in some NAL units. Raises `PacketError`."""
        for unit in units(data):
            kind = unit[0] & 31
            if kind == SPS:
                number, sequence = _sequence(Bits(unit[1:]))
                self._sequences[number] = sequence
            elif kind == PPS:
                bits = Bits(unit[1:_HEADER])
                number = bits.ue()
                self._pictures[number] = bits.ue()

    def read(self, data: bytes) -> Picture:
        """Returns the picture of the next packet. Raises `VideoError`."""
        self.learn(data)
        sets, first = b"", b""
        for unit in units(data):
            kind = unit[0] & 31
            if kind in (SPS, PPS):
                sets += START + unit
            elif kind in _SLICES:
                first = first or unit
                _refuse_b(unit)
        if not first:
            raise PacketError("a packet without a picture: one message holds one picture")
        if not Bits(first[1:2]).flag():
            raise PacketError("a packet that begins in the middle of a picture: one message holds one picture")
        return self._picture(first, sets)

    def _picture(self, unit: bytes, sets: bytes) -> Picture:
        key, reference = unit[0] & 31 == IDR, bool(unit[0] & 0x60)
        bits = Bits(unit[1:_HEADER])
        bits.skip_ue(2)
        sequence = self._sequences.get(self._pictures.get(bits.ue(), -1))
        if sequence is None:
            self._last = None
            return Picture(key, False, "its parameter sets (SPS, PPS) have not come", sets, 0)
        if sequence.reordered:
            raise VideoError(
                f"its parameter sets announce pictures in another order than their packets (max_num_reorder_frames is "
                f"{sequence.reordered}): {REORDERED}"
            )
        if sequence.planes:
            bits.u(2)
        number = bits.u(sequence.frame_bits)
        missing = "" if key else self._missing(number, sequence)
        if key or not missing:
            self._last = number if key or reference or self._last is None else self._last
        whole = key and {SPS, PPS} <= {u[0] & 31 for u in units(sets)}
        since = 0 if key else number or 1 << sequence.frame_bits
        return Picture(key, whole, missing, sets, sequence.pixels, since)

    def _missing(self, number: int, sequence: _Sequence) -> str:
        if self._last is None:
            return "no key frame has come"
        following = (self._last + 1) % (1 << sequence.frame_bits)
        if number == following or (sequence.gaps and number != self._last):
            return ""
        return f"frame {number} follows frame {self._last}: those between them are lost"


def _refuse_b(unit: bytes) -> None:
    bits = Bits(unit[1:_HEADER])
    bits.ue()
    if bits.ue() in _B_SLICES:
        raise VideoError(f"it has B-frames, whose packets are not in the order of their pictures: {REORDERED}")


def _sequence(bits: Bits) -> tuple[int, _Sequence]:
    profile = bits.u(8)
    bits.u(16)
    number = bits.ue()
    planes = False
    if profile in _WITH_CHROMA:
        chroma = bits.ue()
        planes = chroma == 3 and bits.flag()
        bits.skip_ue(2)
        bits.flag()
        if bits.flag():
            for k in range(12 if chroma == 3 else 8):
                if bits.flag():
                    _pass_scaling(bits, 16 if k < 6 else 64)
    frame_bits = bits.ue() + 4
    order = bits.ue()
    if order == 0:
        bits.ue()
    elif order == 1:
        bits.flag()
        bits.skip_ue(2)
        bits.skip_ue(bits.ue())
    bits.ue()
    gaps = bits.flag()
    columns, rows = bits.ue() + 1, bits.ue() + 1
    frames_only = bits.flag()
    if not frames_only:
        bits.flag()
    bits.flag()
    if bits.flag():
        bits.skip_ue(4)
    reordered = _reordered(bits) if bits.flag() else 0
    return number, _Sequence(frame_bits, gaps, planes, reordered, columns * rows * (256 if frames_only else 512))


def _pass_scaling(bits: Bits, size: int) -> None:
    last = following = 8
    for _ in range(size):
        if following:
            following = (last + bits.se()) % 256
        last = following or last


def _reordered(bits: Bits) -> int:
    """Returns `max_num_reorder_frames` of the video usability information; 0 where it is not stated."""
    if bits.flag() and bits.u(8) == _EXTENDED_RATIO:
        bits.u(32)
    if bits.flag():
        bits.flag()
    if bits.flag():
        bits.u(4)
        if bits.flag():
            bits.u(24)
    if bits.flag():
        bits.skip_ue(2)
    if bits.flag():
        bits.u(65)
    timed = [_has_timing(bits), _has_timing(bits)]
    if any(timed):
        bits.flag()
    bits.flag()
    if not bits.flag():
        return 0
    bits.flag()
    bits.skip_ue(4)
    return bits.ue()


def _has_timing(bits: Bits) -> bool:
    """Passes over the parameters of a hypothetical reference decoder (E.1.2), where there are some."""
    if not bits.flag():
        return False
    count = bits.ue() + 1
    bits.u(8)
    for _ in range(count):
        bits.skip_ue(2)
        bits.flag()
    bits.u(20)
    return True
