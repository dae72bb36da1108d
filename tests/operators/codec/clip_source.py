"""A source of packets of made clips, for graphs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from made_video import PERIOD, clip

from dataflow.messages import CompressedVideo, Message
from dataflow.operator import Out, Param, Source


class ClipSource(Source):
    """Gives the packets of a made clip, but some that are lost."""

    video: Out[CompressedVideo] = Out(doc="packets")

    format: str = Param("h264", doc="h264 or h265")
    lost: list[int] = Param([], doc="numbers of packets that are left out")
    later: int = Param(0, doc="frames by which all are later")

    def stream(self) -> Iterator[Mapping[str, Message]]:
        for number, message in enumerate(messages(self.format)):
            if number not in self.lost:
                yield {"video": message.replace(stamp=message.stamp + self.later * PERIOD)}


def messages(format_: str) -> list[CompressedVideo]:
    """A clip of 24 frames, a key frame every 8, from 1 s on."""
    return [
        CompressedVideo(stamp=10**9 + k * PERIOD, frame="cam", format=format_, data=np.frombuffer(packet, np.uint8))
        for k, packet in enumerate(clip(format_))
    ]
