"""Commands of `dataflow calibrate`: cameras, stereo pairs and cameras beside IMUs, from recordings of a board."""

from __future__ import annotations

import json as jsonlib
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import track

from dataflow.api.names import StreamNameError
from dataflow.api.recordings import open as opened
from dataflow.messages import CameraInfo, Imu, Transforms
from dataflow.recording import RecordingError
from operators.calibration import camera_imu as mounts
from operators.calibration import coverage, stereo
from operators.calibration.boards import Board, Charuco, Chessboard
from operators.calibration.camera import BLURRED, MODELS, CameraCalibration, Model, different, tilts
from operators.calibration.recorded import (
    Along,
    BoardViews,
    images_looked_at,
    images_of,
    intrinsics_of,
    look,
    own_frames,
    spaced,
    spaced_pairs,
    stream_of,
)
from operators.geometry.calibration_files import camera_text, read_camera, transforms_text

COULD_NOT_RUN = 2

calibrate = typer.Typer(
    name="calibrate",
    help="""Calibrate a camera, a stereo pair, or a camera beside an IMU from a recording of a board.

    A board is a chessboard (`--chessboard 9x6`, counted in inner corners) or a ChArUco board (`--charuco 11x8`, counted
    in squares), flat, its squares measured.

    Examples:

      dataflow calibrate camera out/board.mcap --chessboard 9x6 --square 0.025
      dataflow calibrate stereo out/board.mcap --charuco 11x8 --square 0.03 --marker 0.022
      dataflow calibrate camera-imu out/turning.mcap --chessboard 9x6 --square 0.025
    """,
    no_args_is_help=True,
    rich_markup_mode="rich",
)

File = Annotated[Path, typer.Argument(metavar="RECORDING", help="A recording, or any MCAP file.", show_default=False)]
Plain = Annotated[
    str | None, typer.Option("--chessboard", metavar="NxM", help="A chessboard of so many inner corners.")
]
Marked = Annotated[str | None, typer.Option("--charuco", metavar="NxM", help="A ChArUco board of so many squares.")]
Square = Annotated[float, typer.Option("--square", metavar="METRES", help="Side of a square.", show_default=False)]
Marker = Annotated[float | None, typer.Option("--marker", metavar="METRES", help="Side of a ChArUco board's markers.")]
Dictionary = Annotated[str, typer.Option("--dictionary", metavar="NAME", help="OpenCV's name of its set of markers.")]
Lens = Annotated[str, typer.Option("--model", metavar="MODEL", help=f"{', '.join(MODELS)} (fisheye).")]
Every = Annotated[
    float, typer.Option("--every", metavar="SECONDS", min=0, help="Look at one image in so long; 0 looks at all.")
]
Out = Annotated[Path, typer.Option("--out", metavar="FOLDER", help="Folder of the files that are written.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace files that are there.")]
Json = Annotated[bool, typer.Option("--json", help="Print the outcome as JSON.")]
FOLDER = Path("out/calibration")
LARGEST = 1.0
"""Metres of a square; longer ones are millimetres, or centimetres."""


@calibrate.command()
def camera(
    recording: File,
    square: Square,
    chessboard: Plain = None,
    charuco: Marked = None,
    marker: Marker = None,
    dictionary: Dictionary = "5X5_100",
    image: Annotated[str | None, typer.Option(help="The stream of images, where there are several.")] = None,
    model: Lens = "plumb_bob",
    every: Every = 0.25,
    out: Out = FOLDER,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Find a camera's focal lengths, principal point and lens distortion.

    Move the board, or the camera, slowly through the whole image, its corners too, near and far, tilted both ways.
    Writes FOLDER/camera.yaml, which sources of images (`calibration:`) and ROS read, and FOLDER/camera.png: green where
    boards were, red lines where none was, residuals 50 times as long.

    Examples:

      dataflow calibrate camera out/board.mcap --chessboard 9x6 --square 0.025
      dataflow calibrate camera out/board.mcap --charuco 11x8 --square 0.03 --marker 0.022 --model equidistant
    """
    with _in_one_line():
        board, lens = _board(chessboard, charuco, square, marker, dictionary), _model(model)
        files = _places(out, ("camera.yaml", "camera.png"), overwrite)
        with opened(recording) as streams:
            images = images_of(streams, image, "--image")
            seen = look(board, images, spaced(images.stamps, every), _progress(json))
        fitted = seen.fit(lens)
        _write_camera(files, seen, fitted, fitted.info, recording)
        _report(_camera_json(seen, fitted), _camera_words(seen, fitted), seen.warnings(fitted), files, json=json)


@calibrate.command("stereo")
def stereo_pair(
    recording: File,
    square: Square,
    chessboard: Plain = None,
    charuco: Marked = None,
    marker: Marker = None,
    dictionary: Dictionary = "5X5_100",
    left: Annotated[str, typer.Option(help="The left camera's stream of images.")] = "left",
    right: Annotated[str, typer.Option(help="The right camera's.")] = "right",
    tolerance: Annotated[
        float, typer.Option(metavar="SECONDS", min=0, help="Images at most so far apart are a pair.")
    ] = 0.005,
    model: Lens = "plumb_bob",
    every: Every = 0.25,
    out: Out = FOLDER,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Find both cameras' calibrations, and the place of the right one beside the left one.

    Writes FOLDER/left.yaml and right.yaml, with the rectification that `StereoPreprocess` and ROS use, a picture of
    each, and stereo.yaml, the transform for `operators.sources:StaticTransforms`.

    Examples:

      dataflow calibrate stereo out/board.mcap --chessboard 9x6 --square 0.025
      dataflow calibrate stereo out/board.mcap --chessboard 9x6 --square 0.025 --left cam0/image --right cam1/image
    """
    with _in_one_line():
        board, lens = _board(chessboard, charuco, square, marker, dictionary, upright=True), _model(model)
        files = _places(out, ("left.yaml", "left.png", "right.yaml", "right.png", "stereo.yaml"), overwrite)
        with opened(recording) as streams:
            images = images_of(streams, left, "--left"), images_of(streams, right, "--right")
            places = spaced_pairs(*images, every, round(tolerance * 1e9))
            looked = [look(board, each, chosen, _progress(json)) for each, chosen in zip(images, places, strict=True)]
        both = own_frames(*looked)
        kept = [seen.fit(lens) for seen in both]
        pair = _pair(both, kept, tolerance)
        for k, info in enumerate((pair.left, pair.right)):
            _write_camera(files[2 * k : 2 * k + 2], both[k], kept[k], info, recording)
        _write_transform(
            files[4], pair.T_left_right, pair.left.frame, pair.right.frame,
            [f"dataflow calibrate stereo, from {recording.name}: {len(pair.apart)} views, {pair.rms:.3f} px"],
        )  # fmt: skip
        words = [line for k in (0, 1) for line in _camera_words(both[k], kept[k])]
        warnings = [f"{both[k].name}: {warning}" for k in (0, 1) for warning in both[k].warnings(kept[k])]
        if both[0].frame != looked[0].frame:
            warnings.append(
                f"both cameras have the frame {looked[0].frame!r}; the files name them {both[0].frame} and "
                f"{both[1].frame}: give each source another `frame`"
            )
        content = {"left": _camera_json(both[0], kept[0]), "right": _camera_json(both[1], kept[1])}
        _report(
            {**content, **_pair_json(pair)}, [*words, _pair_words(pair)], warnings + stereo.warnings_of(pair), files,
            json=json,
        )  # fmt: skip


@calibrate.command("camera-imu")
def camera_imu(
    recording: File,
    square: Square,
    chessboard: Plain = None,
    charuco: Marked = None,
    marker: Marker = None,
    dictionary: Dictionary = "5X5_100",
    image: Annotated[str | None, typer.Option(help="The stream of images, where there are several.")] = None,
    imu: Annotated[str | None, typer.Option(help="The stream of the IMU, where there are several.")] = None,
    intrinsics: Annotated[
        Path | None,
        typer.Option("--camera", metavar="FILE", help="The camera's calibration. Default: that in the recording."),
    ] = None,
    out: Out = FOLDER,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Find how a camera is turned beside an IMU, and by how much its images are stamped late.

    Turn both quickly about all three axes for half a minute, before a board that stays in sight and does not move. The
    translation between them is not found: it is 0 in FOLDER/camera_imu.yaml, for a measured one to be put in.

    Examples:

      dataflow calibrate camera-imu out/turning.mcap --chessboard 9x6 --square 0.025
      dataflow calibrate camera-imu out/turning.mcap --chessboard 9x6 --square 0.025 --camera out/calibration/camera.yaml
    """  # noqa: E501
    with _in_one_line():
        board = _board(chessboard, charuco, square, marker, dictionary, upright=True)
        files = _places(out, ("camera_imu.yaml",), overwrite)
        with opened(recording) as streams:
            images = images_of(streams, image, "--image")
            inertial = stream_of(streams, imu, (Imu,), "--imu", "samples of an IMU")
            samples = [message for message in inertial if isinstance(message, Imu)]
            seen = look(board, images, spaced(images.stamps, 0.0), _progress(json))
            info = intrinsics_of(streams, seen.frame) if intrinsics is None else read_camera(intrinsics, seen.frame)
        if (info.width, info.height) != seen.size:
            raise ValueError(f"the calibration is of {info.width}x{info.height} pixels, the images have {seen.size}")
        origin = samples[0].stamp if samples else 0
        seconds = np.array([(sample.stamp - origin) * 1e-9 for sample in samples])
        rates = np.array([sample.angular_velocity for sample in samples]).reshape(-1, 3)
        found = mounts.fit_mount(mounts.turning_of(board, seen.views, info, origin), seconds, rates)
        T_imu_camera = np.eye(4)
        T_imu_camera[:3, :3] = found.R_imu_camera
        notes = [
            f"dataflow calibrate camera-imu, from {recording.name}: {found.pairs} turns",
            _late(found) + (f" (a Webcam's `latency: {1e3 * found.offset:.1f}ms`)" if found.offset > 0 else ""),
            "the translation was not measured",
        ]
        _write_transform(files[0], T_imu_camera, samples[0].frame, seen.frame, notes)
        _report(_mount_json(found), _mount_words(found), mounts.warnings_of(found), files, json=json)


# ------------------------------------------------------------------------------------------------------- options


def _board(
    chessboard: str | None, charuco: str | None, square: float, marker: float | None, dictionary: str,
    *, upright: bool = False,
) -> Board:  # fmt: skip
    """The board of the options; `upright`: it must not look the same upside down. Raises ValueError."""
    if square > LARGEST:
        raise ValueError(f"squares of {square:g} m: --square is in metres; 25 mm are 0.025")
    if (chessboard is None) == (charuco is None):
        raise ValueError("one of --chessboard NxM (inner corners) and --charuco NxM (squares) names the board")
    if charuco is not None:
        if marker is None:
            raise ValueError("a ChArUco board needs --marker METRES, the side of its markers")
        columns, rows = _counts("--charuco", charuco)
        return Charuco(columns - 1, rows - 1, square, marker, dictionary.removeprefix("DICT_"))
    assert chessboard is not None
    board = Chessboard(*_counts("--chessboard", chessboard), square)
    if upright and board.ambiguous:
        raise ValueError(
            f"a chessboard with {chessboard} inner corners looks the same upside down, so its corners cannot be "
            "matched between images; take one with an odd and an even number, such as 9x6, or a ChArUco board"
        )
    return board


def _counts(option: str, text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d{1,3})x(\d{1,3})", text)
    if not found:
        raise ValueError(f"{option} takes columns and rows, such as 9x6, got {text!r}")
    return int(found[1]), int(found[2])


def _model(name: str) -> Model:
    for known in MODELS:
        if known == name:
            return known
    raise ValueError(f"no lens model {name!r}; there are {', '.join(MODELS)}")


def _places(folder: Path, names: Sequence[str], overwrite: bool) -> list[Path]:
    """The files that are to be written. Raises FileExistsError."""
    files = [folder / name for name in names]
    there = [str(file) for file in files if file.exists()]
    if there and not overwrite:
        raise FileExistsError(f"{', '.join(there)} is there; --overwrite replaces it, --out FOLDER takes another place")
    return files


# ------------------------------------------------------------------------------------------------------- outcomes


def _pair(both: Sequence[BoardViews], kept: Sequence[CameraCalibration], tolerance: float) -> stereo.Pair:
    """The pair of two cameras, from their views at the same time. Raises ValueError."""
    left, right = both
    if left.size != right.size:
        raise ValueError(f"images of a pair have one size; these have {left.size} and {right.size}")
    pairs = stereo.paired(left.views, right.views, round(tolerance * 1e9))
    chosen = {view.stamp for view in different([view for view, _ in pairs], left.size[0])}
    pairs = [(a, b) for a, b in pairs if a.stamp in chosen and b.blur <= BLURRED]
    return stereo.fit_pair(left.board, pairs, kept[0].info, kept[1].info)


def _write_camera(
    files: Sequence[Path], seen: BoardViews, fitted: CameraCalibration, info: CameraInfo, recording: Path
) -> None:
    text, picture = files
    covered = seen.covered(fitted)
    notes = [
        f"dataflow calibrate, from {recording.name}, {seen.name}: {len(fitted.views)} views, {fitted.rms:.3f} px",
        f"{seen.board}",
        coverage.in_words(covered),
    ]
    text.parent.mkdir(parents=True, exist_ok=True)
    text.write_text(camera_text(info, notes), encoding="utf-8")
    corners = np.concatenate([view.pixels for view in fitted.views])
    cv2.imwrite(str(picture), coverage.picture(covered, corners, fitted.residuals))


def _write_transform(
    file: Path, T_frame_child: np.ndarray[Any, np.dtype[np.float64]], frame: str, child: str, notes: Sequence[str]
) -> None:
    transforms = Transforms.from_matrix(T_frame_child, stamp=0, frame=frame, child_frame=child)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(transforms_text(transforms, notes), encoding="utf-8")


def _camera_words(seen: BoardViews, fitted: CameraCalibration) -> list[str]:
    info, spread = fitted.info, fitted.deviations
    about = [f" ± {value:.2f}" for value in spread] if spread is not None else [""] * 4
    away, odd = fitted.distances, f", {fitted.left_out} odd ones left out" if fitted.left_out else ""
    bent = info.distortion.tolist() if info.distortion is not None else []
    return [
        f"{seen.name}: {len(fitted.views)} views, of {len(seen.views)} with the board in "
        f"{images_looked_at(seen.looked, seen.there)}{odd}; "
        f"residual {fitted.rms:.3f} px, worst view {fitted.errors.max():.3f} px",
        f"  focal lengths {info.fx:.2f}{about[0]}, {info.fy:.2f}{about[1]} px",
        f"  principal point {info.cx:.2f}{about[2]}, {info.cy:.2f}{about[3]} px",
        f"  {info.distortion_model} {', '.join(f'{value:.5f}' for value in bent)}",
        f"  board {away.min():.2f} to {away.max():.2f} m off, tilted {math.degrees(tilts(fitted).max()):.0f}° at most",
        f"  {coverage.in_words(seen.covered(fitted))}",
    ]


def _camera_json(seen: BoardViews, fitted: CameraCalibration) -> dict[str, Any]:
    info, covered = fitted.info, seen.covered(fitted)
    return {
        "stream": seen.name,
        "frame": info.frame,
        "width": info.width,
        "height": info.height,
        "K": info.K.tolist(),
        "distortion_model": info.distortion_model,
        "distortion": [] if info.distortion is None else info.distortion.tolist(),
        "deviations": None if fitted.deviations is None else fitted.deviations.tolist(),
        "images": seen.looked,
        "images_there": seen.there,
        "with_board": len(seen.views),
        "blurred": seen.blurred,
        "views": [
            {"stamp": view.stamp, "rms": round(float(error), 4)}
            for view, error in zip(fitted.views, fitted.errors, strict=True)
        ],
        "left_out": fitted.left_out,
        "rms": round(fitted.rms, 4),
        "covered": round(float((covered > 0).mean()), 4),
        "unseen": coverage.unseen_parts(covered),
    }


def _pair_words(pair: stereo.Pair) -> str:
    return (
        f"pair: {len(pair.apart)} views, residual {pair.rms:.3f} px, rows differ by {_rows(pair):.3f} px "
        f"once rectified; baseline {1e3 * pair.baseline:.2f} mm"
    )


def _pair_json(pair: stereo.Pair) -> dict[str, Any]:
    return {
        "views": len(pair.apart),
        "rms": round(pair.rms, 4),
        "row_difference": round(_rows(pair), 4),
        "baseline": pair.baseline,
        "T_left_right": pair.T_left_right.tolist(),
    }


def _rows(pair: stereo.Pair) -> float:
    return float(np.sqrt((pair.rows**2).mean()))


def _late(found: mounts.CameraImuCalibration) -> str:
    word = "later" if found.offset >= 0 else "earlier"
    return (
        f"images are stamped {abs(1e3 * found.offset):.2f} ± {1e3 * found.offset_deviation:.2f} ms {word} than "
        "the IMU's samples of the same moment"
    )


def _mount_words(found: mounts.CameraImuCalibration) -> list[str]:
    rows = "; ".join(" ".join(f"{value:+.4f}" for value in row) for row in found.R_imu_camera.tolist())
    turning = ", ".join(f"{math.degrees(value):.1f}" for value in found.turning)
    return [
        f"rotation, camera to IMU: {rows} (± {math.degrees(found.rotation_deviation):.3f}°)",
        _late(found),
        f"bias of the gyroscope {', '.join(f'{value:+.4f}' for value in found.bias)} rad/s",
        f"{found.pairs} turns, at {turning} °/s about their principal axes; "
        f"residual {math.degrees(found.residual):.2f} °/s",
    ]


def _mount_json(found: mounts.CameraImuCalibration) -> dict[str, Any]:
    return {
        "R_imu_camera": found.R_imu_camera.tolist(),
        "rotation_deviation": found.rotation_deviation,
        "offset": found.offset,
        "offset_deviation": found.offset_deviation,
        "gyroscope_bias": found.bias.tolist(),
        "residual": found.residual,
        "turning": found.turning.tolist(),
        "turns": found.pairs,
        "imu_rate": found.rate,
    }


# ------------------------------------------------------------------------------------------------------- terminal


def _progress(quiet: bool) -> Along:
    err = Console(stderr=True)

    def along(places: list[int], name: str) -> Iterable[int]:
        return track(places, name, console=err, transient=True, disable=quiet or not err.is_terminal)

    return along


def _report(
    content: Mapping[str, Any], words: Sequence[str], warnings: Sequence[str], files: Sequence[Path], *, json: bool
) -> None:
    if json:
        typer.echo(jsonlib.dumps({**content, "warnings": list(warnings), "files": [str(file) for file in files]}))
        return
    out = Console(highlight=False)
    for line in words:
        out.print(escape(line), soft_wrap=True)
    for warning in warnings:
        out.print(f"[yellow]warning:[/yellow] {escape(warning)}", soft_wrap=True)
    out.print(f"written: {', '.join(map(str, files))}", soft_wrap=True, markup=False)


@contextmanager
def _in_one_line() -> Iterator[None]:
    """Turns errors into one line and exit code 2."""
    try:
        yield
    except (StreamNameError, RecordingError, ValueError, OSError) as error:
        Console(stderr=True).print(f"[bold red]error:[/bold red] {escape(str(error))}", highlight=False, soft_wrap=True)
        raise typer.Exit(COULD_NOT_RUN) from None
