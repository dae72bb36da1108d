"""Velodyne packets written here, from a capture and over loopback: clouds have the sensor's geometry and times."""

from __future__ import annotations

import math
import struct
import sys
from pathlib import Path

import numpy as np
import pytest
from plugged import free_port, send_datagrams

from dataflow.messages import PointCloud
from dataflow.operator import SourceError
from dataflow.testing import play
from operators.sources import VelodyneFile, VelodyneLidar, ports
from operators.sources.velodyne import _has_points

START = 1_700_000_000
"""Seconds, 800 s after a full hour."""
DELAY = 0.0003
"""Seconds from a packet's first firing to its capture."""
EVERY = 0.00132710
"""Seconds between packets of a VLP-16, by its manual: 24 firings of 55.296 µs."""
ELEVATIONS = range(-15, 16, 2)
"""Degrees of a VLP-16's lasers, by its manual."""
WALL = 10.0

need = pytest.mark.skipif(
    "velodyne_decoder" not in sys.modules and not __import__("importlib").util.find_spec("velodyne_decoder"),
    reason="needs the extra [lidar]",
)


def packet(number: int, distance: float = WALL) -> bytes:
    """A packet of a VLP-16 at 10 turns a second, 2 mm units: a sphere around it; reflectivity is the laser's number."""
    returns = b"".join(struct.pack("<HB", round(distance / 0.002), laser % 16) for laser in range(32))
    azimuth = 48 * 10 * number
    blocks = b"".join(struct.pack("<HH", 0xEEFF, (azimuth + 40 * k) % 36000) + returns for k in range(12))
    return blocks + struct.pack("<IBB", 800_000_000 + round(number * EVERY * 1e6), 0x37, 0x22)


def capture(path: Path, packets: list[bytes], cut: int = 0) -> Path:
    """Writes a pcap of UDP datagrams, stamped from START on; the last `cut` bytes are missing."""
    rows = [struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1)]
    for k, data in enumerate(packets):
        udp = struct.pack(">HHHH", 2368, 2368, 8 + len(data), 0) + data
        ip = struct.pack(">BBHHHBBH4s4s", 0x45, 0, 20 + len(udp), 0, 0, 64, 17, 0, b"\xc0\xa8\x01\xc9", b"\xff" * 4)
        frame = b"\xff" * 6 + b"\x02" * 6 + b"\x08\x00" + ip + udp
        seconds, micros = divmod(round((START + DELAY + k * EVERY) * 1e6), 10**6)
        rows.append(struct.pack("<IIII", seconds, micros, len(frame), len(frame)) + frame)
    whole = b"".join(rows)
    path.write_bytes(whole[: len(whole) - cut])
    return path


@need
def test_clouds_of_a_capture_have_the_sensors_geometry_and_times(tmp_path: Path) -> None:
    turns = [packet(k) for k in range(230)]  # 75 a turn
    source = VelodyneFile(input=str(capture(tmp_path / "a.pcap", [*turns[:100], bytes(512), *turns[100:]])))
    clouds = play(source)["cloud"]

    assert len(clouds) == 4  # three turns and the rest
    cloud = clouds[1]
    assert isinstance(cloud, PointCloud)
    assert cloud.rings is not None
    assert cloud.intensities is not None
    assert cloud.time_offsets is not None
    assert np.linalg.norm(cloud.points, axis=1) == pytest.approx(WALL, abs=0.02)
    elevation = np.degrees(np.arctan2(cloud.points[:, 2], np.hypot(cloud.points[:, 0], cloud.points[:, 1])))
    for ring, degrees in enumerate(ELEVATIONS):
        assert elevation[cloud.rings == ring] == pytest.approx(degrees, abs=0.1)
    heading = np.unwrap(np.arctan2(cloud.points[:, 1], cloud.points[:, 0])[cloud.rings == 0])
    assert heading[-1] - heading[0] == pytest.approx(-2 * math.pi, abs=0.02)  # clockwise from above
    assert set(cloud.intensities) == set(range(16))
    assert np.ptp(cloud.time_offsets) == pytest.approx(75 * EVERY, abs=2 * EVERY)
    assert clouds[2].stamp - cloud.stamp == pytest.approx(75 * EVERY * 1e9, abs=2e3)
    assert source.summary() == {"clock": "arrival", "packets": 230, "other_datagrams": 1, "past": 0}


@need
def test_the_sensors_clock_gives_the_time_within_the_hour(tmp_path: Path) -> None:
    file = str(capture(tmp_path / "a.pcap", [packet(k) for k in range(160)]))
    arrived, sensed = (play(VelodyneFile(input=file, clock=clock))["cloud"] for clock in ("arrival", "sensor"))

    assert START % 3600 == 800
    for a, b in zip(arrived, sensed, strict=True):
        assert a.stamp - b.stamp == pytest.approx(DELAY * 1e9, abs=2e3)


@need
def test_a_capture_that_breaks_off_or_is_damaged_is_a_finding(tmp_path: Path) -> None:
    whole = capture(tmp_path / "a.pcap", [packet(k) for k in range(160)])
    data, record = whole.read_bytes(), 16 + 42 + 1206
    for name, content, why in (
        ("cut", data[:-600], f"breaks off at byte {24 + 159 * record}, in a record of 1248 bytes, after 159 packets"),
        ("head", data[: 24 + 100 * record + 7], "in a record's header, after 100 packets"),
        ("mid", data[: 24 + 100 * record] + b"\xff" * 3000 + data[24 + 100 * record + 3000 :], "is damaged from byte"),
    ):
        (tmp_path / f"{name}.pcap").write_bytes(content)
        source = VelodyneFile(input=str(tmp_path / f"{name}.pcap"))
        assert len(play(source)["cloud"]) == (2 if name != "cut" else 3)
        assert why in source.finding()
    source = VelodyneFile(input=str(whole))
    play(source)
    assert source.finding() == ""


@need
@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"\n\r\r\n" + bytes(100), "editcap -F pcap"),
        (b"\x1f\x8b" + bytes(100), "gunzip"),
        (b"", "is no capture of packets"),
        (b"no capture at all, but a longer text than a header", "is no capture of packets"),
    ],
)
def test_a_file_that_is_no_capture_is_named(content: bytes, words: str, tmp_path: Path) -> None:
    (tmp_path / "a.pcap").write_bytes(content)
    with pytest.raises(Exception, match=words):
        play(VelodyneFile(input=str(tmp_path / "a.pcap")))


@need
def test_packets_of_all_blocks_are_taken_for_packets_with_points() -> None:
    """A VLS-128 marks its four banks of lasers EE, DD, CC, BB."""
    blocks = b"".join(bytes([0xFF, 0xEE - 0x11 * (k % 4)]) + bytes(98) for k in range(12))
    assert _has_points(blocks + bytes(6))
    assert not _has_points(bytes(100) + blocks[100:] + bytes(6))


@need
def test_datagrams_of_anybody_are_counted_and_end_nothing(tmp_path: Path) -> None:
    random = np.random.default_rng(3)
    junk = (
        [random.bytes(1206) for _ in range(50)]
        + [packet(7)[:-1] + bytes([model]) for model in (70, 0x99)]
        + [b"\xff\xee" * 603, b"\xff" * 1206, bytes(1206), b""]
    )
    turns = [packet(k) for k in range(160)]
    source = VelodyneFile(input=str(capture(tmp_path / "a.pcap", [*junk, *turns, *junk])))

    clouds = play(source)["cloud"]

    alone = play(VelodyneFile(input=str(capture(tmp_path / "c.pcap", turns))))["cloud"]
    assert [len(c.points) for c in clouds] == [len(c.points) for c in alone]
    assert source.summary()["packets"] == 160
    assert source.summary()["other_datagrams"] == 2 * len(junk) - 2  # those without bytes are silence
    assert play(VelodyneFile(input=str(capture(tmp_path / "b.pcap", junk))))["cloud"] == []


@need
def test_packets_of_another_sensors_model_are_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """The decoder takes one model; which one, is decided anew after a silence."""
    turns, other = [packet(k) for k in range(160)], packet(7)[:-1] + bytes([0x28])
    alone = play(VelodyneFile(input=str(capture(tmp_path / "a.pcap", turns))))["cloud"]
    mixed = VelodyneFile(input=str(capture(tmp_path / "b.pcap", [*turns[:50], other, *turns[50:], other])))
    before = VelodyneFile(input=str(capture(tmp_path / "c.pcap", [other, *[b""] * 400, *turns])))

    clouds = play(mixed)["cloud"]

    assert [len(c.points) for c in clouds] == [len(c.points) for c in alone]
    assert (mixed.summary()["packets"], mixed.summary()["other_datagrams"]) == (160, 2)
    assert caplog.text.count("packets of model 40 are left out: those before are of model 34") == 1
    assert len(play(before)["cloud"]) == len(alone)


@need
def test_a_lidar_over_udp_is_read_and_its_silence_drops_the_turn(caplog: pytest.LogCaptureFixture) -> None:
    source = VelodyneLidar(input="udp://127.0.0.1:2368")
    times = iter([*((START * 10**9 + round(k * EVERY * 1e9), packet(k)) for k in range(100))])
    later = ((START + 60) * 10**9 + round(k * EVERY * 1e9) for k in range(200))
    source.setup()
    source.close()
    steps: list[tuple[int, bytes | None]] = [*times, ((START + 1) * 10**9, None), ((START + 2) * 10**9, None)]
    steps += [(arrival, packet(k)) for k, arrival in enumerate(later)]

    def read(port: int) -> tuple[bytes | None, int]:
        arrival, data = steps.pop(0)
        if not steps:
            source.stop_reading()
        return data, arrival

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("operators.sources.velodyne.read_port", read)
        clouds = [step["cloud"] for step in source.stream()]

    assert [cloud.stamp // 10**9 - START for cloud in clouds] == [0, 60, 60, 60]
    assert all(np.ptp(cloud.time_offsets) < 0.11 for cloud in clouds)
    assert source.summary()["unplugged"] == 1
    assert [r.getMessage() for r in caplog.records] == [
        "no packets from the LiDAR at udp://127.0.0.1:2368: it is waited for"
    ]


def over_loopback() -> tuple[VelodyneLidar, int]:
    port = free_port()
    source = VelodyneLidar(input=f"udp://127.0.0.1:{port}")
    source.setup()
    return source, port


@need
def test_datagrams_of_loopback_become_clouds() -> None:
    source, port = over_loopback()
    send_datagrams(port, *(packet(k) for k in range(90)), b"position")
    cloud = next(source.stream())["cloud"]
    source.close()

    assert isinstance(cloud, PointCloud)
    assert np.linalg.norm(cloud.points, axis=1) == pytest.approx(WALL, abs=0.02)


@need
@pytest.mark.parametrize("buffer", [ports.BUFFER, 0])
def test_packets_wait_for_a_late_graph_and_those_without_room_are_counted(
    buffer: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ports, "BUFFER", buffer)
    source, port = over_loopback()
    send_datagrams(port, *(packet(k) for k in range(150)))
    kept = 0
    while ports.read_port(source._port)[0] is not None:
        kept += 1
    lost = source.summary()["lost_datagrams"]
    source.close()

    assert kept == 150 if buffer else 0 < kept < 150
    assert lost == source.summary()["lost_datagrams"] == 150 - kept


def test_without_the_package_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "velodyne_decoder", None)
    with pytest.raises(SourceError, match=r"need the package velodyne_decoder: pip install 'robot-dataflow\[lidar\]'"):
        VelodyneFile(input=str(capture(tmp_path / "a.pcap", []))).setup()


@need
def test_a_capture_without_a_packet_is_a_finding(tmp_path: Path) -> None:
    source = VelodyneFile(input=str(capture(tmp_path / "none.pcap", [])))
    source.setup()

    assert list(source.stream()) == []
    assert source.finding() == "none.pcap holds no packet"
