"""Two cameras that encode, their key frames apart, and one that counts their packets."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from made_video import PERIOD, clip

from dataflow.messages import CompressedVideo, Message, Number
from dataflow.operator import In, Operator, Out, Source

FIRST = 10**9


class Cameras(Source):
    front: Out[CompressedVideo]
    rear: Out[CompressedVideo]

    def stream(self) -> Iterator[Mapping[str, Message]]:
        clips = {"front": clip("h264", count=48, group=8), "rear": clip("h264", count=48, group=5)}
        for k in range(48):
            yield {
                name: CompressedVideo(
                    stamp=FIRST + k * PERIOD, frame=name, format="h264", data=np.frombuffer(packets[k], np.uint8)
                )
                for name, packets in clips.items()
            }


class Bytes(Operator):
    stateless = True
    video: In[CompressedVideo]
    size: Out[Number]

    def process(self, video: CompressedVideo) -> Number:
        return Number(stamp=video.stamp, value=float(video.data.nbytes))
