"""Decoding packet by packet: the pixels of FFmpeg called directly, and no frame where packets are lost."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing

import numpy as np
import pytest
from made_video import PERIOD, clip, decoded

from dataflow.video.bits import VideoError
from dataflow.video.decoder import PacketDecoder, is_key

FORMATS = pytest.mark.parametrize("format_", ["h264", "h265"])
WAYS = [
    ("h264", "", "yuv420p"),
    ("h264", "slices=4:ref=4:cabac=1", "yuv420p"),
    ("h264", "cqm=jvt:8x8dct=1:nal-hrd=vbr:vbv-maxrate=500:vbv-bufsize=500", "yuv420p"),
    ("h264", "sar=4\\:3:colorprim=bt709:transfer=bt709:colormatrix=bt709:range=tv:chromaloc=1", "yuv420p"),
    ("h264", "ref=3", "yuv444p"),
    ("h264", "qp=0", "yuv420p"),
    ("h265", "", "yuv420p"),
    ("h265", "ref=4:slices=2:aud=1", "yuv420p"),
    ("h265", "scaling-list=default:sao=1:amp=1:rect=1:sar=4\\:3:hrd=1:vbv-maxrate=500:vbv-bufsize=500", "yuv420p"),
    ("h265", "open-gop=1:ref=3", "yuv420p"),
    ("h265", "tskip=1:cu-lossless=1:weightp=1:max-merge=2", "yuv420p"),
]
Made = Callable[..., PacketDecoder]


@pytest.fixture
def made() -> Iterator[Made]:
    """Decoders, which are closed at the end."""
    with ExitStack() as stack:
        yield lambda *given, **options: stack.enter_context(closing(PacketDecoder(*given, **options)))


@pytest.mark.parametrize(("format_", "options", "pixels"), WAYS)
def test_each_packet_gives_the_pixels_of_ffmpeg_called_directly(
    made: Made, format_: str, options: str, pixels: str
) -> None:
    packets = clip(format_, options=options, pixels=pixels)
    expected = decoded(format_, packets)
    decoder = made(format_)
    assert len(packets) == len(expected) == 24
    for packet, frame in zip(packets, expected, strict=True):
        assert np.array_equal(decoder.decode(packet), frame)


def test_pictures_of_10_bits_are_scaled_to_8(made: Made) -> None:
    packets = clip("h265", pixels="yuv420p10le")
    decoder = made("h265")
    for packet, frame in zip(packets, decoded("h265", packets), strict=True):
        pixels = decoder.decode(packet)
        assert pixels is not None
        assert np.abs(pixels.astype(int) - frame).mean() < 2  # the two scale colours by other filters


@FORMATS
def test_frames_are_the_same_from_any_key_frame(made: Made, format_: str) -> None:
    packets = clip(format_, options="open-gop=1")
    keys = [k for k, packet in enumerate(packets) if is_key(format_, packet)]
    assert keys == [0, 8, 16]
    for key in keys:
        decoder = made(format_)
        for packet, frame in zip(packets[key:], decoded(format_, packets)[key:], strict=True):
            assert np.array_equal(decoder.decode(packet), frame)


@FORMATS
@pytest.mark.parametrize("options", ["", "ref=4"])
@pytest.mark.parametrize("lost", [0, 1, 5, 8, 10, 23])
def test_no_frame_is_given_after_a_lost_packet_until_a_key_frame(
    made: Made, format_: str, options: str, lost: int
) -> None:
    packets = clip(format_, options=options)
    expected = decoded(format_, packets)
    decoder = made(format_)
    for k, packet in enumerate(packets):
        if k == lost:
            continue
        frame = decoder.decode(packet)
        behind = lost < k < 8 * (lost // 8 + 1)
        assert (frame is None) == behind == bool(decoder.lost)
        if frame is not None:
            assert np.array_equal(frame, expected[k])


@pytest.mark.parametrize("count", [15, 16, 17, 32])
def test_a_loss_of_all_numbers_shows_in_the_stamps(made: Made, count: int) -> None:
    packets = clip("h264", count=48, group=48)
    expected = decoded("h264", packets)
    decoder = made("h264")
    for k in range(10):
        decoder.decode(packets[k], k * PERIOD + k % 2 * 1_000_000)
    assert decoder.decode(packets[10 + count], (10 + count) * PERIOD) is None
    assert decoder.lost.startswith("frame" if count in (15, 17) else "a pause as long as that of 10 pictures")
    decoder.decode(packets[0], 0)
    for k in range(1, 14):  # a pause in which nothing is lost, and no key frame can be: ten pictures have followed it
        frame = decoder.decode(packets[k], k * PERIOD + (k > 9) * 9 * PERIOD)
        assert np.array_equal(frame, expected[k])


@pytest.mark.parametrize(
    ("format_", "options", "group", "lost"),
    [
        ("h264", "", 50, range(50, 51)),  # the number is that of the last picture
        ("h264", "", 34, range(34, 35)),
        ("h264", "", 18, range(18, 19)),
        ("h264", "", 17, range(17, 18)),  # and here the one that follows it
        ("h264", "", 33, range(33, 34)),
        ("h264", "", 8, range(5, 13)),  # a whole group, so that every number fits
        ("h264", "", 24, range(3, 27)),
        ("h265", "open-gop=0", 8, range(5, 13)),
        ("h265", "open-gop=0", 24, range(3, 27)),
    ],
)
def test_a_lost_key_frame_shows_in_the_stamps(made: Made, format_: str, options: str, group: int, lost: range) -> None:
    packets = clip(format_, count=2 * group + 2, group=group, options=options)
    expected = decoded(format_, packets)
    decoder = made(format_)
    for k, packet in enumerate(packets):
        if k not in lost:
            frame = decoder.decode(packet, k * PERIOD + k % 2 * PERIOD // 10)
            assert (frame is None) == (lost.stop <= k < 2 * group), decoder.lost
            assert frame is None or np.array_equal(frame, expected[k])


@FORMATS
@pytest.mark.parametrize("twice", [0, 3, 7, 8])
def test_a_packet_that_comes_twice_gives_its_frame_twice(made: Made, format_: str, twice: int) -> None:
    packets = clip(format_)
    decoder = made(format_)
    for k, (packet, frame) in enumerate(zip(packets, decoded(format_, packets), strict=True)):
        for _ in range(1 + (k == twice)):
            assert np.array_equal(decoder.decode(packet, k * PERIOD), frame)


@FORMATS
def test_a_loss_is_named_by_its_pictures(format_: str) -> None:
    packets = clip(format_)
    decoder = PacketDecoder(format_)
    assert decoder.decode(packets[3]) is None
    assert "SPS, PPS" in decoder.lost
    for packet in (packets[0], packets[1], packets[3]):
        decoder.decode(packet)
    named = {"h264": "frame 3 follows frame 1", "h265": "picture 3 refers to 2"}
    assert decoder.lost.startswith(named[format_])
    first = decoder.lost
    decoder.decode(packets[4])
    assert decoder.lost == first


@FORMATS
@pytest.mark.parametrize("at", [0, 3, 8, 13])
def test_decoder_continues_from_the_state_of_another(made: Made, format_: str, at: int) -> None:
    packets = clip(format_)
    one, other = made(format_), made(format_)
    for packet in packets[: at + 1]:
        one.decode(packet)
    other.take_up(one.state())
    for packet in packets[at + 1 :]:
        assert np.array_equal(one.decode(packet), other.decode(packet))
        assert one.state() == other.state()


def test_a_state_while_pictures_are_lost_keeps_the_reason(made: Made) -> None:
    packets = clip("h264")
    one, other = made("h264"), made("h264")
    for packet in (packets[0], packets[2]):
        one.decode(packet)
    other.take_up(one.state())
    assert other.decode(packets[3]) is None
    assert other.lost == one.lost != ""
    assert other.decode(packets[8]) is not None


@FORMATS
def test_a_key_frame_without_parameter_sets_takes_those_that_came_before(made: Made, format_: str) -> None:
    packets = list(clip(format_))
    sets, key = packets[8][: packets[8].rfind(b"\0\0\1")], packets[8][packets[8].rfind(b"\0\0\1") :]
    assert is_key(format_, sets + key)
    assert not is_key(format_, key)
    packets[8] = key
    one, other = made(format_), made(format_)
    expected = decoded(format_, clip(format_))
    for k in range(12):
        assert np.array_equal(one.decode(packets[k]), expected[k])
    other.take_up(one.state())
    assert np.array_equal(other.decode(packets[12]), expected[12])


@FORMATS
def test_stream_continues_with_frames_of_another_size(made: Made, format_: str) -> None:
    small, large = clip(format_), clip(format_, width=128)
    decoder = made(format_)
    for packet, frame in zip(
        (*small[:9], *large), (*decoded(format_, small)[:9], *decoded(format_, large)), strict=True
    ):
        assert np.array_equal(decoder.decode(packet), frame)


@FORMATS
def test_a_stream_with_reordered_pictures_is_refused(format_: str) -> None:
    packets = clip(format_, options="bframes=2:b-adapt=0:rc-lookahead=5")
    with pytest.raises(VideoError, match=r"order .* encode it without B-frames"):
        PacketDecoder(format_).decode(packets[0])


@FORMATS
def test_pictures_that_are_too_large_are_refused_before_they_are_decoded(format_: str) -> None:
    with pytest.raises(VideoError, match="6144 pixels, more than max_pixels=6000"):
        PacketDecoder(format_, max_pixels=6000).decode(clip(format_)[0])


@FORMATS
def test_a_damaged_packet_never_ends_in_more_than_a_lost_picture(made: Made, format_: str) -> None:
    packets, rng = clip(format_), np.random.default_rng(0)
    decoder = made(format_)
    decoder.decode(packets[0])
    for _ in range(6):
        for packet in packets[:4]:
            damaged = bytearray(packet)
            for place in rng.integers(0, len(damaged), 3):
                damaged[place] = int(rng.integers(256))
            frame = decoder.decode(bytes(damaged)[: int(rng.integers(4, len(damaged) + 1))])
            assert (frame is None) == bool(decoder.lost)
    for packet, expected in zip(packets[8:12], decoded(format_, packets)[8:12], strict=True):
        assert np.array_equal(decoder.decode(packet), expected)


@pytest.mark.long
@FORMATS
@pytest.mark.parametrize("number", [8, 9])
def test_a_flipped_bit_of_a_header_is_a_lost_picture_whatever_it_announces(
    made: Made, format_: str, number: int
) -> None:
    packets = clip(format_)
    decoder, reasons = made(format_), ""
    for bit in range(8 * 3, 8 * 34):  # of the first parameter set, or of the slice
        damaged = bytearray(packets[number])
        damaged[bit // 8] ^= 1 << bit % 8
        decoder.decode(packets[8 * (number - 8)])
        frame = decoder.decode(bytes(damaged))
        assert (frame is None) == bool(decoder.lost)
        reasons += decoder.lost
    if format_ == "h264":
        assert "B-frames" in reasons
    for packet, expected in zip(packets[16:20], decoded(format_, packets)[16:20], strict=True):
        assert np.array_equal(decoder.decode(packet), expected)


def test_parameter_sets_of_a_damaged_packet_are_forgotten(made: Made) -> None:
    packets = list(clip("h264"))
    decoder = made("h264", max_pixels=7000)
    decoder.decode(packets[0])
    large = clip("h264", width=128)[0]
    assert decoder.decode(large) is None
    assert "8192 pixels, more than max_pixels=7000" in decoder.lost
    key = packets[8][packets[8].rfind(b"\0\0\1") :]
    assert np.array_equal(decoder.decode(key), decoded("h264", tuple(packets))[8])
