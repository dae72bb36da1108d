"""What a bus that cannot be opened says."""

from __future__ import annotations

import pytest

from dataflow.transport import Bus, BusError, NetworkConfig


def test_reasons_name_no_file_of_a_library() -> None:
    with pytest.raises(BusError) as raised:
        Bus(NetworkConfig(connect=("tcp/127.0.0.1:1",), zenoh={"mode": "client", "connect/timeout_ms": 100}))
    assert "cannot connect to tcp/127.0.0.1:1" in str(raised.value)
    assert ".rs:" not in str(raised.value)
