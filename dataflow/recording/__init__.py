"""Recordings: MCAP files that other tools open as they are, written safely and read back without loss."""

from dataflow.recording.codecs import ForeignDecoder, register_decoder
from dataflow.recording.errors import RecordingError
from dataflow.recording.reader import Event, RawRecord, Recorded, Recording, StreamInfo
from dataflow.recording.writer import RecordingWriter

__all__ = [
    "Event",
    "ForeignDecoder",
    "RawRecord",
    "Recorded",
    "Recording",
    "RecordingError",
    "RecordingWriter",
    "StreamInfo",
    "register_decoder",
]
