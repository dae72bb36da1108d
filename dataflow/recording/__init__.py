"""Recordings: MCAP files that other tools open as they are, written safely and read back without loss."""

from dataflow.recording.diff import DiffReport, StreamDiff, diff
from dataflow.recording.entries import Event, RawRecord, Recorded
from dataflow.recording.errors import RecordingError
from dataflow.recording.facts import machine_facts
from dataflow.recording.foreign import ForeignDecoder, register_decoder
from dataflow.recording.info import Description, describe
from dataflow.recording.logs import LogLine
from dataflow.recording.reader import Recording
from dataflow.recording.streams import StreamInfo
from dataflow.recording.writer import RecordingWriter

__all__ = [
    "Description",
    "DiffReport",
    "Event",
    "ForeignDecoder",
    "LogLine",
    "RawRecord",
    "Recorded",
    "Recording",
    "RecordingError",
    "RecordingWriter",
    "StreamDiff",
    "StreamInfo",
    "describe",
    "diff",
    "machine_facts",
    "register_decoder",
]
