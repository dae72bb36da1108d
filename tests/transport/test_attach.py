"""Attaching to a running graph waits for what its processes hold, and for nothing else."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from transport_envelopes import carrying

from dataflow.client import attach
from dataflow.graph import load_text
from dataflow.messages import DepthImage
from dataflow.transport import Bus, RunningGraph, TapServer, encode

INFO = "robot1/camera/info"


def test_tap_starts_with_existing_statics_without_waiting_for_others(
    open_bus: Callable[..., Bus], endpoint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The time allowed is longer than the test's: a wait for something that never comes would not end."""
    monkeypatch.setattr(attach, "CONNECT_WITHIN", 1000.0)
    process = open_bus(listen=(endpoint,))
    graph = load_text("graph: robot\noperators: {camera: {use: operators.sources:SyntheticRgbd}}")
    found = RunningGraph("robot", "robot1", 1, 0.0, (endpoint,), 0.0, graph.to_json())
    with TapServer(process, "robot1"):
        with attach.tap(found, ["**"]) as client:
            assert client.take(0.0) is None
        image = DepthImage(stamp=3, frame="camera", data=np.zeros((2, 2), np.float32))
        process.declare_static(INFO, encode(carrying(image, INFO, 0)))
        for _ in range(10):
            with attach.tap(found, ["**"]) as client:
                taken = client.take(0.0)
            assert taken is not None
            assert taken.stream == INFO
