"""CPU time that the journal of effects takes of a firing: digests of arguments, the answer packed and back, the record.

python benchmarks/effects.py [--firings N]

Each operator is run twice on the same messages, once through `self.effect` and once calling directly; the call itself
takes no time. Prints the difference for a firing, the median of five runs, and its share of one with a call of 100 ms.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from dataflow.messages import FeatureVector, Image
from dataflow.operator import In, Operator, Out
from dataflow.records.firing import encode_batch
from dataflow.testing import play

CALL_NS = 100_000_000


def answer(*question: Any) -> Any:
    return ANSWER[0]


ANSWER: list[Any] = [None]


class Asks(Operator):
    """Asks about an image."""

    image: In[Image]
    out: Out[FeatureVector]
    question: Callable[[Image], Sequence[Any]]
    direct = False

    def process(self, image: Image) -> FeatureVector:
        given = self.question(image)
        answer(*given) if self.direct else self.effect(answer, *given)
        return FeatureVector(stamp=image.stamp, vectors=np.zeros((1, 1), np.float32), model="none")


CASES: dict[str, tuple[Callable[[Image], Sequence[Any]], Any]] = {
    "a prompt of 1 kB, 1 kB of text": (lambda image: ("x" * 1024,), "y" * 1024),
    "an image message of 640x480, 1 kB of text": (lambda image: (image, "what is this?"), "y" * 1024),
    "its 0.9 MB as an array, 1 kB of text": (lambda image: (image.data,), "y" * 1024),
    "a prompt, 1.2 MB of depth": (lambda image: ("depth",), np.ones((480, 640), np.float32)),
    "a prompt, 16 MB of numbers": (lambda image: ("all",), np.ones(4_000_000, np.float32)),
}


def cpu(question: Callable[[Image], Sequence[Any]], images: list[Image], *, direct: bool) -> float:
    """CPU time (ns) of a firing, its record encoded."""
    asks = Asks()
    asks.question, asks.direct = question, direct
    begin = time.thread_time_ns()
    played = play(asks, {"image": images}, paranoid=False)
    for record in played.records:
        encode_batch([record])
    return (time.thread_time_ns() - begin) / len(images)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--firings", type=int, default=50)
    firings = parser.parse_args().firings
    pixels = np.zeros((480, 640, 3), np.uint8)
    images = [Image(stamp=k + 1, frame="camera", data=pixels) for k in range(firings)]
    print("| arguments and answer | CPU time | of a firing with a call of 100 ms |\n| --- | ---: | ---: |")
    for name, (question, given) in CASES.items():
        ANSWER[0] = given
        cpu(question, images, direct=False)
        costs = [cpu(question, images, direct=False) - cpu(question, images, direct=True) for _ in range(5)]
        cost = statistics.median(costs)
        print(f"| {name} | {cost / 1e6:.3f} ms | {cost / CALL_NS:.2%} |")


if __name__ == "__main__":
    main()
