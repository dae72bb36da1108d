"""When operators fire: stamps, frontiers and the aligner. Pure: no clock, no thread, no I/O."""

from dataflow.sync.stamps import FOREVER, NEVER, format_duration, format_stamp, parse_duration

__all__ = ["FOREVER", "NEVER", "format_duration", "format_stamp", "parse_duration"]
