"""The wire of rmw_zenoh, byte for byte: a vector made by hand from its sources, and the bytes of a real Humble peer."""

from __future__ import annotations

from pathlib import Path

import pytest

from dataflow.ros.wire import Attachment, End, Node, Qos, WireError, absolute, gid_of

SCAN = End(
    Node(42, "9ca0f8", "/robot/_hidden", "lidar"),
    "7",
    "MP",
    "/robot/_hidden/scan",
    "sensor_msgs/msg/LaserScan",
    "RIHS01_64c1",
    Qos(reliable=False, transient_local=True, keep_all=True, depth=3),
)
KEY = "42/robot/_hidden/scan/sensor_msgs::msg::dds_::LaserScan_/RIHS01_64c1"
TOKEN = (
    "@ros2_lv/42/9ca0f8/0/7/MP/%/%robot%_hidden/lidar/%robot%_hidden%scan/sensor_msgs::msg::dds_::LaserScan_/"
    "RIHS01_64c1/2:1:2,3:,:,:,,"
)


def test_a_publisher_is_written_and_read() -> None:
    assert SCAN.key == KEY
    assert SCAN.token == TOKEN
    assert End.decoded(TOKEN) == SCAN
    assert SCAN.node.token() == "@ros2_lv/42/9ca0f8/0/0/NN/%/%robot%_hidden/lidar"
    assert SCAN.node.full_name == "/robot/_hidden/lidar"


@pytest.mark.parametrize(
    ("qos", "text"),
    [
        (Qos(), "::,:,:,:,,"),
        (Qos(depth=5), "::,5:,:,:,,"),
        (Qos(reliable=False), "2::,:,:,:,,"),
        (Qos(transient_local=True, depth=1), ":1:,1:,:,:,,"),
        (Qos(keep_all=True), "::2,:,:,:,,"),
    ],
)
def test_defaults_stand_empty(qos: Qos, text: str) -> None:
    assert qos.encoded() == text
    assert Qos.decoded(text) == qos


def test_an_attachment_is_33_bytes_little_endian() -> None:
    data = bytes.fromhex("0700000000000000" + "00808c4d5c6ef017" + "10" + "2a" * 16)
    assert Attachment.decoded(data) == (7, 0x17F06E5C4D8C8000, b"\x2a" * 16)
    assert Attachment(7, 0x17F06E5C4D8C8000, b"\x2a" * 16).encoded() == data


@pytest.mark.parametrize("data", [b"", b"\0" * 32, b"\0" * 33, bytes(16) + b"\x0f" + bytes(15)])
def test_other_attachments_are_refused(data: bytes) -> None:
    with pytest.raises(WireError, match="33"):
        Attachment.decoded(data)


@pytest.mark.parametrize(
    "token", ["", "@ros2_lv/0/a/0/0/NN/%/%/talker", TOKEN.replace("42", "x"), TOKEN[:-8], "a/" * 12]
)
def test_other_tokens_are_refused(token: str) -> None:
    with pytest.raises(WireError):
        End.decoded(token)


def test_unknown_token_parts_of_later_versions_are_ignored() -> None:
    assert End.decoded(f"{TOKEN}/cpu:") == SCAN


def test_a_relative_name_lies_in_the_namespace() -> None:
    assert absolute("scan", "/robot") == "/robot/scan"
    assert absolute("scan", "/") == "/scan"
    assert absolute("/scan", "/robot") == "/scan"


@pytest.fixture
def captured(data_dir: Path) -> Path:
    folder = data_dir / "rmw_zenoh"
    if not folder.is_dir():
        pytest.skip(f"no captured bytes of rmw_zenoh: no folder {folder}")
    return folder


@pytest.mark.data
def test_the_bytes_of_a_real_humble_publisher_are_read_and_written_alike(captured: Path) -> None:
    token = (captured / "liveliness-token-real-humble.txt").read_text().strip()
    attachment = bytes.fromhex((captured / "attachment-real-humble.hex").read_text())

    end, seen = End.decoded(token), Attachment.decoded(attachment)

    assert (end.topic, end.type, end.qos) == ("/chatter", "std_msgs/msg/String", Qos(transient_local=True, depth=1))
    assert end.token == token
    assert seen.encoded() == attachment
    assert seen.gid == end.gid == gid_of(token)  # both are of one publisher
    assert end.key == (captured / "data-keys.txt").read_text().splitlines()[0]
    parts = (captured / "qos-components.txt").read_text().split()
    assert [Qos.decoded(text).encoded() for text in parts] == parts
    assert [Qos.decoded(text).depth for text in parts] == [1, 7]
