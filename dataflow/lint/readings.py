"""Checks single readings and poses: mixed-up units, numbers that are none, speeds that no robot has."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice

import numpy as np

from dataflow.interop.conversions import decoded
from dataflow.lint.inputs import Finding, LintInput
from dataflow.messages import CompressedDepth, CompressedImage, MagneticField, Measurement, Message, Odometry, Pose
from dataflow.recording.errors import RecordingError

LOOKED_AT = 2000
"""Messages of a stream that are looked at, evenly spread where their number is known."""
DECODED = 50
"""Encoded images of a stream that are looked at."""
EARTH = (2.0e-5, 7.0e-5)
"""T, of the earth's magnetic field."""
STRONGEST = 2.0e-3
"""T, what magnetometers of robots measure at most."""
FASTEST = 1000.0
"""m/s, faster than anything that carries these sensors."""
_SMALLER = (("µT", 1e-6), ("gauss", 1e-4), ("milligauss", 1e-7), ("nT", 1e-9))
_NUMBERS = {
    "Odometry": ("position", "orientation", "linear", "angular"),
    "Pose": ("position", "orientation"),
    "Twist": ("linear", "angular"),
    "Imu": ("angular_velocity", "linear_acceleration"),
    "MagneticField": ("field",),
}
"""By message type, fields whose numbers are all wanted."""
_ENCODED = ("CompressedImage", "CompressedDepth")


def check_readings(data: LintInput) -> Iterator[Finding]:
    """Looks at some messages of every stream of these types."""
    for name, facts in data.streams.items():
        if not (facts.readable and facts.count and facts.type in (*_NUMBERS, *_ENCODED, "Measurement")):
            continue
        most = DECODED if facts.type in _ENCODED else LOOKED_AT
        step = max(1, facts.count // most)
        looked = list(islice(data.messages(name), 0, most * step, step))
        if looked:
            yield from (
                Finding("quantity", name, "warning", text, None, values) for text, values in _doubts(facts.type, looked)
            )


Doubt = tuple[str, dict[str, float]]


def _doubts(kind: str, looked: list[Message]) -> Iterator[Doubt]:
    given = ([v for name in _NUMBERS.get(kind, ()) if (v := getattr(m, name)) is not None] for m in looked)
    odd = [m for m, values in zip(looked, given, strict=True) if not all(np.isfinite(v).all() for v in values)]
    if odd:
        text = f"{len(odd):,} of {len(looked):,} messages hold numbers that are not finite, the first at {odd[0].stamp}"
        yield text, {"messages": len(odd)}
    if kind in ("Odometry", "Pose"):
        yield from _speeds([m for m in looked if m not in odd])
    elif kind == "MagneticField":
        yield from _strength([m for m in looked if isinstance(m, MagneticField)])
    elif kind in _ENCODED:
        yield from _encoded([m for m in looked if isinstance(m, (CompressedImage, CompressedDepth))])
    elif kind == "Measurement":
        yield from _measured([m for m in looked if isinstance(m, Measurement)])


def _speeds(looked: list[Message]) -> Iterator[Doubt]:
    """Steps from one looked-at position to the next that nothing makes in that time."""
    placed = [m for m in looked if isinstance(m, (Odometry, Pose))]
    if len(placed) < 2:
        return
    stamps = np.array([m.stamp for m in placed], np.float64) * 1e-9
    positions = np.array([m.position for m in placed], np.float64)
    with np.errstate(over="ignore"):
        speeds = np.linalg.norm(np.diff(positions, axis=0), axis=1) / np.maximum(np.diff(stamps), 1e-3)
    beyond = int((speeds > FASTEST).sum())
    if not beyond:
        return
    if beyond > len(speeds) // 2:
        text = f"its positions move at {np.median(speeds):.3g} m/s: are they in millimetres?"
        yield text, {"speed": float(np.median(speeds))}
        return
    first = int(np.argmax(speeds > FASTEST))
    text = f"its positions jump {beyond:,} times faster than {FASTEST:g} m/s, the first at {placed[first + 1].stamp}"
    yield text, {"jumps": beyond}


def _strength(looked: list[MagneticField]) -> Iterator[Doubt]:
    strengths = np.array([np.linalg.norm(m.field) for m in looked])
    strengths = strengths[np.isfinite(strengths)]
    strength = float(np.median(strengths)) if len(strengths) else 0.0
    if strength > STRONGEST:
        fits = [unit for unit, scale in _SMALLER if EARTH[0] <= strength * scale <= EARTH[1]]
        told = f": it is in {fits[0]}" if fits else ""
        yield f"a magnetic field of {strength:.3g} T{told}, and tesla are wanted", {"field": strength}


def _measured(looked: list[Measurement]) -> Iterator[Doubt]:
    unit = looked[0].unit
    values = np.array([m.value for m in looked if m.unit == unit])
    values = values[np.isfinite(values)]
    value = float(np.median(values)) if len(values) else 0.0
    if unit == "" and 1.5 < value <= 100:
        yield f"a ratio of {value:.3g}: it is in percent, and 0 to 1 is wanted", {"value": value}
    elif unit == "Pa" and 300 < value < 1200:
        yield f"a pressure of {value:.5g} Pa: it is in hPa, and Pa is wanted (times 100)", {"value": value}
    elif unit == "Pa" and 30 < value < 120:
        yield f"a pressure of {value:.4g} Pa: it is in kPa, and Pa is wanted (times 1000)", {"value": value}
    elif unit == "°C" and 250 < value < 330:
        yield f"a temperature of {value:.4g} °C: is it in kelvin?", {"value": value}


def _encoded(looked: list[CompressedImage | CompressedDepth]) -> Iterator[Doubt]:
    """Files that cannot be decoded, such as JPEG files that are cut off."""
    broken, first = 0, ""
    for message in looked:
        try:
            decoded(message.data, message.format if isinstance(message, CompressedImage) else "png")
        except RecordingError as error:
            broken, first = broken + 1, first or f"at {message.stamp} {error}"
        except ModuleNotFoundError:  # OpenCV is of the perception extra
            return
    if broken:
        yield f"{broken:,} of {len(looked):,} images cannot be decoded, the first: {first}", {"images": broken}
