"""Files of RGB-D datasets and their meaning: the 7-Scenes and TUM RGB-D layouts."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from dataflow.messages.depth_units import FIFTHS, MILLIMETRES
from dataflow.messages.geometry import transform_matrix
from dataflow.operator import SourceError
from operators.association import mutually_nearest
from operators.geometry.se3 import orthonormalised
from operators.sources.pacing import frame_stamp

Matrix = NDArray[np.float64]
LayoutName = Literal["7scenes", "tum"]
T = TypeVar("T")
Place = tuple[float, float, float, float, float, float, float]

_TUM_GAP = 20_000_000  # ns: images farther apart than this are no pair, as in the dataset's own associate.py
LATEST = 2**63
_SMALLER = (("milliseconds", 10**3), ("microseconds", 10**6), ("nanoseconds", 10**9))
_FRAME = re.compile(r"frame-(\d+)\.(?:color\.(?:jpg|png)|depth\.png|pose\.txt)")


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """A pinhole camera in pixels."""

    fx: float
    fy: float
    cx: float
    cy: float


@dataclass(frozen=True, eq=False, slots=True)
class Frame:
    """The files of one frame. `pose` is a file with T_world_camera, that matrix (4, 4) itself, or None."""

    name: str
    stamp: int
    image: Path
    depth: Path
    pose: Path | Matrix | None

    def T_world_camera(self) -> Matrix | None:
        """The true pose, its rotation made orthonormal, or None. Raises SourceError for a matrix that is no pose."""
        if self.pose is None or isinstance(self.pose, np.ndarray):
            return self.pose
        T = read_matrix(self.pose, (4, 4))
        if not np.isfinite(T).all():  # 7-Scenes marks a pose it does not know so
            return None
        if np.abs(T[3] - [0, 0, 0, 1]).max() > 1e-6 or np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() > 0.05:
            raise SourceError(f"{self.pose}: frame {self.name}: not a rigid motion:\n{T}")
        if np.linalg.det(T[:3, :3]) < 0:
            raise SourceError(f"{self.pose}: frame {self.name}: a reflection, as of left-handed axes:\n{T}")
        return orthonormalised(T)


@dataclass(frozen=True, eq=False, slots=True)
class Dataset:
    """A listed folder, as its layout has it. One unit of a depth image is `1 / depth_scale` metres.

    `T_depth_image` is x, y, z (m), qx, qy, qz, qw of the colour camera in the depth camera's frame; None: depth is
    registered to colour, so that one camera took both. `lacking`: what is there of frames that are not whole, and lines
    of lists that cannot be read; `unpaired`: colour images without a depth image near in time.
    """

    frames: Sequence[Frame]
    depth_scale: float
    image_intrinsics: Intrinsics
    depth_intrinsics: Intrinsics
    T_depth_image: Place | None
    lacking: Sequence[str] = ()
    unpaired: int = 0

    @property
    def registered(self) -> bool:
        return self.T_depth_image is None


def detect_layout(folder: Path) -> LayoutName:
    """Raises SourceError where the folder is neither."""
    if not folder.is_dir():
        raise SourceError(f"no folder {str(folder)!r} (looked for {folder.absolute()})")
    if (folder / "rgb.txt").is_file():
        return "tum"
    if any(_FRAME.fullmatch(entry.name) for entry in folder.iterdir()):
        return "7scenes"
    raise SourceError(
        f"{folder} holds neither the 7-Scenes layout (frame-000000.color.jpg, ...) nor TUM RGB-D (rgb.txt, depth.txt)"
    )


def list_7scenes(folder: Path, rate: float, first_stamp: int) -> Dataset:
    """`frame-NNNNNN.color.jpg|png`, `.depth.png` (millimetres), `.pose.txt`; frame N is at first_stamp + N / rate.

    `camera-intrinsics.txt` is K of the depth camera. The colour camera is not the same and not registered to it: its
    focal length is taken as 525 px, the Kinect's nominal one, around the same centre, and its place as 2.5 cm to the
    right, which is how a Kinect v1 is built.
    """
    numbers: dict[int, str] = {}
    present: set[str] = set()
    for entry in folder.iterdir():
        match = _FRAME.fullmatch(entry.name)
        if match:
            numbers[int(match[1])] = match[1]
            present.add(entry.name)
    if not numbers:
        raise SourceError(f"{folder} has no frame-NNNNNN.color.jpg, as the 7-Scenes layout has")
    frames = []
    lacking: list[str] = []
    for number in sorted(numbers):
        stem = f"frame-{numbers[number]}"
        image = next((f"{stem}.color.{s}" for s in ("jpg", "png") if f"{stem}.color.{s}" in present), None)
        if image is None:
            lacking.append(f"frame {numbers[number]} has no colour image: no {folder / stem}.color.jpg (or .png)")
            continue
        if f"{stem}.depth.png" not in present:
            lacking.append(f"frame {numbers[number]} has no depth image: no {folder / stem}.depth.png")
            continue
        pose = folder / f"{stem}.pose.txt" if f"{stem}.pose.txt" in present else None
        stamp = frame_stamp(number, rate, first_stamp)
        frames.append(Frame(numbers[number], stamp, folder / image, folder / f"{stem}.depth.png", pose))
    depth = _intrinsics_file(folder) or Intrinsics(585.0, 585.0, 320.0, 240.0)
    color = Intrinsics(525.0, 525.0, depth.cx, depth.cy)
    if not frames:
        raise SourceError(lacking[0])
    return Dataset(frames, MILLIMETRES, color, depth, (0.025, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0), lacking)


def list_tum(folder: Path) -> Dataset:
    """`rgb.txt`, `depth.txt`, `groundtruth.txt`: stamps in seconds, pairs by nearest stamp within 20 ms.

    A frame's stamp is its colour image's. Depth is registered to colour, 5000 units a metre; without
    `camera-intrinsics.txt` both have the dataset's default of 525 px around (319.5, 239.5). Rows of NaN in
    `groundtruth.txt` are moments without a known pose; a truth of which no row is near an image is an error.
    """
    lacking: list[str] = []
    images = _tum_list(folder / "rgb.txt", _file, lacking)
    depths = _tum_list(folder / "depth.txt", _file, lacking)
    path = folder / "groundtruth.txt"
    rows = _tum_list(path, _tum_pose, lacking) if path.is_file() else []
    truth = [(stamp, T) for stamp, T in rows if np.isfinite(T).all()]
    stamps = [stamp for stamp, _ in images]
    poses = dict(mutually_nearest(stamps, [stamp for stamp, _ in truth], _TUM_GAP))
    pairs = mutually_nearest(stamps, [stamp for stamp, _ in depths], _TUM_GAP)
    if not pairs:
        raise SourceError(f"{folder}: no image of rgb.txt is within 20 ms of one of depth.txt")
    if truth and not poses:
        raise SourceError(
            f"{folder / 'groundtruth.txt'}: none of its {len(truth):,} poses is within 20 ms of an image: its times "
            f"run from {truth[0][0] * 1e-9:.3f} to {truth[-1][0] * 1e-9:.3f} s, those of rgb.txt from "
            f"{stamps[0] * 1e-9:.3f} to {stamps[-1] * 1e-9:.3f} s"
        )
    frames = []
    for i, j in pairs:
        stamp, image = images[i]
        pose = truth[poses[i]][1] if i in poses else None
        frames.append(Frame(image, stamp, folder / image, folder / depths[j][1], pose))
    K = _intrinsics_file(folder) or Intrinsics(525.0, 525.0, 319.5, 239.5)
    return Dataset(frames, FIFTHS, K, K, None, lacking, len(images) - len(pairs))


def read_matrix(file: Path, shape: tuple[int, int]) -> Matrix:
    """A text file of numbers as a matrix. Raises SourceError."""
    try:
        values = np.array(file.read_text().split(), np.float64)
    except (OSError, ValueError) as error:
        raise SourceError(f"{file}: {error}") from None
    if values.size != shape[0] * shape[1]:
        raise SourceError(f"{file}: expected {shape[0]}x{shape[1]} numbers, found {values.size}")
    return values.reshape(shape)


def _intrinsics_file(folder: Path) -> Intrinsics | None:
    file = folder / "camera-intrinsics.txt"
    if not file.is_file():
        return None
    K = read_matrix(file, (3, 3))
    if not (np.isfinite(K).all() and K[0, 0] > 0 and K[1, 1] > 0):
        raise SourceError(f"{file}: not an intrinsic matrix with positive focal lengths:\n{K}")
    return Intrinsics(float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))


def _tum_list(file: Path, read: Callable[[str], T], lacking: list[str]) -> list[tuple[int, T]]:
    """The lines `seconds value...` of a TUM list file by stamp, which is exact in nanoseconds.

    Lines that cannot be read, and further ones of a stamp, are added to `lacking`. Raises SourceError where none is
    left.
    """
    if not file.is_file():
        raise SourceError(f"the TUM RGB-D layout needs {file.name} (looked for {file.absolute()})")
    try:
        lines = file.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise SourceError(f"{file} is no text in UTF-8: {error}") from None
    found: dict[int, tuple[str, T]] = {}
    refused: list[str] = []
    for number, line in enumerate(lines, 1):
        words = line.split(maxsplit=1)
        if not words or words[0].startswith("#"):
            continue
        try:
            stamp, rest = _tum_stamp(words[0]), " ".join(words[1:]).rstrip()
            value = read(rest)
        except ValueError as error:
            refused.append(f"{file}:{number}: {error}")
            continue
        if found.setdefault(stamp, (rest, value))[0] != rest:
            refused.append(f"{file}:{number}: a second line of the time {words[0]} s")
    if refused and not found:
        raise SourceError(refused[0])
    lacking += refused
    return [(stamp, value) for stamp, (_, value) in sorted(found.items(), key=lambda item: item[0])]


def _tum_stamp(word: str) -> int:
    """Nanoseconds of a time in seconds. Raises ValueError."""
    try:
        stamp = int(Fraction(word) * 10**9)
    except (ValueError, ZeroDivisionError):
        raise ValueError(f"{word!r} is no time in seconds") from None
    if not 0 <= stamp < LATEST:
        units = next((name for name, scale in _SMALLER if 0 <= stamp // scale < LATEST), "")
        hint = f": is it in {units}?" if units else ""
        raise ValueError(f"{word} s is no time from 1970 to 2262{hint}")
    return stamp


def _file(name: str) -> str:
    """The name of an image, which may have spaces. Raises ValueError."""
    if not name:
        raise ValueError("expected a time and the name of a file, found a time alone")
    return name


def _tum_pose(text: str) -> Matrix:
    """The matrix of x, y, z, qx, qy, qz, qw, of NaN where one of them is. Raises ValueError."""
    words = text.split()
    if len(words) != 7:
        raise ValueError(f"expected a time and 7 values, found {len(words)} values: {text!r}")
    x, y, z, qx, qy, qz, qw = map(float, words)
    if not np.isfinite([x, y, z, qx, qy, qz, qw]).all():
        return np.full((4, 4), np.nan)
    norm = float(np.linalg.norm([qx, qy, qz, qw]))
    if not abs(norm - 1) < 0.01:
        raise ValueError(f"a quaternion of length {norm:.3g}, not 1")
    return transform_matrix([x, y, z], [qx, qy, qz, qw])
