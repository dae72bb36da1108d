"""Headers of H.265 (ITU-T H.265, clause 7.3): key frames, the order of pictures, and pictures that are referred to."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from dataflow.video.bits import START, Bits, PacketError, VideoError, units
from dataflow.video.picture import REORDERED, Picture

VPS, SPS, PPS = 32, 33, 34
_IDR = (19, 20)
_KEYS = range(16, 24)
_LEADING = range(6, 10)
_SLICES = (*range(10), *range(16, 22))
_HEADER = 256
"""Bytes of a slice that hold its first fields."""
_MAX_SETS = 64

References = tuple[tuple[int, bool], ...]
"""(difference of the picture order count, used by the current picture), the nearest first, earlier ones first."""


def _kind(unit: bytes) -> int:
    return unit[0] >> 1 & 63


def _base_layer(data: bytes) -> Iterator[bytes]:
    """Yields the NAL units of a packet that are not of an enhancement layer."""
    return (unit for unit in units(data) if len(unit) > 2 and not unit[0] & 1 and not unit[1] >> 3)


def is_key(data: bytes) -> bool:
    """Returns whether a packet is a key frame with its parameter sets: a file can begin with it."""
    kinds = {_kind(unit) for unit in units(data)}
    return {VPS, SPS, PPS} <= kinds and any(kind in _KEYS for kind in kinds)


@dataclass(frozen=True, slots=True)
class _Sequence:
    """A sequence parameter set."""

    order_bits: int
    planes: bool
    long_term: bool
    references: tuple[References, ...]
    reordered: int
    pixels: int


@dataclass(frozen=True, slots=True)
class _PictureSet:
    """A picture parameter set."""

    sequence: int
    output_flag: bool
    extra_bits: int


class H265Headers:
    """The parameter sets of a stream, and the pictures that later ones may refer to, by their order counts."""

    def __init__(self) -> None:
        self._sequences: dict[int, _Sequence] = {}
        self._pictures: dict[int, _PictureSet] = {}
        self._held: set[int] | None = None
        self._anchor = 0
        """The order count of the last picture of the lowest temporal layer, from which counts go on."""

    def learn(self, data: bytes) -> None:
        """Takes the parameter sets in some NAL units. Raises `PacketError`."""
        for unit in _base_layer(data):
            kind = _kind(unit)
            if kind == SPS:
                number, sequence = _sequence(Bits(unit[2:]))
                self._sequences[number] = sequence
            elif kind == PPS:
                bits = Bits(unit[2:_HEADER])
                number = bits.ue()
                parent, _, output_flag = bits.ue(), bits.flag(), bits.flag()
                self._pictures[number] = _PictureSet(parent, output_flag, bits.u(3))

    def read(self, data: bytes) -> Picture:
        """Returns the picture of the next packet. Raises `VideoError`."""
        self.learn(data)
        sets, first, kinds = b"", b"", set()
        for unit in _base_layer(data):
            kind = _kind(unit)
            kinds.add(kind)
            if kind in (VPS, SPS, PPS):
                sets += START + unit
            elif kind in _SLICES and not first:
                first = unit
        if not first:
            raise PacketError("a packet without a picture: one message holds one picture")
        if not Bits(first[2:3]).flag():
            raise PacketError("a packet that begins in the middle of a picture: one message holds one picture")
        return self._picture(first, sets, kinds >= {VPS, SPS, PPS})

    def _picture(self, unit: bytes, sets: bytes, has_sets: bool) -> Picture:
        kind = _kind(unit)
        key = kind in _KEYS
        bits = Bits(unit[2:_HEADER])
        bits.flag()
        if key:
            bits.flag()
        pictures = self._pictures.get(bits.ue())
        sequence = self._sequences.get(pictures.sequence) if pictures is not None else None
        if pictures is None or sequence is None:
            self._held = None
            return Picture(key, False, "its parameter sets (VPS, SPS, PPS) have not come", sets, 0)
        if sequence.reordered:
            raise VideoError(
                "its parameter sets announce pictures in another order than their packets (sps_max_num_reorder_pics is "
                f"{sequence.reordered}): {REORDERED}"
            )
        bits.u(pictures.extra_bits)
        bits.ue()
        bits.u(pictures.output_flag + 2 * sequence.planes)
        newest = max(self._held or (0,))
        missing = self._begin(kind, bits, sequence) if key else self._follow(unit, bits, sequence)
        order = max(self._held or (0,))
        since = 0 if key else (order % (1 << sequence.order_bits) or 1 << sequence.order_bits) // max(1, order - newest)
        return Picture(key, key and has_sets, missing, sets, sequence.pixels, since)

    def _begin(self, kind: int, bits: Bits, sequence: _Sequence) -> str:
        """Takes a key frame; the ones before it are not referred to any more."""
        self._anchor = 0 if kind in _IDR else bits.u(sequence.order_bits)
        self._held = {self._anchor}
        return ""

    def _follow(self, unit: bytes, bits: Bits, sequence: _Sequence) -> str:
        """Takes another picture; returns why it cannot be decoded, or nothing."""
        if self._held is None:
            return "no key frame has come"
        order = _unwrapped(bits.u(sequence.order_bits), self._anchor, 1 << sequence.order_bits)
        count = len(sequence.references)
        if not bits.flag():
            references = _references(bits, count, sequence.references)
        else:
            references = sequence.references[bits.u((count - 1).bit_length())] if count else ()
        needed = {order + delta for delta, used in references if used}
        if needed - self._held:
            lost = ", ".join(map(str, sorted(needed - self._held)))
            return f"picture {order} refers to {lost}, which did not come"
        if self._held and order < max(self._held):
            raise VideoError(f"picture {order} comes after picture {max(self._held)}: {REORDERED}")
        if not sequence.long_term:
            self._held &= {order + delta for delta, _ in references}
        self._held.add(order)
        kind = _kind(unit)
        if unit[1] & 7 == 1 and not (kind in _LEADING or (kind < 16 and kind % 2 == 0)):
            self._anchor = order
        return ""


def _unwrapped(low: int, anchor: int, period: int) -> int:
    """Returns the order count with the lowest bits `low` that is nearest to `anchor` (8.3.1)."""
    return anchor + (low - anchor + period // 2) % period - period // 2


def _sequence(bits: Bits) -> tuple[int, _Sequence]:
    bits.u(4)
    layers = bits.u(3)
    bits.flag()
    _pass_profile(bits, layers)
    number = bits.ue()
    planes = bits.ue() == 3 and bits.flag()
    width, height = bits.ue(), bits.ue()
    if bits.flag():
        bits.skip_ue(4)
    bits.skip_ue(2)
    order_bits = bits.ue() + 4
    reordered = 0
    for _ in range(layers + 1 if bits.flag() else 1):
        bits.ue()
        reordered = bits.ue()
        bits.ue()
    bits.skip_ue(6)
    if bits.flag() and bits.flag():
        _pass_scaling(bits)
    bits.u(2)
    if bits.flag():
        bits.u(8)
        bits.skip_ue(2)
        bits.flag()
    count = bits.ue()
    if count > _MAX_SETS:
        raise PacketError(f"a parameter set holds {count} reference picture sets, at most {_MAX_SETS} can")
    references: list[References] = []
    for _ in range(count):
        references.append(_references(bits, count, references))
    return number, _Sequence(order_bits, planes, bits.flag(), tuple(references), reordered, width * height)


def _pass_profile(bits: Bits, layers: int) -> None:
    bits.u(96)
    present = [(bits.flag(), bits.flag()) for _ in range(layers)]
    if layers:
        bits.u(2 * (8 - layers))
    for profile, level in present:
        bits.u(88 * profile + 8 * level)


def _pass_scaling(bits: Bits) -> None:
    for size in range(4):
        for _ in range(2 if size == 3 else 6):
            if not bits.flag():
                bits.ue()
                continue
            bits.skip_ue((size > 1) + min(64, 1 << (4 + 2 * size)))


def _references(bits: Bits, count: int, known: tuple[References, ...] | list[References]) -> References:
    """Reads a reference picture set (7.3.7): the next of a sequence's `count` after `known`, or a slice's own."""
    index = len(known)
    if index and bits.flag():
        back = bits.ue() + 1 if index == count else 1
        sign = -1 if bits.flag() else 1
        shift = sign * (bits.ue() + 1)
        if back > index:
            raise PacketError("a reference picture set refers to one that is not there")
        found = []
        for delta in (*(delta for delta, _ in known[index - back]), 0):
            used = bits.flag()
            if (used or bits.flag()) and delta + shift:
                found.append((delta + shift, used))
        return tuple(sorted(found, key=lambda entry: (entry[0] > 0, abs(entry[0]))))
    earlier, later = bits.ue(), bits.ue()
    if earlier + later > 16:
        raise PacketError(f"a reference picture set holds {earlier + later} pictures, at most 16 can")
    found = []
    for entries, sign in ((earlier, -1), (later, 1)):
        delta = 0
        for _ in range(entries):
            delta += sign * (bits.ue() + 1)
            found.append((delta, bits.flag()))
    return tuple(found)
