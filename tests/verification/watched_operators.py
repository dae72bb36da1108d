"""Operators that look around them when a variable of the environment asks for it."""

from __future__ import annotations

import os

import psutil
from kept_operators import Busy

from dataflow.messages import FeatureVector, Imu


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
