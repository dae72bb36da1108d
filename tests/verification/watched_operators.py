"""Operators that look around them when a variable of the environment asks for it."""

from __future__ import annotations

import os

import psutil
from kept_operators import BEGIN, MILLISECOND, Busy, Look

from dataflow.messages import FeatureVector, Image, Imu, Odometry, Transforms


class Portless(Busy):
    """Fails when any process of the verification has a network connection open, of whatever kind."""

    def process(self, x: Imu) -> FeatureVector:
        if self.calls % 50 == 20 and (parent := os.environ.get("DATAFLOW_TEST_NO_NETWORK")):
            for process in [psutil.Process(int(parent)), *psutil.Process(int(parent)).children(recursive=True)]:
                if found := process.net_connections(kind="inet"):
                    raise RuntimeError(f"{process.pid} is connected: {found}")
        return super().process(x)


class Fatal(Busy):
    """Takes its process with it at its tenth call."""

    def process(self, x: Imu) -> FeatureVector:
        made = super().process(x)
        if self.calls == 10:
            os._exit(7)
        return made


class Alone(Look):
    """`Look`, which has no state, when it says so."""

    stateless = True


class Moody(Alone):
    """Sees something else in one image."""

    def process(
        self,
        image: Image,
        signal: FeatureVector,
        odometry: Odometry,
        mounting: Transforms,
        before: FeatureVector | None,
        imu: tuple[Imu, ...],
    ) -> FeatureVector:
        if image.stamp == BEGIN + 1_000 * MILLISECOND:
            image = image.replace(data=255 - image.data)
        return super().process(image, signal, odometry, mounting, before, imu)


class Forgetful(Alone):
    """Says that it has no state, and has one: what it gives follows the number of its calls."""

    def setup(self) -> None:
        self.calls = 0

    def process(
        self,
        image: Image,
        signal: FeatureVector,
        odometry: Odometry,
        mounting: Transforms,
        before: FeatureVector | None,
        imu: tuple[Imu, ...],
    ) -> FeatureVector:
        self.calls += 1
        seen = super().process(image, signal, odometry, mounting, before, imu)
        first = BEGIN + (self.calls - 1) * 50 * MILLISECOND == image.stamp  # as it was from the first image on
        return seen if first else seen.replace(vectors=seen.vectors + 1)
