"""Checks recorded values for plausibility: mixed-up units, clocks years apart, sentinel values in place of data."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import islice

import numpy as np
import numpy.typing as npt

from dataflow.lint.inputs import Finding, LintInput
from dataflow.lint.timing import Timing
from dataflow.messages import DepthImage, Image16, Imu, LaserScan, Message, NavSatFix, PointCloud
from dataflow.messages.depth_units import DepthSpan
from dataflow.recording.streams.pixels import as_millimetres

SAMPLED = 2000
"""Pixels of a depth image that are kept."""
LOOKED_AT = 200
"""Messages of a stream that are looked at, evenly spread where their number is known."""
GRAVITY = 9.81
FASTEST = 35.0
"""rad/s, 2000 degrees a second: what gyroscopes of robots measure at most."""
SPINNING = 0.3
"""Gyroscopes in degrees read over this many times 35 already when a robot turns at leisure."""
DEEPEST = 300.0
"""Metres beyond which no depth camera measures."""
LONGEST_SWEEP = 60.0
"""Seconds that the points of one cloud may take."""
SWEEPS = 5.0
"""Times from cloud to cloud that the points of one do not take."""
WHOLE_TURN = 2 * np.pi
"""rad, all that a laser scanner sees."""
SMOOTHER = 0.2
"""By which factor neighbouring pixels are more alike where their bytes are in the right order."""
YEARS = 86400.0 * 30
"""Seconds by which the stamps of streams of one recording do not differ."""


@dataclass(slots=True)
class _Seen:
    """What the messages of a stream hold."""

    accelerations: list[float] = field(default_factory=list)
    rates: list[float] = field(default_factory=list)
    negative: int = 0
    returns: int = 0
    deepest: float = 0.0
    depths: list[npt.NDArray[np.float32]] = field(default_factory=list)
    sweep: float = 0.0
    farthest: float = 0.0
    ranges: list[float] = field(default_factory=list)
    angle: float = 0.0
    swapped: list[float] = field(default_factory=list)
    unplaced: int = 0
    looked: int = 0


def check_quantities(data: LintInput, timings: Mapping[str, Timing]) -> Iterator[Finding]:
    """Looks at some messages of every stream of sensors, and at the stamps of all streams."""
    for name, facts in data.streams.items():
        if not (facts.readable and facts.count):
            continue
        seen, step = _Seen(), max(1, facts.count // LOOKED_AT)
        for message in islice(data.messages(name), 0, LOOKED_AT * step, step):
            if not _look(message, seen):
                break
            seen.looked += 1
        yield from _findings(name, seen)
        yield from _of_layout(name, seen, timings.get(name))
    yield from check_spans(timings)


def _look(message: Message, seen: _Seen) -> bool:
    """Takes in a message; False for a type of which nothing is known."""
    match message:
        case Imu():
            seen.accelerations.append(float(np.linalg.norm(message.linear_acceleration)))
            seen.rates.append(float(np.linalg.norm(message.angular_velocity)))
        case DepthImage():
            data = message.data[np.isfinite(message.data)]
            seen.depths.append(data[:: 1 + data.size // SAMPLED])
            seen.negative += int((data < 0).sum())
            seen.returns += int((data > 0).sum())
            seen.deepest = max(seen.deepest, float(np.quantile(data, 0.9)) if data.size else 0.0)
            if (stored := as_millimetres(message.data)) is not None:
                seen.swapped.append(_roughness(stored))
        case Image16():
            seen.swapped.append(_roughness(message.data))
        case PointCloud():
            if message.time_offsets is not None and len(message.time_offsets):
                times = message.time_offsets[np.isfinite(message.time_offsets)].astype(np.float64)
                seen.sweep = max(seen.sweep, float(np.ptp(times)) if times.size else 0.0)
                seen.farthest = max(seen.farthest, float(np.abs(times).max(initial=0.0)))
        case LaserScan():
            seen.angle = max(seen.angle, abs(message.angle_increment) * (len(message.ranges) - 1))
            ranges = message.ranges[np.isfinite(message.ranges) & (message.ranges > 0)]
            if ranges.size:
                seen.ranges.append(float(np.median(ranges)))
                seen.unplaced += int(np.median(ranges) > message.range_max)
        case NavSatFix():
            seen.unplaced += int(message.status != "no_fix" and message.latitude == message.longitude == 0.0)
        case _:
            return False
    return True


def _findings(name: str, seen: _Seen) -> Iterator[Finding]:
    def found(text: str, **values: float) -> Finding:
        return Finding("quantity", name, "warning", text, None, values)

    if seen.accelerations:
        pull = float(np.median(seen.accelerations))
        if 0.7 < pull < 1.3:
            yield found(f"gravity is {pull:.2f}: acceleration is in g, and m/s² is wanted (times 9.81)", gravity=pull)
        elif 700 < pull < 1300:
            text = f"gravity is {pull:.0f}: acceleration is in mg, and m/s² is wanted (times 0.00981)"
            yield found(text, gravity=pull)
        elif pull < 0.3:
            text = f"gravity is {pull:.2f}: it is taken out, or the readings are of another unit than m/s²"
            yield found(text, gravity=pull)
        elif not 0.7 * GRAVITY < pull < 1.5 * GRAVITY:
            yield found(f"gravity is {pull:.3g}, and 9.81 m/s² is wanted: which unit is it in?", gravity=pull)
        fastest = float(np.quantile(seen.rates, 0.95))
        if fastest > SPINNING * FASTEST:
            slower = np.radians(fastest)
            text = f"turns at {fastest:.3g} rad/s; if that is in degrees, it is {slower:.2g} rad/s, which is wanted"
            yield found(text, rate=fastest)
    if seen.negative:
        text = f"{seen.negative:,} depths are negative; no return is 0 or NaN"
        yield found(text, pixels=seen.negative)
    elif seen.depths and not seen.returns:
        yield found(f"no pixel of {seen.looked:,} depth images has a return")
    if seen.deepest > DEEPEST:
        metres = seen.deepest / 1000
        text = (
            f"a tenth of its depths is beyond {seen.deepest:.0f} m; if they are in millimetres, beyond {metres:.1f} m"
        )
        yield found(text, depth=seen.deepest)
    elif seen.depths and (span := DepthSpan.of(np.concatenate(seen.depths), 1.0)) and (text := span.doubt()):
        yield found(text, depth=span.median)
    if max(seen.sweep, seen.farthest) > LONGEST_SWEEP:
        worst = max(seen.sweep, seen.farthest)
        units = (("ms", 1e-3), ("µs", 1e-6), ("ns", 1e-9))
        fits = next((f"; in {u} that would be {worst * s:.3g} s" for u, s in units if worst * s < 1.0), "")
        yield found(f"its points were measured up to {worst:.3g} s from the stamp of their cloud{fits}", seconds=worst)
    if seen.ranges and seen.unplaced:
        text = f"in {seen.unplaced:,} of {seen.looked:,} scans most ranges are beyond range_max"
        yield found(text + ": are they in millimetres?", scans=seen.unplaced)
    elif seen.unplaced:
        yield found(f"{seen.unplaced:,} fixes lie at 0° N 0° E: the receiver had none", fixes=seen.unplaced)


def _roughness(pixels: npt.NDArray[np.uint16]) -> float:
    """How rough pixels are with their bytes swapped (the median step between two neighbours), over how they are."""
    if not (pixels & 0xFF).any():  # 8 bits as the upper ones of 16
        return 1.0
    given, other = (
        float(np.median(np.abs(np.diff(each.astype(np.int32), axis=1)))) if each.shape[1] > 1 else 0.0
        for each in (pixels, pixels.byteswap())
    )
    return other / given if given else 1.0


def _of_layout(name: str, seen: _Seen, timing: Timing | None) -> Iterator[Finding]:
    """Values whose layout was misread: angles, times of points, bytes."""
    if seen.angle > 1.5 * WHOLE_TURN:
        text = f"its angles span {seen.angle:.0f} rad, more than a turn: are they in degrees? rad is wanted"
        yield Finding("quantity", name, "warning", text, None, {"angle": seen.angle})
    if timing is not None and timing.steady and SWEEPS * timing.period < seen.sweep <= LONGEST_SWEEP:
        text = (
            f"the points of a cloud were measured over {seen.sweep:.3g} s, and a cloud comes every "
            f"{timing.period:.3g} s: are their times in another unit than seconds?"
        )
        yield Finding("quantity", name, "warning", text, None, {"seconds": seen.sweep})
    if seen.swapped and float(np.median(seen.swapped)) < SMOOTHER:
        text = "its pixels are smooth only with their two bytes swapped: is the other order stated (is_bigendian)?"
        yield Finding("quantity", name, "warning", text)


def check_spans(timings: Mapping[str, Timing]) -> Iterator[Finding]:
    """Streams whose stamps are of another time than most, and single stamps far from their stream's."""
    if not timings:
        return
    middles = {name: (t.first + t.last) / 2 for name, t in timings.items()}
    typical = float(np.median(list(middles.values())))
    for name, timing in timings.items():
        apart = (middles[name] - typical) * 1e-9
        length = (timing.last - timing.first) * 1e-9
        if length > YEARS and timing.count * max(timing.period, 1e-3) < length / 100:
            text = f"its stamps span {_long(length)}, with {timing.count:,} messages: some are of another clock"
            yield Finding("clocks", name, "error", text, timing.first, {"seconds": length})
        elif abs(apart) > YEARS:
            when = "later" if apart > 0 else "earlier"
            text = f"its stamps are {_long(abs(apart))} {when} than those of the others: they are of another clock"
            yield Finding("clocks", name, "error", text, timing.first, {"seconds": apart})


def _long(seconds: float) -> str:
    days = seconds / 86400
    return f"{days / 365.25:.1f} years" if days > 365 else f"{days:.0f} days"
