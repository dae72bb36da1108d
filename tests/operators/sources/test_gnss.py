"""NMEA 0183 at pseudo-terminals, over loopback and in files: damage is counted, an unplugged receiver comes back."""

from __future__ import annotations

import math
import os
from datetime import UTC, datetime
from functools import reduce
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plugged import Cable, free_port, send_datagrams, while_opened

from dataflow.messages import NavSatFix
from dataflow.operator import SourceError
from dataflow.testing import play
from operators.sources import NmeaFile, NmeaGnss
from operators.sources.nmea import LONGEST, Clock, Receiver


def sentence(body: str) -> bytes:
    return f"${body}*{reduce(lambda a, b: a ^ b, body.encode()):02X}\r\n".encode()


def gga(time: str, quality: int = 1, place: str = "4807.038,N,01131.000,E", dilution: str = "0.9") -> bytes:
    return sentence(f"GPGGA,{time},{place},{quality},08,{dilution},545.4,M,46.9,M,,")


def rmc(time: str, date: str = "230394") -> bytes:
    return sentence(f"GPRMC,{time},A,4807.038,N,01131.000,E,022.4,084.4,{date},003.1,W")


def utc(*when: int) -> int:
    return int(datetime(*when, tzinfo=UTC).timestamp()) * 10**9


def read(data: bytes, clock: Clock = "receiver", step: int = 10**9) -> tuple[list[NavSatFix], Receiver]:
    receiver = Receiver("antenna", clock, 4.0)
    found = [
        fix for k in range(0, len(data), step) for fix in receiver.feed(data[k : k + step], 1000 * (k // step + 1))
    ]
    return found, receiver


def test_a_position_has_the_numbers_of_its_sentence() -> None:
    [fix], receiver = read(rmc("123519") + gga("123519.25"))

    assert fix.stamp == utc(1994, 3, 23, 12, 35, 19) + 250_000_000
    assert (fix.frame, fix.status, fix.satellites) == ("antenna", "fix", 8)
    assert fix.latitude == pytest.approx(48 + 7.038 / 60, abs=1e-12)
    assert fix.longitude == pytest.approx(11 + 31 / 60, abs=1e-12)
    assert fix.altitude == pytest.approx(545.4 + 46.9)  # above the ellipsoid: NMEA gives it above the geoid
    assert fix.covariance_type == "approximated"
    assert fix.covariance is not None
    assert np.sqrt(np.diag(fix.covariance)) == pytest.approx([3.6, 3.6, 7.2])
    assert receiver.bad == 0


def test_south_and_west_are_negative() -> None:
    [fix], _ = read(rmc("000000") + gga("000000", place="3351.5,S,07030.0,W"))

    assert fix.latitude == pytest.approx(-(33 + 51.5 / 60))
    assert fix.longitude == pytest.approx(-70.5)


@pytest.mark.parametrize(
    ("quality", "status"),
    [(0, "no_fix"), (1, "fix"), (2, "sbas"), (4, "rtk_fixed"), (5, "rtk_float"), (6, "no_fix"), (8, "no_fix")],
)
def test_the_quality_is_the_status(quality: int, status: str) -> None:
    [fix], _ = read(rmc("000000") + gga("000000", quality))

    assert fix.status == status
    assert math.isnan(fix.latitude) == (status == "no_fix")
    assert (fix.covariance is None) == (status not in ("fix", "sbas"))  # dilution does not fit kinematics


def test_errors_of_gst_hold_for_its_moment_only() -> None:
    gst = sentence("GPGST,120000,0.01,0.02,0.01,0,0.03,0.02,0.05")
    near, far = read(rmc("120000") + gst + gga("120000", 4) + gga("120010", 4))[0]

    assert near.covariance_type == "diagonal_known"
    assert near.covariance is not None
    assert np.sqrt(np.diag(near.covariance)) == pytest.approx([0.02, 0.03, 0.05])  # east, north, up
    assert far.covariance is None


def test_positions_without_an_altitude_or_a_time_are_taken() -> None:
    [fix], receiver = read(sentence("GNGGA,,,,,,0,00,99.99,,,,,,"), "machine")

    assert (fix.status, fix.stamp, receiver.bad) == ("no_fix", 1000, 0)


def test_the_date_follows_midnight_before_its_sentence() -> None:
    found, _ = read(rmc("235959") + gga("235959") + gga("000000") + rmc("000000", "240394") + gga("000001"))

    start = utc(1994, 3, 23, 23, 59, 59)
    assert [fix.stamp - start for fix in found] == [0, 10**9, 2 * 10**9]


def test_positions_before_the_first_date_and_repeated_ones_are_left_out() -> None:
    found, receiver = read(gga("120000") + rmc("120001") + gga("120001") + gga("120001"))

    assert len(found) == 1
    assert receiver.undated == 1


GOOD = gga("120000")


@pytest.mark.parametrize(
    ("damage", "bad"),
    [
        (b"\x00\xffgarbage*00\r\n\r\n", 0),  # between sentences
        (GOOD[:-5], 1),  # cut off before its checksum
        (GOOD[:20], 1),
        (GOOD[:20] + b"\r\n", 1),
        (GOOD.replace(b"545", b"546"), 1),  # a wrong checksum
        (GOOD[:20] + b"\xb5\x62" + GOOD[20:], 1),  # binary within
        (b"$" + b"A" * 1000 + b"*41\r\n", 1),  # no end
        (b"$GPGGA,120000*zz\r\n", 1),
        (b"$$$", 3),
        (gga("250000"), 1),  # a right checksum over nonsense
        (gga("120000", place="9907.038,N,01131.000,E"), 1),
        (gga("120000", place="4861.0,N,01131.000,E"), 1),
        (gga("120000", dilution="nan"), 1),
        (sentence("GPGGA,120000"), 1),
        (sentence("GPGGA,999999.99,9999.0,Q,nan,E,inf,-8,1e999,nan,M,,M,,"), 1),
        (sentence("GPGGA,120000,,,,,E,,,,M,,M,,"), 1),
        (sentence("GPGGA,120000,,,,,0,-8,,,M,,M,,"), 1),
        (sentence("GPGGA,999999,,,,,0,00,,,M,,M,,"), 1),
        (rmc("120000", "320394"), 1),
        (rmc("120000", "2303945"), 1),
        (sentence("PUBX,00,120000"), 0),  # proprietary
        (sentence("PUBX," + "1" * LONGEST), 1),  # too long
    ],
)
@pytest.mark.parametrize("step", [1, 7, 10**9])
def test_damage_costs_its_sentence_alone(damage: bytes, bad: int, step: int) -> None:
    found, receiver = read(gga("115959") + damage + gga("120001") + gga("120002"), "machine", step)

    assert [fix.status for fix in found] == ["fix"] * 3
    assert receiver.bad == bad


@settings(max_examples=100, deadline=None)
@given(
    st.lists(
        st.one_of(
            st.binary(max_size=60),
            st.sampled_from([b"$", b"*", b"$GPGGA,", GOOD[:30], GOOD, rmc("120000")]),
            st.text(st.sampled_from("GPRMCAST0123456789.,-NEVM"), max_size=60).map(lambda t: sentence("GPGGA," + t)),
            st.lists(st.text(st.sampled_from("0129.-A"), max_size=9)).map(lambda t: sentence(",".join(["GNRMC", *t]))),
            st.lists(st.text(st.sampled_from("0129.-"), max_size=9)).map(lambda t: sentence(",".join(["GNGST", *t]))),
        ),
        max_size=12,
    ).map(b"".join),
    st.integers(1, 80),
)  # fmt: skip
def test_any_bytes_in_any_chunks_give_the_same_and_never_an_exception(data: bytes, step: int) -> None:
    whole, first = read(data)
    parts, second = read(data, step=step)

    assert [fix.digest() for fix in whole] == [fix.digest() for fix in parts]
    assert (first.bad, first.kinds, first.undated) == (second.bad, second.kinds, second.undated)
    assert all(a.stamp != b.stamp for a, b in pairwise(whole))


def test_a_sentence_is_stamped_when_its_first_byte_came() -> None:
    receiver = Receiver("antenna", "machine", 4.0)

    assert not list(receiver.feed(b"noise" + GOOD[:10], 100))
    assert not list(receiver.feed(GOOD[10:30], 200))
    stamps = [fix.stamp for fix in receiver.feed(GOOD[30:] + GOOD + GOOD, 300)]
    assert stamps == [100, 300, 301]


def test_buffer_of_an_endless_sentence_is_bounded() -> None:
    receiver = Receiver("antenna", "machine", 4.0)
    for _ in range(100):
        assert not list(receiver.feed(b"$" + b"A" * 1000, 0))
        assert len(receiver._sentences._held) <= LONGEST


def test_a_log_gives_the_same_bits_and_its_figures(tmp_path: Path) -> None:
    log = tmp_path / "drive.nmea"
    log.write_bytes(b"".join(rmc(f"1200{s:02}") + gga(f"1200{s:02}.5") for s in range(60)) + GOOD[:9])
    source = NmeaFile(input=str(log))
    first, second = play(source), play(NmeaFile(input=str(log)))

    assert first.digests() == second.digests()
    assert [m.stamp for m in first["fix"]] == [utc(1994, 3, 23, 12, 0, s) + 500_000_000 for s in range(60)]
    assert source.summary() == {"clock": "receiver", "sentences": "GGA 60, RMC 60", "bad_sentences": 1, "past": 0}
    assert source.finding() == ""


def test_a_receiver_whose_date_is_corrected_goes_on(tmp_path: Path) -> None:
    wrong = b"".join(rmc(f"12000{s}", "230333") + gga(f"12000{s}") for s in range(3))
    right = b"".join(rmc(f"12000{s}") + gga(f"12000{s}") for s in range(3, 6))
    found, _ = read(wrong + right)
    log = tmp_path / "drive.nmea"
    log.write_bytes(wrong + right)
    source = NmeaFile(input=str(log))

    assert [fix.stamp - utc(1994, 3, 23, 12) for fix in found[3:]] == [3 * 10**9, 4 * 10**9, 5 * 10**9]
    assert len(play(source)["fix"]) == 3  # a log has no live clock that may jump
    assert source.summary()["past"] == 3


@pytest.mark.parametrize(
    ("content", "finding"),
    [
        (rmc("120000") * 30, "sends RMC and no GGA"),
        (GOOD * 30, "no RMC sentence with a fix"),
        (b"\xb5\x62" * 600, "1200 bytes without an NMEA sentence"),
        (GOOD[:40] * 30, "30 of 30 sentences are damaged"),
        (b"", ""),
    ],
)
def test_a_log_without_positions_is_explained(content: bytes, finding: str, tmp_path: Path) -> None:
    log = tmp_path / "drive.nmea"
    log.write_bytes(content)
    source = NmeaFile(input=str(log))

    assert not play(source)["fix"]
    assert finding in source.finding()
    assert bool(finding) == bool(source.finding())


def test_a_receiver_that_is_unplugged_goes_on_when_it_is_back(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    cable = Cable(tmp_path / "usb-receiver")
    source = NmeaGnss(input=str(cable.path), baud=115200, clock="receiver")
    while_opened(
        source,
        [
            (cable.plug, lambda: cable.send(b"\x03half a line\r\n" + rmc("120000") + gga("120001") + GOOD[:25])),
            (bytes, bytes),  # it is not there yet
            (cable.plug, lambda: cable.send(GOOD[25:] + gga("120005"))),
        ],
    )
    source.setup()
    fixes = source.stream()
    first = next(fixes)["fix"]
    cable.pull()
    second = next(fixes)["fix"]
    source.stop_reading()

    assert list(fixes) == []
    source.close()
    assert second.stamp - first.stamp == 4 * 10**9
    assert source.summary() == {"clock": "receiver", "sentences": "GGA 2, RMC 1", "bad_sentences": 1, "unplugged": 1}
    [warning] = [record for record in caplog.records if record.levelname == "WARNING"]
    assert "is gone" in warning.getMessage()
    os.close(cable.end)


def test_pauses_between_looks_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cable = Cable(tmp_path / "usb-receiver")
    cable.plug()
    source = NmeaGnss(input=str(cable.path))
    source.setup()
    cable.pull()
    pauses: list[float] = []

    def wait(seconds: float) -> bool:
        pauses.append(seconds)
        if len(pauses) == 9:
            source.stop_reading()
        return source._stopped.is_set()

    monkeypatch.setattr(source._stopped, "wait", wait)

    assert list(source.stream()) == []
    assert pauses == [0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 5.0, 5.0, 5.0]
    source.close()


def test_datagrams_are_stamped_by_the_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    port = free_port()
    source = NmeaGnss(input=f"udp://127.0.0.1:{port}")
    source.setup()
    times = iter((100, 200, 300))
    monkeypatch.setattr("operators.sources.ports.time.time_ns", lambda: next(times))
    fixes = source.stream()
    send_datagrams(port, b"", gga("120000"), b"garbage" + gga("120001"))
    stamps = [next(fixes)["fix"].stamp for _ in range(2)]
    source.stop_reading()

    assert stamps == [200, 300]  # an empty datagram is no end
    assert list(fixes) == []
    assert source.summary()["clock"] == "machine"
    source.close()


@pytest.mark.parametrize(
    ("settings_", "wrong"),
    [
        ({"input": "none"}, "no receiver at 'none': No such file"),
        ({"input": "log.nmea"}, "is a file, no serial device: operators.sources:NmeaFile reads"),
        ({"input": "/dev/null"}, "no receiver at '/dev/null': no serial device"),
        ({"input": "/dev/null", "baud": 9601}, "no rate of 9601 baud: 50, .* 9600,"),
        ({"input": "udp://10110"}, "no address: udp://ADDRESS:PORT"),
        ({"input": "udp://203.0.113.1:10110"}, "no receiver at 'udp://203.0.113.1:10110'"),
    ],
)
def test_a_receiver_that_is_not_there_at_the_start_is_an_error(
    settings_: dict[str, str | int], wrong: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("log.nmea").write_bytes(GOOD)

    with pytest.raises(SourceError, match=wrong):
        NmeaGnss(**settings_).setup()
