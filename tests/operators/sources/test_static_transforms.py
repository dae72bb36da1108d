"""The transforms of files reach a graph as one message; files that cannot be are named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dataflow.operator import SourceError
from dataflow.testing import play
from operators.sources import StaticTransforms

TEXT = """\
transforms:
  - {{frame: {parent}, child_frame: {child}, translation: [{x}, 0.0, 0.25], rotation: [0.0, 0.0, 0.0, 1.0]}}
"""


def written(folder: Path, parent: str, child: str, x: float) -> str:
    file = folder / f"{child}.yaml"
    file.write_text(TEXT.format(parent=parent, child=child, x=x))
    return str(file)


def test_the_transforms_of_all_files_are_one_message(tmp_path: Path) -> None:
    paths = written(tmp_path, "base", "camera", 0.5), written(tmp_path, "camera", "imu", -0.125)

    [given] = play(StaticTransforms(paths=paths))["extrinsics"]
    [again] = play(StaticTransforms(paths=paths))["extrinsics"]

    assert (given.frames, given.child_frames) == (("base", "camera"), ("camera", "imu"))
    np.testing.assert_array_equal(given.translations, [[0.5, 0, 0.25], [-0.125, 0, 0.25]])
    np.testing.assert_array_equal(given.rotations, [[0, 0, 0, 1]] * 2)
    assert again.digest() == given.digest()


def test_a_file_that_holds_no_list_or_is_not_there_is_named(tmp_path: Path) -> None:
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text("transforms: 5\n")
    with pytest.raises(SourceError, match=r"wrong\.yaml"):
        StaticTransforms(paths=(str(wrong),)).setup()
    with pytest.raises(FileNotFoundError, match=r"absent\.yaml"):
        StaticTransforms(paths=(str(tmp_path / "absent.yaml"),)).setup()
