"""OpenCV's decoder of H.264 and H.265, fed from memory packet by packet.

`cv2.VideoCapture` reads a file. Here the file is a Matroska stream in memory that is written while it is read: the
capture runs on a separate thread and stands still wherever it wants bytes that have not come. So the frames of a packet
are those that it has given when it asks for more, however the threads are scheduled; FFmpeg decodes with one thread.
"""

from __future__ import annotations

import io
import struct
import threading
import weakref
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dataflow.video.bits import VideoError

_TURN, _TURNS = 0.5, 120
"""Seconds, and how often they pass, in which the decoder takes a packet: a machine that pauses loses one turn."""
_OPENING = 40
"""Repetitions of a key frame at most, before OpenCV gives its frames; it takes 8 for H.264, 1 for H.265."""
_CODECS = {"h264": b"V_MPEG4/ISO/AVC", "h265": b"V_MPEGH/ISO/HEVC"}
_UNKNOWN_SIZE = b"\x01" + 7 * b"\xff"
_FRAME = 33_333_333
"""Duration of a frame that the stream states, ns. FFmpeg looks at more packets where none is stated."""


class Capture:
    """A decoder that begins with a key frame. `close` it, or let go of it. `first`: the pixels of the key frame.

    Raises `VideoError` where OpenCV cannot decode the stream.
    """

    def __init__(self, format_: str, key: bytes) -> None:
        """`format_`: h264 or h265; `key`: a packet with a key frame and its parameter sets."""
        self._pipe = _Pipe()
        self._count = 0
        self._thread = threading.Thread(target=_run, args=(self._pipe,), name="video decoder", daemon=True)
        self._thread.start()
        self._end = weakref.finalize(self, _end, self._pipe, self._thread)
        self._pipe.feed(_head(_CODECS[format_]))
        # OpenCV decodes some packets on trial before it gives the first frame: those are this one, again and again.
        for _ in range(_OPENING):
            if frames := self.feed(key):
                self.first = frames[-1]
                return
        self.close()
        raise VideoError(f"OpenCV's FFmpeg gives no frame of this {format_} stream")

    def feed(self, packet: bytes) -> list[NDArray[np.uint8]]:
        """Returns the frames (H, W, 3), BGR, that the decoder gives before it asks for another packet.

        Raises `VideoError` where it ends, TimeoutError where it takes no packet for a minute.
        """
        frames = self._pipe.feed(_cluster(packet, self._count))
        self._count += 1
        return frames

    def close(self) -> None:
        """Ends the decoder. Idempotent."""
        self._end()


def _end(pipe: _Pipe, thread: threading.Thread) -> None:
    """Ends the stream and waits for the thread, which must not be in OpenCV when the interpreter ends."""
    pipe.end()
    if thread is not threading.current_thread():
        thread.join(_TURN * _TURNS)


def _run(pipe: _Pipe) -> None:
    """Reads frames until the stream ends; on the decoder's thread."""
    import cv2

    try:
        options = [cv2.CAP_PROP_N_THREADS, 1, cv2.CAP_PROP_HW_ACCELERATION, cv2.VIDEO_ACCELERATION_NONE]
        source: Any = pipe  # OpenCV takes any io.BufferedIOBase, its stubs a class that is not there
        capture = cv2.VideoCapture(source, cv2.CAP_FFMPEG, options)
        while True:
            read, frame = capture.read()
            if not read:
                break
            pipe.give(np.asarray(frame, np.uint8))
        capture.release()
    except cv2.error as error:
        pipe.failed = str(error)
    finally:
        pipe.end()


class _Pipe(io.BufferedIOBase):
    """The bytes between the two threads. OpenCV takes an exception for an address: no method that it calls raises."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._bytes = bytearray()
        self._frames: list[NDArray[np.uint8]] = []
        self._asks = False
        self._ended = False
        self.failed = ""

    def feed(self, data: bytes) -> list[NDArray[np.uint8]]:
        """Gives bytes to the reader; returns its frames as soon as it asks for more."""
        with self._changed:
            self._bytes += data
            self._asks = False
            self._changed.notify_all()
            if not any(self._changed.wait_for(lambda: self._asks or self._ended, _TURN) for _ in range(_TURNS)):
                raise TimeoutError(f"OpenCV's video decoder has not taken a packet in {_TURN * _TURNS:g} s")
            if self._ended:
                raise VideoError(f"OpenCV's FFmpeg cannot decode this stream{': ' * bool(self.failed)}{self.failed}")
            frames, self._frames = self._frames, []
            return frames

    def give(self, frame: NDArray[np.uint8]) -> None:
        """Takes a frame."""
        with self._changed:
            self._frames.append(frame)

    def end(self) -> None:
        """Ends the stream for both sides."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def read(self, size: int | None = -1, /) -> bytes:
        """Waits for bytes; the end of the stream is an empty answer."""
        with self._changed:
            while not self._bytes and not self._ended:
                self._asks = True
                self._changed.notify_all()
                self._changed.wait(_TURN)
            if self._ended:
                return b""
            found = bytes(self._bytes[:size])
            del self._bytes[:size]
            return found

    def seek(self, offset: int, whence: int = 0, /) -> int:
        """Returns -1: it has no positions."""
        return -1

    def readable(self) -> bool:
        return True


def _head(codec: bytes) -> bytes:
    """The beginning of a Matroska stream with one video track (RFC 9559)."""
    kind = _element("1A45DFA3", _element("4282", b"matroska") + _element("4287", b"\4") + _element("4285", b"\2"))
    information = _element("1549A966", _element("2AD7B1", (10**9).to_bytes(4, "big")))  # times are seconds
    duration = _element("23E383", _FRAME.to_bytes(4, "big"))
    numbers = _element("D7", b"\1") + _element("73C5", b"\1") + _element("83", b"\1") + duration
    size = _element("E0", _element("B0", b"\x10") + _element("BA", b"\x10"))  # replaced by that of the packets
    track = _element("1654AE6B", _element("AE", numbers + _element("86", codec) + size))
    room = _element("EC", bytes(4096))  # a file is recognised by its first 2 kB
    return kind + bytes.fromhex("18538067") + _UNKNOWN_SIZE + information + track + room


def _cluster(packet: bytes, seconds: int) -> bytes:
    """One packet, at a time."""
    time = _element("E7", seconds.to_bytes(8, "big"))
    return _element("1F43B675", time + _element("A3", b"\x81\0\0\x80" + packet))


def _element(number: str, body: bytes) -> bytes:
    return bytes.fromhex(number) + struct.pack(">Q", 1 << 56 | len(body)) + body
