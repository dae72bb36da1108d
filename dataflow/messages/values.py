"""Single values: a number, a text, a switch, an alarm."""

from __future__ import annotations

from typing import Final

from dataflow.messages.base import ANCHOR, Message, scalar

ALARM_LEVELS: Final = ("debug", "info", "warning", "error", "fatal")


class Number(Message):
    """One number: a temperature, a distance, a score. NaN where it could not be had."""

    value: float = scalar("float", "the number, in `unit`")
    unit: str = scalar("str", "its unit, such as `°C` or `m/s`; empty for a pure number", default="")


class Measurement(Message):
    """One number that a sensor at a place has measured: a temperature, a pressure, an illuminance."""

    frame: str = scalar("str", "frame of the sensor", default=ANCHOR)
    value: float = scalar("float", "the number, in `unit`; NaN where it could not be measured")
    unit: str = scalar("str", "its unit, such as `°C`, `Pa` or `lx`; empty for a ratio", default="")
    variance: float | None = scalar(
        "float", "of the value, in the square of `unit`; None where not known", default=None
    )


class Text(Message):
    """One piece of text: a spoken command, a state's name, a line for people."""

    text: str = scalar("str", "the text")


class Switch(Message):
    """A thing that is on or off: a bumper, a door, an emergency stop, a condition that holds."""

    on: bool = scalar("bool", "whether it is on, pressed, closed or true")


class Alarm(Message):
    """Something that needs attention at once."""

    level: str = scalar("str", "how serious it is", choices=ALARM_LEVELS)
    name: str = scalar("str", "what it is about, such as `battery` or `camera/driver`")
    text: str = scalar("str", "one line for people: what is wrong, and what would help", default="")

    @property
    def severity(self) -> int:
        """The level as a number that grows with it: 0 for debug, 4 for fatal."""
        return ALARM_LEVELS.index(self.level)
