"""Clips of made patterns, encoded packet by packet by PyAV, and what its FFmpeg decodes of them, called directly."""

from __future__ import annotations

from fractions import Fraction
from functools import cache
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

Pixels = NDArray[np.uint8]

ENCODERS = {"h264": "libx264", "h265": "libx265"}
_DECODERS = {"h264": "h264", "h265": "hevc"}
PERIOD = 40_000_000
"""Between two frames, ns."""


def pattern(number: int, width: int = 96, height: int = 64) -> Pixels:
    """Frame `number` of a pattern that moves: (H, W, 3), RGB."""
    y, x = np.mgrid[:height, :width]
    return np.stack([x + 3 * number, y + 2 * number, x * y // 16 + 5 * number], axis=-1).astype(np.uint8)


@cache
def clip(
    format_: str, count: int = 24, group: int = 8, options: str = "", pixels: str = "yuv420p", width: int = 96
) -> tuple[bytes, ...]:
    """Packets in Annex B form, a key frame every `group`. `options`: further ones of x264 or x265, `a=1:b=2`."""
    encoder = av.CodecContext.create(ENCODERS[format_], "w")
    encoder.width, encoder.height, encoder.pix_fmt, encoder.time_base = width, 64, pixels, Fraction(1, 25)
    encoder.gop_size, encoder.thread_count = group, 1
    plain = f"keyint={group}:min-keyint={group}:scenecut=0:bframes=0:rc-lookahead=0:repeat-headers=1:annexb=1"
    named = {"h264": "x264-params", "h265": "x265-params"}[format_]
    threads = "threads=1" if format_ == "h264" else "pools=1:frame-threads=1:log-level=none"
    encoder.options = {"preset": "ultrafast", named: ":".join(filter(None, [plain, threads, options]))}
    made: list[bytes] = []
    for number in range(count):
        frame = av.VideoFrame.from_ndarray(pattern(number, width), format="rgb24")
        frame.pts = number
        made += map(bytes, encoder.encode(frame))
    return (*made, *map(bytes, encoder.encode(None)))


def mp4(path: Path, codec: str, count: int = 20) -> Path:
    """Writes a file as LeRobot does, with B-frames where the codec has them."""
    options = {"libx264": {"bf": "2"}, "libx265": {"x265-params": "bframes=2:pools=1:log-level=none"}}
    with av.open(path, "w") as container:
        stream = container.add_stream(codec, rate=25, options=options.get(codec, {"preset": "10"}))
        stream.width, stream.height, stream.pix_fmt, stream.thread_count = 96, 64, "yuv420p", 1
        for number in range(count):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pattern(number), format="rgb24")))
        container.mux(stream.encode(None))
    return path


@cache
def decoded(format_: str, packets: tuple[bytes, ...]) -> tuple[Pixels, ...]:
    """The frames of packets, (H, W, 3), RGB, as PyAV's FFmpeg gives them."""
    decoder = av.CodecContext.create(_DECODERS[format_], "r")
    decoder.thread_count = 1
    frames = [frame for packet in packets for frame in decoder.decode(av.Packet(packet))]
    # by way of BGR, as OpenCV: the scaler's code for RGB rounds otherwise
    return tuple(f.to_ndarray(format="bgr24")[..., ::-1] for f in [*frames, *decoder.decode(None)])
