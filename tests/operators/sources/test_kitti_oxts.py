"""Packets of inertial navigation in KITTI raw drives: made by hand, read as messages, written and read again."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dataflow.interop.export.kitti_oxts import packet_of
from dataflow.interop.export.kitti_raw import export_kitti_raw
from dataflow.interop.export.report import Exported
from dataflow.interop.export.source import ExportSource
from dataflow.messages import Imu, Message, NavSatFix, Odometry, PointCloud, Transforms
from dataflow.messages.geometry import quaternion_to_matrix
from dataflow.operator import SourceError
from dataflow.recording import RecordingWriter
from dataflow.testing import Played, play
from operators.sources import KittiRaw
from operators.sources.kitti_oxts import Packet, messages_of, read_packet

LEVEL = Packet(
    lat=49.0, lon=8.4, alt=116.0, roll=0.0, pitch=0.0, yaw=0.0,
    vn=0.0, ve=10.0, vf=10.0, vl=0.0, vu=0.0,
    ax=0.1, ay=0.2, az=9.81, af=0.1, al=0.2, au=9.81,
    wx=0.01, wy=0.02, wz=0.03, wf=0.01, wl=0.02, wu=0.03,
    pos_accuracy=0.5, vel_accuracy=0.1, navstat=4, numsats=9, posmode=6, velmode=6, orimode=6,
)  # fmt: skip
ORIGIN = (49.0, 8.4, 116.0)
SECOND = 1_000_000_000
BEGIN = 1_317_042_145 * SECOND
CALIBRATION = (
    "P_rect_02: 100 0 3 0 0 100 2 0 0 0 1 0\nR_rect_00: 1 0 0 0 1 0 0 0 1\n"
    "R_velo_to_cam: 0 -1 0 0 0 -1 1 0 0\nT_velo_to_cam: 0.1 -0.2 -0.3\n"
)


def messages(packet: Packet) -> tuple[Imu, NavSatFix, Odometry]:
    made = messages_of(packet, 5, origin=ORIGIN, frame="imu", odometry_frame="odom")
    imu, fix, odometry = made["imu"], made["fix"], made["odometry"]
    assert isinstance(imu, Imu)
    assert isinstance(fix, NavSatFix)
    assert isinstance(odometry, Odometry)
    return imu, fix, odometry


def drive(folder: Path, packets: list[Packet], *, frames: int = 3, times: list[str] | None = None) -> Path:
    """A drive of frames 100 ms apart, its packets 20 ms after them unless `times` says otherwise."""
    for place in ("image_02/data", "velodyne_points/data", "oxts/data"):
        (folder / place).mkdir(parents=True)
    for k in range(frames):
        cv2.imwrite(str(folder / f"image_02/data/{k:010d}.png"), np.full((4, 6, 3), k, np.uint8))
        (folder / f"velodyne_points/data/{k:010d}.bin").write_bytes(np.ones((2, 4), np.float32).tobytes())
    for k, packet in enumerate(packets):
        (folder / f"oxts/data/{k:010d}.txt").write_text(" ".join(map(str, packet)))
    lines = [f"2011-09-26 13:02:25.{k}00000000" for k in range(frames)]
    (folder / "velodyne_points/timestamps.txt").write_text("\n".join(lines))
    stamped = [f"2011-09-26 13:02:25.{k}20000000" for k in range(len(packets))] if times is None else times
    (folder / "oxts/timestamps.txt").write_text("\n".join(stamped))
    (folder / "calib.txt").write_text(CALIBRATION)
    return folder


def offsets(played: Played, port: str) -> list[int]:
    """Milliseconds since the first frame."""
    return [(m.stamp - BEGIN) // 1_000_000 for m in played[port]]


def test_a_packet_is_a_reading_a_position_and_an_odometry() -> None:
    imu, fix, odometry = messages(LEVEL._replace(yaw=np.pi / 2, ve=0.0, vn=10.0))

    assert imu.angular_velocity.tolist() == [0.01, 0.02, 0.03]
    assert imu.linear_acceleration.tolist() == [0.1, 0.2, 9.81]
    assert imu.orientation is not None
    np.testing.assert_allclose(quaternion_to_matrix(imu.orientation) @ [1, 0, 0], [0, 1, 0], atol=1e-15)  # looks north
    assert (fix.latitude, fix.longitude, fix.altitude, fix.status, fix.satellites) == (49.0, 8.4, 116.0, "rtk_fixed", 9)
    assert fix.covariance is not None
    assert fix.covariance.tolist() == (np.eye(3) * 0.25).tolist()
    assert odometry.linear is not None
    np.testing.assert_allclose(odometry.linear, [10, 0, 0], atol=1e-12)
    assert (odometry.frame, odometry.child_frame) == ("odom", "imu")


def test_roll_lifts_the_left_side_and_pitch_lowers_the_front() -> None:
    rolled = LEVEL._replace(roll=0.1).R_enu_imu
    pitched = LEVEL._replace(pitch=0.1).R_enu_imu
    assert (rolled @ [0, 1, 0])[2] == pytest.approx(np.sin(0.1))
    assert (pitched @ [1, 0, 0])[2] == pytest.approx(-np.sin(0.1))


def test_the_odometry_counts_metres_east_north_and_up_from_its_origin() -> None:
    north = messages(LEVEL._replace(lat=49.001, alt=117.0))[2].position
    east = messages(LEVEL._replace(lon=8.401))[2].position
    np.testing.assert_allclose(north, [0, 111.2, 1.0], atol=0.05)  # a degree of latitude is 111.2 km there
    np.testing.assert_allclose(east, [73.17, 0, 0], atol=0.05)  # and one of longitude 73.2 km


def test_packets_come_at_their_own_times_between_the_frames(tmp_path: Path) -> None:
    played = play(KittiRaw(path=str(drive(tmp_path, [LEVEL] * 3))))
    assert offsets(played, "points") == [0, 100, 200]
    assert offsets(played, "imu") == offsets(played, "fix") == offsets(played, "odometry") == [20, 120, 220]


def test_a_part_of_a_drive_has_the_packets_of_its_frames_from_the_origin_of_the_whole(tmp_path: Path) -> None:
    packets = [LEVEL._replace(lat=49.0 + k * 1e-4) for k in range(5)]
    folder = drive(tmp_path, packets, frames=5)
    part = play(KittiRaw(path=str(folder), start=1, stop=4, stride=2))
    assert offsets(part, "points") == [100, 300]
    assert offsets(part, "imu") == [120, 220]
    assert part["odometry"][0].position[1] == pytest.approx(11.12, abs=0.01)


def test_a_drive_without_times_has_its_packets_with_their_frames(tmp_path: Path) -> None:
    folder = drive(tmp_path, [LEVEL] * 3)
    (folder / "oxts/timestamps.txt").unlink()
    (folder / "velodyne_points/timestamps.txt").unlink()
    played = play(KittiRaw(path=str(folder), first_stamp=BEGIN, rate=10.0))
    assert offsets(played, "imu") == offsets(played, "points") == [0, 100, 200]


def test_the_place_of_the_unit_is_known_where_its_file_is(tmp_path: Path) -> None:
    folder = drive(tmp_path, [LEVEL] * 3)
    assert play(KittiRaw(path=str(folder)))["imu_extrinsics"] == []
    (folder / "calib_imu_to_velo.txt").write_text("R: 1 0 0 0 1 0 0 0 1\nT: -0.8 0.3 -0.8\n")
    (placed,) = play(KittiRaw(path=str(folder)))["imu_extrinsics"]
    assert isinstance(placed, Transforms)
    assert (placed.frames, placed.child_frames) == (("imu",), ("velodyne",))
    np.testing.assert_allclose(placed.translations, [[0.8, -0.3, 0.8]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 2 3", "has 3 numbers; 30 expected: lat, lon, alt"),
        (" ".join(map(str, LEVEL)).replace("9.81", "up"), "az is 'up', no number"),
        (" ".join(map(str, LEVEL._replace(yaw=float("nan")))), "yaw is nan; expected a finite number"),
        (" ".join(map(str, LEVEL._replace(lat=91.0))), "no latitude and longitude"),
    ],
)
def test_a_packet_that_cannot_be_read_names_its_file_and_number(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "0000000000.txt"
    file.write_text(text)
    with pytest.raises(SourceError, match=message) as caught:
        read_packet(file)
    assert str(file) in str(caught.value)


def test_fewer_times_than_packets_are_refused(tmp_path: Path) -> None:
    folder = drive(tmp_path, [LEVEL] * 3, times=["2011-09-26 13:02:25.0"])
    with pytest.raises(SourceError, match="has 1 lines for 3 packets"):
        KittiRaw(path=str(folder)).setup()


ANGLE = st.floats(-1.5, 1.5)


@given(ANGLE, ANGLE, st.floats(-3.1, 3.1), st.lists(st.floats(-20, 20), min_size=9, max_size=9))
def test_a_packet_of_messages_is_the_packet_that_they_came_from(
    roll: float, pitch: float, yaw: float, values: list[float]
) -> None:
    level = np.array([[np.cos(yaw), np.sin(yaw), 0], [-np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    velocity, acceleration, rate = (np.array(values[k : k + 3]) for k in (0, 3, 6))
    turned = LEVEL._replace(roll=roll, pitch=pitch, yaw=yaw)
    tilt = level @ turned.R_enu_imu
    (vf, vl, vu), (af, al, au), (wf, wl, wu) = level @ velocity, tilt @ acceleration, tilt @ rate
    packet = turned._replace(
        ve=velocity[0], vn=velocity[1], vu=vu, vf=vf, vl=vl, af=af, al=al, au=au, wf=wf, wl=wl, wu=wu,
        ax=acceleration[0], ay=acceleration[1], az=acceleration[2], wx=rate[0], wy=rate[1], wz=rate[2],
    )  # fmt: skip
    again = Packet(*packet_of(*messages(packet)))
    np.testing.assert_allclose(again[:24], packet[:24], atol=1e-9)
    assert (again.numsats, again.posmode) == (9, 6)


def recorded(path: Path, packets: list[Packet], *without: str) -> Path:
    """A recording of scans with packets 5 ms after them, as a graph of KittiRaw would leave it."""
    streams: dict[str, list[Message]] = {"points": [], "imu": [], "fix": [], "odometry": []}
    for k, packet in enumerate(packets):
        stamp = BEGIN + k * SECOND // 10
        streams["points"].append(PointCloud(stamp=stamp, frame="velodyne", points=np.ones((3, 3), np.float32)))
        made = messages_of(packet, stamp + 5_000_000, origin=ORIGIN, frame="imu", odometry_frame="odom")
        for name, message in made.items():
            streams[name].append(message)
    T = np.eye(4)
    T[:3, 3] = 0.8, -0.3, 0.8
    streams["tf"] = [Transforms.from_matrix(T, stamp=0, frame="imu", child_frame="velodyne")]
    with RecordingWriter(path, metadata={}) as writer:
        for name, listed in streams.items():
            if name not in without:
                writer.add_stream(name, type(listed[0]), static=name == "tf")
                for seq, message in enumerate(listed):
                    writer.write(name, message, seq=seq)
    return path


def exported(path: Path, out: Path) -> tuple[Path, Exported]:
    done = Exported()
    with ExportSource(path) as material:
        export_kitti_raw(material, out, done)
    return out / "2011_09_26/2011_09_26_drive_0001_sync", done


def test_a_recording_becomes_a_drive_whose_packets_read_as_its_messages(tmp_path: Path) -> None:
    packets = [LEVEL._replace(yaw=0.1 * k, lat=49.0 + k * 1e-5) for k in range(4)]
    path = recorded(tmp_path / "a.mcap", packets)
    folder, done = exported(path, tmp_path / "out")

    (folder / "image_02").mkdir()
    for k in range(4):
        cv2.imwrite(str(folder / f"image_02/{k:010d}.png"), np.zeros((4, 6, 3), np.uint8))
    (folder / "calib.txt").write_text(CALIBRATION)
    played = play(KittiRaw(path=str(folder)))
    with ExportSource(path) as material:
        for port in ("imu", "fix", "odometry"):
            before = [recorded.message for recorded in material.messages([port])]
            assert [m.stamp for m in played[port]] == [m.stamp for m in before]
            for one, other in zip(played[port], before, strict=True):
                for field in type(one).FIELDS:
                    a, b = getattr(one, field.name), getattr(other, field.name)
                    assert a == b if isinstance(a, str | int | None) else np.allclose(a, b, atol=1e-9), field.name
    assert played["imu_extrinsics"][0].translations.round(9).tolist() == [[0.8, -0.3, 0.8]]
    assert done.left_out == {}


@pytest.mark.parametrize(
    ("without", "reason"),
    [
        ("imu", "there is no stream of Imu"),
        ("fix", "there is no stream of NavSatFix"),
        ("odometry", "there is no stream of Odometry"),
    ],
)
def test_oxts_are_left_out_without_a_required_stream(tmp_path: Path, without: str, reason: str) -> None:
    folder, done = exported(recorded(tmp_path / "a.mcap", [LEVEL] * 3, without), tmp_path / "out")
    assert reason in done.left_out["oxts"]
    assert not (folder / "oxts").exists()


def test_unit_without_extrinsics_is_exported_without_calibration(tmp_path: Path) -> None:
    folder, done = exported(recorded(tmp_path / "a.mcap", [LEVEL] * 3, "tf"), tmp_path / "out")
    assert (folder / "oxts/data/0000000002.txt").is_file()
    assert set(done.left_out) == {"calib_imu_to_velo.txt"}
