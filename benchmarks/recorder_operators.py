"""A source for the benchmark of the recorder: raw colour and depth images at 30 Hz by the clock."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping

import numpy as np

from dataflow.messages import DepthImage, Image, Message
from dataflow.operator import Out, Param, Source

PERIOD = 1 / 30


class Camera(Source):
    """Emits the images of a file again and again."""

    real_time = True
    image: Out[Image]
    depth: Out[DepthImage]
    file: str = Param(doc="what numpy.savez made of arrays `color` (N, H, W, 3) and `depth` (N, H, W)")
    count: int = Param(300, ge=1, doc="of each")

    def setup(self) -> None:
        with np.load(self.file) as loaded:
            self.color, self.distances = loaded["color"], loaded["depth"]

    def stream(self) -> Iterator[Mapping[str, Message]]:
        due = time.monotonic()
        for k in range(self.count):
            time.sleep(max(0.0, due - time.monotonic()))
            due += PERIOD
            stamp, n = time.time_ns(), k % len(self.color)
            yield {
                "image": Image(stamp=stamp, frame="camera", data=self.color[n]),
                "depth": DepthImage(stamp=stamp, frame="camera", data=self.distances[n]),
            }
