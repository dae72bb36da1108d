"""CPU time of decoding video packet by packet.

python benchmarks/video.py
"""

from __future__ import annotations

import time
from fractions import Fraction
from typing import Any

import av
import numpy as np

from dataflow.video.decoder import PacketDecoder

FRAMES, GROUP = 60, 30
ENCODERS = {
    "h264": ("libx264", {"preset": "ultrafast", "tune": "zerolatency"}),
    "h265": (
        "libx265",
        {
            "preset": "ultrafast",
            "x265-params": f"bframes=0:rc-lookahead=0:repeat-headers=1:annexb=1:keyint={GROUP}:pools=1:frame-threads=1"
            ":log-level=none",
        },
    ),
}


def packets(format_: str, width: int, height: int) -> list[bytes]:
    """A pattern of squares that moves across the image, at 6 Mbit/s and 30 Hz."""
    codec, options = ENCODERS[format_]
    encoder: Any = av.CodecContext.create(codec, "w")
    encoder.width, encoder.height, encoder.pix_fmt, encoder.time_base = width, height, "yuv420p", Fraction(1, 30)
    encoder.gop_size, encoder.thread_count, encoder.bit_rate, encoder.options = GROUP, 1, 6_000_000, options
    squares = np.random.default_rng(0).integers(0, 255, (height // 8 + 20, width // 8 + 20, 3))
    large = np.kron(squares, np.ones((8, 8, 1))).astype(np.uint8)
    made: list[bytes] = []
    for k in range(FRAMES):
        part = np.ascontiguousarray(large[k : k + height, 2 * k : 2 * k + width])
        frame = av.VideoFrame.from_ndarray(part, format="rgb24")
        frame.pts = k
        made += map(bytes, encoder.encode(frame))
    return [*made, *map(bytes, encoder.encode(None))]


def main() -> None:
    """Prints the CPU time of the first packet and the mean of the others."""
    for format_ in ENCODERS:
        for width, height in ((1280, 720), (1920, 1080)):
            sent = packets(format_, width, height)
            decoder = PacketDecoder(format_)
            begin = time.process_time()
            decoder.decode(sent[0])
            first = time.process_time() - begin
            begin = time.process_time()
            shown = [decoder.decode(packet) for packet in sent[1:]]
            each = (time.process_time() - begin) / len(shown)
            assert all(frame is not None for frame in shown), decoder.lost
            decoder.close()
            size = sum(map(len, sent)) // len(sent)
            times = f"{each * 1e3:.1f} ms a packet of {size:,} bytes, first {first * 1e3:.0f} ms"
            print(f"{format_} {width}x{height}: {times}")


if __name__ == "__main__":
    main()
