"""The health of devices, operators and the runtime."""

from __future__ import annotations

from enum import IntEnum

from dataflow.messages.arrays import I32, U8
from dataflow.messages.base import Message, array, scalar
from dataflow.messages.checks import parallel, within_length


class Level(IntEnum):
    """Severity of a status; the values of ROS's DiagnosticStatus."""

    OK = 0
    """works"""
    WARN = 1
    """works, and needs attention"""
    ERROR = 2
    """does not work"""
    STALE = 3
    """has not been heard of in time"""


class Diagnostics(Message):
    """A set of statuses, each with any number of key-value pairs.

    Pair k belongs to status `owners[k]`.
    """

    names: tuple[str, ...] = scalar("strs", "what each status is about, such as `camera/driver`")
    messages: tuple[str, ...] = scalar("strs", "one line of text per status")
    hardware_ids: tuple[str, ...] = scalar("strs", "device of each status, or empty", default=())
    keys: tuple[str, ...] = scalar("strs", "key of each pair", default=())
    values: tuple[str, ...] = scalar("strs", "value of each pair", default=())
    levels: U8 = array("uint8", "N", "`Level`: 0 ok, 1 warn, 2 error, 3 stale")
    owners: I32 | None = array("int32", "K", "status that each pair belongs to; None without pairs", default=None)

    def validate(self) -> None:
        count = len(self.levels)
        parallel(self, "names", count, "levels")
        parallel(self, "messages", count, "levels")
        parallel(self, "hardware_ids", count, "levels", empty=True)
        within_length(self, "levels", len(Level), "be a Level: 0 ok, 1 warn, 2 error, 3 stale")
        pairs = 0 if self.owners is None else len(self.owners)
        parallel(self, "keys", pairs, "owners")
        parallel(self, "values", pairs, "owners")
        within_length(self, "owners", count, f"index the {count} statuses")

    @property
    def count(self) -> int:
        """Number of statuses."""
        return len(self.levels)

    def pairs(self, status: int) -> dict[str, str]:
        """The key-value pairs of one status."""
        owners = [] if self.owners is None else self.owners.tolist()
        return {k: v for k, v, o in zip(self.keys, self.values, owners, strict=True) if o == status}
