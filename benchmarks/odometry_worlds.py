"""RGB-D odometry in simulated worlds: every pose as it was emitted against the truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from dataflow.messages.geometry import invert
from operators.codec import DepthDecoder, ImageDecoder
from operators.evaluation.trajectory import align
from operators.geometry import se3
from operators.geometry.extrinsics import transform_between
from operators.odometry.rgbd.camera import RgbdCamera
from operators.odometry.rgbd.tracker import RgbdOdometry
from operators.odometry.tracking import Status, TrackResult
from operators.simulator import SimulatedRobot

Array = NDArray[np.float64]

GRAPH = Path(__file__).resolve().parent.parent / "graphs" / "simulated_robot.yaml"
WORLDS = tuple(f"{kind}:{seed}" for kind in ("office", "corridor", "table_top") for seed in range(821, 825))
SECONDS = 40
DRAWS = 200  # of errors as they would be with an exact covariance
BOUND = 12.592  # squared sigmas that 95 % of errors of 6 degrees of freedom lie within


@dataclass(frozen=True, eq=False)
class Drive:
    """Images (N, H, W, 3), depths (N, H, W), true camera poses (N, 4, 4), stamps (N,)."""

    image: NDArray[np.uint8]
    depth: NDArray[np.float32]
    truth: Array
    stamps: NDArray[np.int64]
    camera: RgbdCamera


def rendered(cache: Path, world: str) -> Drive:
    """Returns the drive of a world KIND:SEED as `graphs/simulated_robot.yaml` has it, movers on; rendered once."""
    kind, _, seed = world.partition(":")
    file = cache / f"odometry_{kind}_{seed}_{SECONDS}s.npz"
    if not file.is_file():
        _render(file, kind, int(seed))
    d = np.load(file)
    return Drive(d["image"], d["depth"], d["truth"], d["stamps"], RgbdCamera(d["K_color"], d["K_depth"], d["T"]))


def _render(file: Path, kind: str, seed: int) -> None:
    given: dict[str, Any] = yaml.safe_load(GRAPH.read_text())["operators"]["robot"]["params"]
    sensed = {name: given[name] for name in ("first_stamp", "color_camera", "depth_camera")}
    truth = {"poses": 10, "boxes": False, "relations": 0, "activities": 0}
    robot = SimulatedRobot(world=kind, seed=seed, duration=f"{SECONDS}s", truth=truth, **sensed)
    robot.setup()
    static: dict[str, Any] = dict(robot.static_outputs())
    color, depth = ImageDecoder(), DepthDecoder()
    messages: list[dict[str, Any]] = [dict(m) for m in robot.stream()]
    color_info, depth_info = static["image_info"], static["depth_info"]
    file.parent.mkdir(parents=True, exist_ok=True)
    np.savez(
        file,
        image=np.array([color.decode(m["image_jpeg"]).data for m in messages]),
        depth=np.array([depth.decode(m["depth_png"]).data for m in messages]),
        truth=np.array([m["ground_truth"].matrix() for m in messages]),
        stamps=np.array([m["image_jpeg"].stamp for m in messages], np.int64),
        K_color=color_info.K,
        K_depth=depth_info.K,
        T=transform_between(static["extrinsics"], color_info.frame, depth_info.frame),
    )


def followed(drive: Drive) -> list[TrackResult]:
    odometry = RgbdOdometry(drive.camera)
    frames = zip(drive.image, drive.depth, drive.stamps.tolist(), strict=True)
    return [odometry.track(*frame) for frame in frames]


def squared(drive: Drive, results: list[TrackResult]) -> Array:
    """Returns a sixth of the squared errors (N - 1,) of emitted poses after the first, in units of their covariance."""
    T = drive.truth[0] @ invert(results[0].T_world_camera)
    errors = [se3.log(invert(true) @ T @ r.T_world_camera) for true, r in zip(drive.truth, results, strict=True)]
    return np.array([e @ np.linalg.solve(r.covariance, e) / 6 for e, r in zip(errors[1:], results[1:], strict=True)])


def drawn(results: list[TrackResult], rng: np.random.Generator) -> Array:
    """Returns what `squared` would be, (DRAWS, N - 1), were every covariance exact: errors are drawn as the covariances
    say, a frame's from its keyframe's and what was added to it, so they hang together as those of a drive do."""
    known, errors, squares = results[0], np.zeros((DRAWS, 6)), []
    for r in results[1:]:
        A = se3.adjoint(invert(r.T_world_camera) @ known.T_world_camera)
        values, axes = np.linalg.eigh(r.covariance - A @ known.covariance @ A.T)
        own = rng.normal(size=(DRAWS, 6)) @ (axes * np.sqrt(np.maximum(values, 0.0))).T
        error = errors @ A.T + own
        squares.append(np.einsum("ni,ni->n", error, np.linalg.solve(r.covariance, error.T).T) / 6)
        if r.keyframe:
            known, errors = r, error
    return np.array(squares).T


def scored(drive: Drive, results: list[TrackResult], square: Array) -> dict[str, float]:
    """Returns ATE and the largest step error while tracking in centimetres, the share of frames tracked, the median of
    squared errors of emitted poses, and the share of frames where these are above the 95 % bound."""
    poses = np.array([r.T_world_camera for r in results])
    tracking = np.array([r.status is Status.TRACKING for r in results])
    R, t, _ = align(poses[:, :3, 3], drive.truth[:, :3, 3], scaled=False)
    off = poses[:, :3, 3] @ R.T + t - drive.truth[:, :3, 3]
    steps = [
        np.linalg.norm((invert(invert(a) @ b) @ (invert(c) @ d))[:3, 3])
        for a, b, c, d in zip(drive.truth, drive.truth[1:], poses, poses[1:], strict=False)
    ]
    return {
        "ATE cm": 100 * float(np.sqrt((off**2).sum(axis=1).mean())),
        "worst step cm": 100 * float(np.array(steps)[tracking[1:]].max(initial=0.0)),
        "tracking %": 100 * float(tracking.mean()),
        "NEES/6, median": float(np.median(square)),
        "above 95 % bound, %": 100 * float((square > BOUND / 6).mean()),
    }


def table(worlds: list[str], cache: Path) -> None:
    """Prints the score of each world, their mean, the worst of each figure, and what an exact covariance would have."""
    rows, squares, draws, rng = list[dict[str, float]](), list[Array](), list[Array](), np.random.default_rng(1)
    for world in worlds:
        drive = rendered(cache, world)
        results = followed(drive)
        squares.append(squared(drive, results))
        draws.append(drawn(results, rng))
        row = scored(drive, results, squares[-1])
        if not rows:
            print(f"| world | {' | '.join(row)} |\n| --- |{' ---: |' * len(row)}")
        rows.append(row)
        _show(world.replace(":", " "), row)
    _show("mean", {name: float(np.mean([row[name] for row in rows])) for name in rows[0]})
    _show("worst", {name: _worst(name, [row[name] for row in rows]) for name in rows[0]})
    print("\n| of all worlds | here | exact covariance, mean | 95 % of draws |\n| --- | ---: | ---: | ---: |")
    exact = [_together([of_world[i] for of_world in draws]) for i in range(DRAWS)]
    for name, value in _together(squares).items():
        values = [one[name] for one in exact]
        low, high = np.quantile(values, [0.025, 0.975])
        print(f"| {name} | {value:.2f} | {np.mean(values):.2f} | {low:.2f} to {high:.2f} |")


def _together(squares: list[Array]) -> dict[str, float]:
    medians, above = [float(np.median(s)) for s in squares], [float((s > BOUND / 6).mean()) for s in squares]
    return {
        "NEES/6, median of all frames": float(np.median(np.concatenate(squares))),
        "NEES/6, mean": float(np.mean(np.concatenate(squares))),
        "frames above the 95 % bound, %": 100 * float(np.mean(above)),
        "worlds with a median outside 0.5 to 2": float(sum(not 0.5 <= m <= 2 for m in medians)),
        "worlds with a median below 0.5": float(sum(m < 0.5 for m in medians)),
        "worlds with more than 10 % above the bound": float(sum(a > 0.1 for a in above)),
    }


def _worst(name: str, values: list[float]) -> float:
    if name.startswith("tracking"):
        return min(values)
    return max(values, key=lambda x: abs(np.log(x))) if name.startswith("NEES") else max(values)


def _show(name: str, row: dict[str, float]) -> None:
    print(f"| {name} | {' | '.join(f'{value:.2f}' for value in row.values())} |", flush=True)
