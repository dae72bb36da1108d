"""Files of tables for streams of any name."""

from __future__ import annotations

from pathlib import Path

import pytest

from dataflow.interop.export.tables import file_of

ODD = ["..", "/", "g/..", ".", "a\0b", "a\nb", "a\x1b[2Jb", "ä" * 300, "x" * 300, "/" + "y" * 300 + "/z"]


@pytest.mark.parametrize("name", ODD, ids=ascii)
def test_any_name_of_a_stream_gives_a_file_within_the_folder(tmp_path: Path, name: str) -> None:
    path = file_of(tmp_path, name, ".parquet", ())

    path.write_bytes(b"x")
    assert path.resolve().is_relative_to(tmp_path.resolve())
    assert path.relative_to(tmp_path).as_posix().isprintable()


def test_streams_never_share_a_file(tmp_path: Path) -> None:
    names = [*ODD, *(name + "'" for name in ODD), "a/b", "/a/b", "a//b"]
    taken: list[str] = []
    for name in names:
        taken.append(str(file_of(tmp_path, name, ".csv", taken)))

    assert len(set(taken)) == len(names)
    assert file_of(tmp_path, "robot/imu", ".csv", taken) == tmp_path / "robot" / "imu.csv"
