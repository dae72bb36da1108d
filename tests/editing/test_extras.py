"""Attachments and metadata records go along with what is cut, filtered, merged, split and recovered.

The `mcap` library writes what goes in and reads what comes out.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import pytest
from foreign_mcap import foreign_mcap
from hypothesis import given
from hypothesis import strategies as st
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.reader import NonSeekingReader, make_reader
from mcap.records import Attachment

from dataflow.editing.merge import merge
from dataflow.editing.part import Part, write_part
from dataflow.editing.recover import recover
from dataflow.editing.split import split
from dataflow.messages import Number
from dataflow.recording import Recording, RecordingWriter
from dataflow.recording.mcap import attachments as attachment_module
from dataflow.recording.mcap.attachments import Attachment as Attached
from dataflow.recording.mcap.attachments import names_once
from dataflow.recording.streams.copying import Origin

Extras = tuple[list[tuple[str, str, int, int, bytes]], list[tuple[str, dict[str, str]]]]
CALIBRATION = ("calibration.yaml", "text/yaml", 7, 5, b"fx: 500")
NOTES = ("notes", "text/plain", 8, 0, b"")


def foreign(path: Path, topic: str, attachments: list[tuple[str, str, int, int, bytes]], **metadata: str) -> Path:
    messages = [(topic, 1000 + k, b"%d" % k) for k in range(10)]
    records = {name: {"value": value} for name, value in metadata.items()}
    return foreign_mcap(path, messages, metadata=records, attachments=attachments)


def ours(path: Path, attachments: list[tuple[str, str, int, int, bytes]], **metadata: str) -> Path:
    with RecordingWriter(path, metadata={"dataflow:run": {"mode": path.stem}}) as writer:
        writer.add_stream(f"{path.stem}/number", Number)
        for name, value in metadata.items():
            writer.add_metadata(name, {"value": value})
        for name, media, log_time, created, data in attachments:
            writer.add_attachment(Attached(name, media, log_time, created, data))
        for k in range(10):
            writer.write(f"{path.stem}/number", Number(stamp=1000 + k, value=float(k)), seq=k)
    return path


def held(path: Path) -> Extras:
    """What the mcap library reads, by the summary."""
    with path.open("rb") as file:
        reader = make_reader(file)
        statistics = reader.get_summary().statistics
        found = [(a.name, a.media_type, a.log_time, a.create_time, a.data) for a in reader.iter_attachments()]
        records = [(m.name, dict(m.metadata)) for m in reader.iter_metadata()]
    assert statistics is not None
    assert (statistics.attachment_count, statistics.metadata_count) == (len(found), len(records))
    with path.open("rb") as file:  # and record by record
        again = [
            (a.name, a.media_type, a.log_time, a.create_time, a.data) for a in NonSeekingReader(file).iter_attachments()
        ]
    assert again == found
    return found, records


def written(path: Path, out: Path, part: Part) -> Path:
    with Origin(path) as origin:
        write_part(origin, part, out)
    return out


def merged(out: Path, *paths: Path, prefixes: tuple[str, ...] = ()) -> list[str]:
    origins = [Origin(path) for path in paths]
    try:
        return merge(origins, out, prefixes=prefixes).notes
    finally:
        for origin in origins:
            origin.close()


EDITS: dict[str, Callable[[Path, Path], Path]] = {
    "cut": lambda path, folder: written(path, folder / "cut.mcap", Part(1004, 1007)),
    "bare": lambda path, folder: written(path, folder / "bare.mcap", Part(1004, 1007, bare=True)),
    "filter": lambda path, folder: written(path, folder / "filtered.mcap", Part(streams=["a/number", "/said"])),
    "recover": lambda path, folder: Path(recover(path, folder / "saved.mcap").saved.path),
}


@pytest.mark.parametrize("edit", EDITS)
def test_attachments_and_records_of_another_program_go_along(tmp_path: Path, edit: str) -> None:
    path = foreign(tmp_path / "a.mcap", "/said", [CALIBRATION, NOTES, NOTES], robot="r1", site="hall")
    with path.open("rb") as file:
        before = [(m.name, dict(m.metadata)) for m in make_reader(file).iter_metadata()]

    found, records = held(EDITS[edit](path, tmp_path))
    assert found == [CALIBRATION, NOTES, NOTES]
    assert records == before == [("robot", {"value": "r1"}), ("site", {"value": "hall"})]


@pytest.mark.parametrize("edit", EDITS)
def test_attachments_and_records_of_a_recording_go_along(tmp_path: Path, edit: str) -> None:
    path = ours(tmp_path / "a.mcap", [CALIBRATION, NOTES], robot="r1")
    made = EDITS[edit](path, tmp_path)

    found, records = held(made)
    assert found == [CALIBRATION, NOTES]
    assert ("robot", {"value": "r1"}) in records
    with Recording(made) as recording:
        assert not recording.torn
        assert recording.damage == ()


def test_every_part_of_a_split_has_them_and_the_merge_has_them_once(tmp_path: Path) -> None:
    path = ours(tmp_path / "a.mcap", [CALIBRATION, NOTES], robot="r1")
    with Origin(path) as origin:
        parts = [Path(done.path) for done in split(origin, tmp_path / "parts", every=4)]

    assert [held(part)[0] for part in parts] == [[CALIBRATION, NOTES]] * 3
    assert merged(tmp_path / "whole.mcap", *parts) == []
    found, records = held(tmp_path / "whole.mcap")
    assert found == [CALIBRATION, NOTES]
    assert records.count(("robot", {"value": "r1"})) == 1


def test_of_two_that_differ_both_are_kept_the_later_ones_under_its_files_name(tmp_path: Path) -> None:
    other = (*CALIBRATION[:4], b"fx: 510")
    first = foreign(tmp_path / "front.mcap", "/front", [CALIBRATION, NOTES], robot="r1", site="hall")
    second = foreign(tmp_path / "rear.mcap", "/rear", [NOTES, other], robot="r1", site="yard")

    notes = merged(tmp_path / "both.mcap", first, second)
    found, records = held(tmp_path / "both.mcap")
    assert found == [CALIBRATION, NOTES, ("rear/calibration.yaml", *other[1:])]
    assert records == [("robot", {"value": "r1"}), ("site", {"value": "hall"}), ("rear/site", {"value": "yard"})]
    assert [note for note in notes if "kept as" in note] == [
        "attachment 'calibration.yaml' of rear.mcap differs from that of a file before it: kept as "
        "'rear/calibration.yaml'",
        "metadata 'site' of rear.mcap differs from that of a file before it: kept as 'rear/site'",
    ]
    merged(tmp_path / "prefixed.mcap", first, second, prefixes=("", "back/"))
    assert [a[0] for a in held(tmp_path / "prefixed.mcap")[0]] == ["calibration.yaml", "notes", "back/calibration.yaml"]


def test_the_records_of_a_later_run_do_not_pass_for_those_of_the_first(tmp_path: Path) -> None:
    first, second = ours(tmp_path / "a.mcap", []), ours(tmp_path / "b.mcap", [CALIBRATION])
    merged(tmp_path / "both.mcap", first, second)
    with Recording(tmp_path / "both.mcap") as recording:
        assert recording.metadata["dataflow:run"] == {"mode": "a"}
        assert recording.metadata["b/dataflow:run"] == {"mode": "b"}
    assert held(tmp_path / "both.mcap")[0] == [CALIBRATION]

    bag = foreign(tmp_path / "bag.mcap", "/said", [])
    merged(tmp_path / "foreign.mcap", bag, second)
    with Origin(tmp_path / "foreign.mcap") as origin:
        assert not origin.own
        assert "b/recording" in origin.metadata


def test_attachment_with_wrong_checksum_is_left_out_and_reported(tmp_path: Path) -> None:
    path = foreign(tmp_path / "a.mcap", "/said", [CALIBRATION, NOTES])
    path.write_bytes(path.read_bytes().replace(b"fx: 500", b"fx: 501"))

    with Origin(path) as origin:
        done = write_part(origin, Part(1004, 1007), tmp_path / "part.mcap")
    assert held(tmp_path / "part.mcap")[0] == [NOTES]
    assert any("'calibration.yaml'" in note and "fails its checksum; it is left out" in note for note in done.notes)
    saved = recover(path, tmp_path / "saved.mcap")
    assert any("fails its checksum" in note for note in saved.damage)


def test_a_torn_file_gives_the_attachments_that_are_whole(tmp_path: Path) -> None:
    path = ours(tmp_path / "a.mcap", [CALIBRATION])
    data = path.read_bytes()
    record = RecordBuilder()
    Attachment(0, 0, "late", "text/plain", b"x" * 100).write(record)
    at = data.index(b"calibration.yaml")
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(data[: data.index(struct.pack("<B", Opcode.DATA_END), at + 60)] + bytes(record.end())[:50])

    saved = recover(torn, tmp_path / "saved.mcap")
    assert saved.torn
    assert held(tmp_path / "saved.mcap")[0] == [CALIBRATION]


def test_too_large_attachment_is_left_out_and_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = foreign(tmp_path / "a.mcap", "/said", [CALIBRATION, ("map", "image/png", 0, 0, bytes(2000))])
    monkeypatch.setattr(attachment_module, "MAX_CHUNK_BYTES", 1000)

    with Origin(path) as origin:
        done = write_part(origin, Part(1004, 1007), tmp_path / "part.mcap")
    assert held(tmp_path / "part.mcap")[0] == [CALIBRATION]
    assert any("at most 1000 are read" in note for note in done.notes)


ITEMS = st.lists(st.tuples(st.sampled_from(["a", "b", "x/a", "y/a", "x/a 2"]), st.integers(0, 2)), max_size=4)


@given(st.lists(st.tuples(st.sampled_from("xyz"), ITEMS), max_size=4))
def test_merged_attachments_keep_all_contents_under_unique_names(
    files: list[tuple[str, list[tuple[str, int]]]],
) -> None:
    found = names_once(files)
    kept = [
        (number, chosen, content)
        for number, ((_, items), names) in enumerate(zip(files, found, strict=True))
        for (_, content), chosen in zip(items, names, strict=True)
        if chosen is not None
    ]
    assert found[:1] == [[name for name, _ in items] for _, items in files[:1]]
    for number, chosen, content in kept:
        assert all(content == c for n, name, c in kept if name == chosen and n != number)
    for (_, items), names in zip(files, found, strict=True):
        for (name, content), chosen in zip(items, names, strict=True):
            assert chosen is not None or any(
                c == content and n.split("/")[-1][:1] == name.split("/")[-1][:1] for _, n, c in kept
            )
