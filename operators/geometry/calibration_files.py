"""Files of calibrations: a camera as ROS's camera_calibration writes it, and the places of sensors on a robot.

https://wiki.ros.org/camera_calibration_parsers has the first format. The second is a list:

    transforms:
      - {frame: imu, child_frame: camera_optical, translation: [0.1, 0.0, 0.02], rotation: [0.0, 0.0, 0.0, 1.0]}

with the child frame's origin in the frame, metres, and the unit quaternion (x, y, z, w) that maps child to frame.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, ValidationError
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from dataflow.messages import CameraInfo, Transforms
from operators.geometry.frame_tree import FrameTree, told_by

MODELS = {"fisheye": "equidistant"}
"""Other names of the distortion models that CameraInfo has."""


class CalibrationFileError(ValueError):
    """A file holds no calibration, or another camera's; the message names file and reason."""


class _Matrix(BaseModel):
    rows: int
    cols: int
    data: list[float]

    def array(self) -> NDArray[np.float64]:
        return np.array(self.data).reshape(self.rows, self.cols)


class _Camera(BaseModel):
    image_width: int
    image_height: int
    camera_matrix: _Matrix
    distortion_model: str
    distortion_coefficients: _Matrix
    rectification_matrix: _Matrix | None = None
    projection_matrix: _Matrix | None = None


class _Transform(BaseModel):
    model_config = ConfigDict(extra="forbid")

    frame: str
    child_frame: str
    translation: tuple[float, float, float]
    rotation: tuple[float, float, float, float]


def read_camera(path: Path, frame: str) -> CameraInfo:
    """Returns a camera's calibration with stamp 0, in the frame that is given. Raises CalibrationFileError, OSError."""
    try:
        found = _Camera.model_validate(_read(path))
        model = MODELS.get(found.distortion_model, found.distortion_model)
        coefficients = found.distortion_coefficients.array().ravel()
        R, P = found.rectification_matrix, found.projection_matrix
        return CameraInfo(
            stamp=0,
            frame=frame,
            width=found.image_width,
            height=found.image_height,
            distortion_model=model,
            K=found.camera_matrix.array(),
            distortion=coefficients if len(coefficients) else None,
            R=None if R is None else R.array(),
            P=None if P is None else P.array(),
        )
    except ValidationError as error:
        raise CalibrationFileError(f"{path} is no calibration of a camera: {_first(error)}") from error
    except ValueError as error:
        raise CalibrationFileError(f"{path} is no calibration of a camera: {error}") from error


def camera_text(info: CameraInfo, notes: Sequence[str] = ()) -> str:
    """Returns the file of a calibration; `notes` stand above it as comments. One that is not rectified gets the
    identity as R and its K as P, without which ROS does not read it."""
    R = np.eye(3) if info.R is None else info.R
    P = np.column_stack([info.K, np.zeros(3)]) if info.P is None else info.P
    D = np.zeros(0) if info.distortion is None else info.distortion
    lines = [
        *(f"# {note}" for note in notes),
        f"image_width: {info.width}",
        f"image_height: {info.height}",
        f"camera_name: {json.dumps(info.frame)}",
        f"distortion_model: {info.distortion_model}",
    ]
    for name, matrix in (
        ("camera_matrix", info.K),
        ("distortion_coefficients", D[None]),
        ("rectification_matrix", R),
        ("projection_matrix", P),
    ):
        rows, cols = matrix.shape
        lines.append(f"{name}: {{rows: {rows}, cols: {cols}, data: {_numbers(matrix.ravel())}}}")
    return "\n".join(lines) + "\n"


def read_transforms(paths: Sequence[Path]) -> Transforms:
    """Returns the transforms of files with stamp 0, which together are a tree or several.

    Raises CalibrationFileError, OSError.
    """
    rows: list[_Transform] = []
    for path in paths:
        listed = _read(path).get("transforms")
        try:
            found = [_Transform.model_validate(row) for row in listed] if isinstance(listed, list) else []
        except ValidationError as error:
            raise CalibrationFileError(f"{path}: a transform is wrong: {_first(error)}") from error
        if not found:
            raise CalibrationFileError(f"{path} holds no transforms: expected `transforms:` with a list")
        rows += found
    try:
        transforms = Transforms(
            stamp=0,
            frames=tuple(row.frame for row in rows),
            child_frames=tuple(row.child_frame for row in rows),
            translations=np.array([row.translation for row in rows]),
            rotations=np.array([row.rotation for row in rows]),
        )
        tree = FrameTree()
        for edge in told_by(transforms):
            tree.fix(*edge)
    except ValueError as error:
        raise CalibrationFileError(f"{', '.join(map(str, paths))}: {error}") from error
    return transforms


def transforms_text(transforms: Transforms, notes: Sequence[str] = ()) -> str:
    """Returns the file of transforms; `notes` stand above it as comments."""
    lines = [*(f"# {note}" for note in notes), "transforms:"]
    for k, (frame, child) in enumerate(zip(transforms.frames, transforms.child_frames, strict=True)):
        lines += [
            f"  - frame: {json.dumps(frame)}",
            f"    child_frame: {json.dumps(child)}",
            f"    translation: {_numbers(transforms.translations[k])}",
            f"    rotation: {_numbers(transforms.rotations[k])}",
        ]
    return "\n".join(lines) + "\n"


def _numbers(values: NDArray[np.float64]) -> str:
    return f"[{', '.join(f'{value:.10g}' for value in values.tolist())}]"


def _read(path: Path) -> Mapping[str, Any]:
    try:
        content = YAML(typ="safe").load(path.read_text(encoding="utf-8"))
    except (YAMLError, UnicodeDecodeError) as error:
        raise CalibrationFileError(f"{path} is no YAML: {str(error).splitlines()[0]}") from error
    if not isinstance(content, Mapping):
        raise CalibrationFileError(f"{path} holds no calibration: expected a mapping")
    return content


def _first(error: ValidationError) -> str:
    found = error.errors()[0]
    return f"{'.'.join(map(str, found['loc'])) or 'it'}: {found['msg']}"
