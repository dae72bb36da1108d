"""VectorNav's ASCII messages at pseudo-terminals and over loopback: damage is counted, an unplugged IMU comes back."""

from __future__ import annotations

import os
from functools import reduce
from pathlib import Path

import numpy as np
import pytest
from plugged import Cable, free_port, send_datagrams, while_opened

from dataflow.operator import SourceError
from operators.sources import VectorNavImu

REAL = (
    b"$VNIMU,-00.0350,+00.4222,-00.6643,-00.015,+00.019,+09.948,+00.002066,-00.008442,-00.044656,+20.7,+084.322*66\r\n"
)
"""A sensor's message, as an owner wrote it down."""


def message(body: str) -> bytes:
    return f"${body}*{reduce(lambda a, b: a ^ b, body.encode()):02X}\r\n".encode()


def imu(gyro: str = "+00.100,-00.200,+00.300") -> bytes:
    return message(f"VNIMU,+00.1,+00.2,-00.3,+01.000,-02.000,-09.800,{gyro},+25.5,+101.3")


def ymr(more: str = "") -> bytes:
    return message(f"VNYMR,+010.0,+000.1,-000.2,+00.1,+00.2,-00.3,+01.0,-02.0,-09.8,+00.1,-00.2,+00.3{more}")


def read(*chunks: bytes, **params: int | str) -> tuple[list, VectorNavImu]:
    source = VectorNavImu(input="udp://127.0.0.1:1", **params)
    source._open = lambda: os.open(os.devnull, os.O_RDONLY)
    source.setup()
    found = [step for k, data in enumerate(chunks) for step in source._take(data, 1000 * (k + 1))]
    source.close()
    return found, source


def test_a_sensors_own_message_is_read_in_si_units() -> None:
    [step], source = read(REAL)

    assert step["imu"].angular_velocity == pytest.approx([0.002066, -0.008442, -0.044656])
    assert step["imu"].linear_acceleration == pytest.approx([-0.015, 0.019, 9.948])
    assert step["imu"].temperature == 20.7
    assert step["field"].field == pytest.approx(np.array([-0.0350, 0.4222, -0.6643]) * 1e-4)
    assert source.summary()["bad_messages"] == 0


@pytest.mark.parametrize("more", ["", ",T1162704", ",S0004"])
def test_both_messages_give_the_same_sample_whatever_counter_ends_them(more: str) -> None:
    ((one,), _), ((other,), source) = read(imu()), read(ymr(more))

    for port, field in (("imu", "angular_velocity"), ("imu", "linear_acceleration"), ("field", "field")):
        assert getattr(one[port], field) == pytest.approx(getattr(other[port], field))
    assert other["imu"].temperature is None
    assert source.summary()["messages"] == "YMR 1"


@pytest.mark.parametrize(
    ("damage", "bad"),
    [
        (REAL.replace(b"*66", b"*67"), 1),
        (REAL.replace(b"9.948", b"9.949"), 1),
        (REAL[:40], 1),
        (b"\xfa\x01garbage\r\n", 0),
        (message("VNIMU,1,2,3"), 1),
        (imu("nan,0,0"), 1),
        (imu("+,0,0"), 1),
        (message("VNRRG,01,VN-100"), 0),
    ],
)
@pytest.mark.parametrize("step", [1, 13, 10**6])
def test_damage_costs_its_message_alone(damage: bytes, bad: int, step: int) -> None:
    data = imu() + damage + imu() + imu()
    found, source = read(*(data[k : k + step] for k in range(0, len(data), step)))

    assert len(found) == 3
    assert source.summary()["bad_messages"] == bad


def test_stamps_are_the_machines_clock_less_the_latency() -> None:
    first, second = imu()[:20], imu()[20:] + imu() + imu()
    found, source = read(first, second, latency="200ns")

    assert [step["imu"].stamp for step in found] == [800, 1800, 1801]
    assert all(step["imu"].stamp == step["field"].stamp for step in found)
    assert source.summary()["clock"] == "machine"


def test_an_imu_that_is_unplugged_goes_on_when_it_is_back(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    cable = Cable(tmp_path / "imu")
    source = VectorNavImu(input=str(cable.path))
    while_opened(
        source,
        [
            (cable.plug, lambda: cable.send(imu() + imu()[:30])),
            (bytes, bytes),  # it is not there yet
            (cable.plug, lambda: cable.send(imu()[30:] + imu("+00.5,0,0"))),
        ],
    )
    source.setup()
    steps = source.stream()
    first = next(steps)["imu"]
    cable.pull()
    second = next(steps)["imu"]
    source.stop_reading()

    assert list(steps) == []
    source.close()
    os.close(cable.end)
    assert first.angular_velocity[0] == 0.1
    assert second.angular_velocity[0] == 0.5
    assert source.summary() == {
        "clock": "machine", "messages": "IMU 2", "bad_messages": 1, "unplugged": 1,
    }  # fmt: skip
    assert ["is gone" in record.getMessage() for record in caplog.records if record.levelname == "WARNING"] == [True]


def test_datagrams_are_read() -> None:
    port = free_port()
    source = VectorNavImu(input=f"udp://127.0.0.1:{port}")
    source.setup()
    send_datagrams(port, b"", REAL)
    assert next(source.stream())["imu"].temperature == 20.7
    source.close()


@pytest.mark.parametrize(
    ("content", "finding"),
    [
        (message("VNYPR,+010.071,+000.278,-002.026") * 30, "no samples: the IMU sends YPR"),
        (REAL[:40] * 30, "29 of 29 messages are damaged: is the baud rate right"),
        (REAL * 30, ""),
        (b"", ""),
    ],
)
def test_an_imu_without_samples_is_explained(content: bytes, finding: str) -> None:
    _, source = read(content)

    assert finding in source.finding()
    assert bool(finding) == bool(source.finding())


def test_an_imu_that_is_not_there_at_the_start_is_an_error() -> None:
    with pytest.raises(SourceError, match=r"no IMU at 'none': No such file .* `dataflow devices`"):
        VectorNavImu(input="none").setup()
