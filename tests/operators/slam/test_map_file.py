"""Files of saved maps: what is none, is damaged or of another version is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from operators.slam import LidarSlam, VisualSlam
from operators.slam.lidar.map_file import read_lidar_map
from operators.slam.visual.map_file import read_visual_map


@pytest.mark.parametrize(("read", "make"), [(read_lidar_map, LidarSlam), (read_visual_map, VisualSlam)])
def test_a_file_that_is_no_map_or_damaged_or_of_another_version_is_refused(
    read: Any, make: Any, tmp_path: Path
) -> None:
    file = tmp_path / "wrong.npz"
    for content in (b"", b"no archive", b"PK\x03\x04 cut off"):
        file.write_bytes(content)
        with pytest.raises(ValueError, match=f"is no {'LiDAR' if make is LidarSlam else 'visual'} map"):
            read(file)
    for version, told in ((99, "version 99"), (1, "damaged")):
        np.savez(file, version=np.array(version))
        with pytest.raises(ValueError, match=told):
            read(file)
    with pytest.raises(FileNotFoundError):
        make(map_file=str(tmp_path / "none.npz")).setup()
