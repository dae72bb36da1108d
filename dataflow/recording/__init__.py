"""Recordings: MCAP files that other tools open as they are, written safely and read back without loss."""

from dataflow.recording.errors import RecordingError
from dataflow.recording.streams.diff import DiffReport, StreamDiff, diff
from dataflow.recording.streams.entries import Event, RawRecord, Recorded
from dataflow.recording.streams.facts import machine_facts
from dataflow.recording.streams.foreign import ForeignDecoder, register_decoder
from dataflow.recording.streams.info import Description, describe
from dataflow.recording.streams.logs import LogLine
from dataflow.recording.streams.reader import Recording
from dataflow.recording.streams.streams import StreamInfo
from dataflow.recording.streams.writer import RecordingWriter

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
