"""What is saved of torn and damaged files, and what is said to be lost."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from foreign_mcap import foreign_mcap
from made_parts import messages
from mcap.opcode import Opcode
from mcap.reader import make_reader

from dataflow.editing.recover import recover
from dataflow.messages import Text
from dataflow.recording import Recording, RecordingError, RecordingWriter
from dataflow.recording.mcap.packing import Compression

HEAD = 9


def written(path: Path, count: int = 40) -> Path:
    """Two streams in chunks of a few messages each."""
    with RecordingWriter(path, metadata={"note": {"robot": "kitchen"}}, chunk_bytes=300) as writer:
        for stream in ("a", "b"):
            writer.add_stream(stream, Text)
        for k in range(count):
            for stream in ("a", "b"):
                writer.write(stream, Text(stamp=1 + k, text=f"{stream}{k}"), seq=k)
    return path


def chunks(data: bytes) -> list[tuple[int, int]]:
    """(begin, end) of each chunk record."""
    at, found = 8, []
    while at < len(data) - 8:
        opcode, length = data[at], int.from_bytes(data[at + 1 : at + HEAD], "little")
        if opcode == Opcode.CHUNK:
            found.append((at, at + HEAD + length))
        at += HEAD + length
    return found


@pytest.mark.parametrize("fault", ["damage", "an unknown compression"])
def test_a_damaged_chunk_is_left_out_and_its_messages_are_counted(tmp_path: Path, fault: str) -> None:
    path = written(tmp_path / "a.mcap")
    data = bytearray(path.read_bytes())
    begin, end = chunks(bytes(data))[3]
    if fault == "damage":
        data[end - 5] ^= 0xFF
    else:
        name = data.index(b"zstd", begin)
        data[name : name + 4] = b"brot"
    path.write_bytes(data)

    done = recover(path, tmp_path / "saved.mcap")

    found = messages(tmp_path / "saved.mcap")
    lost = {loss.stream: loss.messages for loss in done.lost}
    assert not done.whole
    assert lost
    for stream, present in found.items():
        assert len(present) + lost.get(stream, 0) == 40
    assert any("chunk 3" in note for note in done.damage)
    with Recording(tmp_path / "saved.mcap") as saved:
        assert not saved.torn
        assert saved.metadata["note"] == {"robot": "kitchen"}
        assert saved.metadata["dataflow:recovered"]["of"] == "a.mcap"


@pytest.mark.parametrize("share", [0.35, 0.6, 0.9])
def test_a_torn_file_with_a_damaged_chunk_is_saved_around_it(tmp_path: Path, share: float) -> None:
    whole = messages(written(tmp_path / "whole.mcap"))
    data = bytearray((tmp_path / "whole.mcap").read_bytes())
    del data[int(len(data) * share) :]
    _, end = chunks(bytes(data))[1]
    data[end - 5] ^= 0xFF
    (tmp_path / "a.mcap").write_bytes(data)

    done = recover(tmp_path / "a.mcap", tmp_path / "saved.mcap")

    assert done.torn
    for stream, found in messages(tmp_path / "saved.mcap").items():
        assert found
        assert found.items() <= whole[stream].items()


def test_a_sound_file_is_saved_whole(tmp_path: Path) -> None:
    path = written(tmp_path / "a.mcap")

    done = recover(path, tmp_path / "saved.mcap")

    assert done.whole
    assert messages(tmp_path / "saved.mcap") == messages(path)


def test_a_time_before_the_epoch_is_saved_as_it_is(tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    path = foreign_mcap(tmp_path / "early.mcap", [("/x", time, b"{}") for time in (5, 2**64 - 1, 2**63)])

    recover(path, out)

    with out.open("rb") as file:
        found = make_reader(file).iter_messages(log_time_order=False)
        assert [message.log_time for _, _, message in found] == [5, 2**64 - 1, 2**63]
    with Recording(out) as recording:
        assert [raw.log_time for raw in recording.raw()] == [-(2**63), -1, 5]


def test_recovering_a_file_that_is_no_recording_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(b"nothing of the kind")
    with pytest.raises(RecordingError, match="not an MCAP file: it begins with 6e 6f"):
        recover(tmp_path / "a.mcap", tmp_path / "saved.mcap")
    path = written(tmp_path / "b.mcap")
    with pytest.raises(RecordingError, match="to be recovered"):
        recover(path, path, overwrite=True)


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
def test_whole_messages_before_a_cut_within_a_chunk_are_saved(tmp_path: Path, compression: Compression) -> None:
    path, draw = tmp_path / "whole.mcap", random.Random(7)
    with RecordingWriter(path, metadata={}, compression=compression, chunk_bytes=600_000) as writer:
        writer.add_stream("a", Text)
        for k in range(60):
            noise = "".join(draw.choices("abcdefgh", k=30_000))
            writer.write("a", Text(stamp=1 + k, text=noise), seq=k)
    data, whole = path.read_bytes(), messages(path)
    more = 0
    for cut in sorted(draw.sample(range(chunks(data)[0][0], len(data)), 12)):
        torn, saved = tmp_path / f"{cut}.mcap", tmp_path / f"{cut}_saved.mcap"
        torn.write_bytes(data[:cut])
        with Recording(torn) as strict:
            before = strict.streams["a"].count if "a" in strict.streams else 0

        recover(torn, saved)

        found = messages(saved).get("a", {})
        assert len(found) >= before
        assert found == dict(list(whole["a"].items())[: len(found)])
        more += len(found) - before
    assert more > 12


def test_cuts_all_over_a_small_file_are_recovered(tmp_path: Path) -> None:
    path = tmp_path / "whole.mcap"
    with RecordingWriter(path, metadata={}, compression="none") as writer:
        writer.add_stream("a", Text)
        for k in range(6):
            writer.write("a", Text(stamp=1 + k, text=f"word {k}"), seq=k)
    data, whole = path.read_bytes(), list(messages(path)["a"].items())
    begin, end = chunks(data)[0]
    counts = []
    for cut in range(begin, end, 7):
        (tmp_path / "torn.mcap").write_bytes(data[:cut])
        recover(tmp_path / "torn.mcap", tmp_path / "saved.mcap", overwrite=True)
        found = list(messages(tmp_path / "saved.mcap").get("a", {}).items())
        assert found == whole[: len(found)]
        counts.append(len(found))
    assert counts == sorted(counts)
    assert counts[-1] >= 5
