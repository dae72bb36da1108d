"""The operators of the recordings in this folder. They must go on making what they made: change nothing here."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from dataflow.messages import FeatureVector, Image, Imu, Message, Odometry, Transforms
from dataflow.operator import Batch, In, Operator, Out, Param, Sampled, Source

BEGIN = 1_700_000_000_000_000_000
MILLISECOND = 1_000_000


def features(stamp: int, *numbers: float) -> FeatureVector:
    """A message that holds a few numbers."""
    return FeatureVector(stamp=stamp, vectors=np.array([numbers], np.float32).reshape(1, -1), model="kept")


class Robot(Source):
    """Images, odometry with a covariance, inertial data, and a mounting that does not change."""

    image: Out[Image]
    odometry: Out[Odometry]
    imu: Out[Imu]
    mounting: Out[Transforms] = Out(static=True)
    steps: int = Param(150, ge=0, doc="steps of 10 ms")

    def static_outputs(self) -> Mapping[str, Message]:
        return {
            "mounting": Transforms(
                stamp=0,
                frames=("base",),
                child_frames=("camera",),
                translations=[[0.1, 0.0, 0.5]],
                rotations=[[0.0, 0.0, 0.0, 1.0]],
            )
        }

    def stream(self) -> Iterator[Mapping[str, Message]]:
        for k in range(self.steps):
            stamp = BEGIN + k * 10 * MILLISECOND
            angle = 0.02 * k
            step: dict[str, Message] = {
                "imu": Imu(
                    stamp=stamp, frame="base", angular_velocity=[0.0, 0.0, 2.0], linear_acceleration=[k, 0, 9.81]
                )
            }
            if k % 2 == 0:
                step["odometry"] = Odometry(
                    stamp=stamp,
                    frame="odom",
                    child_frame="base",
                    position=[0.01 * k, 0.0, 0.0],
                    orientation=[0.0, 0.0, np.sin(angle / 2), np.cos(angle / 2)],
                    pose_covariance=np.eye(6) * (k + 1) if k % 4 == 0 else None,
                )
            if k % 5 == 0:
                pixels = (np.arange(6 * 8 * 3, dtype=np.int64) * (k + 1) % 251).astype(np.uint8)
                step["image"] = Image(stamp=stamp, frame="camera", data=pixels.reshape(6, 8, 3))
            yield step

    def length(self) -> int:
        return self.steps


class Beacon(Source):
    """A second device, whose messages come a little beside the images."""

    signal: Out[FeatureVector]
    steps: int = Param(30, ge=0, doc="steps of 50 ms")

    def stream(self) -> Iterator[Mapping[str, Message]]:
        for k in range(self.steps):
            yield {"signal": features(BEGIN + (k * 50 + k % 3) * MILLISECOND, k)}

    def length(self) -> int:
        return self.steps


class Look(Operator, tolerance="5ms"):
    """Joins image and signal; samples odometry, mounting and its own past; gathers inertial data; draws numbers."""

    image: In[Image]
    signal: In[FeatureVector]
    odometry: Sampled[Odometry]
    mounting: Sampled[Transforms]
    before: Sampled[FeatureVector] = Sampled(before=True, required=False)
    imu: Batch[Imu]
    seen: Out[FeatureVector]

    def process(
        self,
        image: Image,
        signal: FeatureVector,
        odometry: Odometry,
        mounting: Transforms,
        before: FeatureVector | None,
        imu: tuple[Imu, ...],
    ) -> FeatureVector:
        return features(
            image.stamp,
            float(image.data.sum()),
            float(signal.vectors[0, 0]),
            float(odometry.position[0] + mounting.translations[0, 2]),
            0.0 if before is None else float(before.vectors[0, 0]),
            sum(float(m.linear_acceleration[0]) for m in imu),
            float(self.rng.integers(1000)),
        )


class Smooth(Operator, every="70ms"):
    """A running mean, on messages and on a timer; now and then it emits nothing."""

    x: In[FeatureVector]
    mean: Out[FeatureVector]
    weight: float = Param(0.25, ge=0, le=1, tunable=True, doc="of what comes")

    def setup(self) -> None:
        self.state, self.calls = 0.0, 0

    def process(self, x: FeatureVector | None, context) -> FeatureVector | None:
        self.calls += 1
        if x is not None:
            self.state += self.weight * (float(x.vectors[0, 0]) - self.state)
        return None if self.calls % 6 == 4 else features(context.stamp, self.state, self.calls, float(context.tick))

    def snapshot(self) -> Mapping[str, float]:
        return {"state": self.state, "calls": self.calls}

    def restore(self, state: Mapping[str, float]) -> None:
        self.state, self.calls = state["state"], int(state["calls"])


class Busy(Operator):
    """Falls behind when it is slowed down, and then gets only the newest."""

    x: In[Imu]
    y: Out[FeatureVector]

    def setup(self) -> None:
        self.calls = 0

    def process(self, x: Imu) -> FeatureVector:
        self.calls += 1
        return features(x.stamp, float(x.linear_acceleration[0]), self.calls)


class Tally(Operator, merge=True):
    """A sink that counts what it gets."""

    all: In[FeatureVector] = In(many=True)

    def setup(self) -> None:
        self.messages, self.total = 0, 0.0

    def process(self, all: Mapping[str, FeatureVector]) -> None:
        self.messages += len(all)
        self.total += sum(float(m.vectors[0, 0]) for m in all.values())

    def summary(self) -> Mapping[str, float]:
        return {"messages": self.messages, "total": self.total}
