"""Places known again by their look: the share of views whose likest view of an earlier drive shows the same place.

    python benchmarks/places.py [--mobilenet FILE] [--weights FILE]

In simulated worlds that nothing was chosen by a robot drives through each, and again later, slower, with its camera
mounted elsewhere (`higher`, `turned`). The views of the second drive are looked for among those of the first of *all*
worlds. The answer is right within 1 m and 45 degrees of where the second was; only views that have such an answer
count. Also, as a loop closure asks: the views of the first drive among those of the same drive that are 10 s older.
Views are described by `FeatureExtractor`, with torchvision's mobilenet_v2 and the weights of ImageNet in `--mobilenet`,
or with a file of `dataflow train classifier`; beside them a histogram of colours and the image shrunk to 16x12.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
REPOSITORY = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(REPOSITORY))

import cv2  # noqa: E402
import numpy as np  # noqa: E402
from numpy.typing import NDArray  # noqa: E402

from dataflow.messages import Image  # noqa: E402
from operators.recognition import FeatureExtractor  # noqa: E402
from operators.simulator import SimulatedRobot  # noqa: E402
from operators.simulator.worlds.make import INDOOR, make_world  # noqa: E402

Pixels = NDArray[np.uint8]
Describe = Callable[[Pixels], NDArray[np.float32]]

FIRST = 75_000
"""Seed of the first world."""
SIZE = (192, 128)
SECONDS, RATE = 50, 2.0
NEAR, ALIKE = 1.0, np.pi / 4
OLDER = 10.0  # seconds, of a loop closure
MOUNTS: dict[str, tuple[float, tuple[float, ...]]] = {  # speed, shift of the camera (metres, radians)
    "own": (0.8, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)),
    "higher": (0.6, (0.0, 0.0, 0.25, 0.0, 0.15, 0.0)),
    "turned": (0.5, (0.1, 0.15, -0.15, 0.0, 0.0, 0.35)),
}


@dataclass(frozen=True, eq=False)
class Drive:
    """Views (N, H, W, 3), positions (N, 2) and headings (N,) of the camera in its world, seconds (N,)."""

    world: str
    views: Pixels
    positions: NDArray[np.float64]
    headings: NDArray[np.float64]
    seconds: NDArray[np.float64]


def drive(world: str, seed: int, mount: str, cache: Path) -> Drive:
    """Renders a drive, or reads it where it was rendered before."""
    file = cache / f"{world}_{seed}_{mount}.npz"
    if not file.is_file():
        views, poses, stamps = _rendered(world, seed, mount)
        cache.mkdir(parents=True, exist_ok=True)
        np.savez(file, views=views, poses=poses, stamps=stamps)
    with np.load(file) as d:
        poses = d["poses"]
        ahead = poses[:, :2, 2]  # the optical axis, seen from above
        return Drive(
            f"{world} {seed}",
            d["views"],
            poses[:, :2, 3],
            np.arctan2(ahead[:, 1], ahead[:, 0]),
            (d["stamps"] - d["stamps"][0]) / 1e9,
        )


def _rendered(world: str, seed: int, mount: str) -> tuple[Pixels, NDArray[np.float64], NDArray[np.int64]]:
    speed, shift = MOUNTS[mount]
    own = np.array(make_world(world, seed, speed=speed, hold=0.0, movers=True).camera_mount)
    robot = SimulatedRobot(
        world=world,
        seed=seed,
        duration=f"{SECONDS}s",
        speed=speed,
        color_camera={"rate": RATE, "width": SIZE[0], "height": SIZE[1], "mount": tuple(own + shift)},
        depth_camera={"rate": 0},
        truth={"poses": RATE, "boxes": False, "relations": 0, "activities": 0},
    )
    robot.setup()
    try:
        seen: list[Any] = [m for m in robot.stream() if "image" in m and "ground_truth" in m]
    finally:
        robot.close()
    return (
        np.array([m["image"].data for m in seen]),
        np.array([m["ground_truth"].matrix() for m in seen]),
        np.array([m["image"].stamp for m in seen], np.int64),
    )


def worlds(count: int) -> list[tuple[str, int]]:
    return [(INDOOR[k % len(INDOOR)], FIRST + k) for k in range(count)]


def colors(view: Pixels) -> NDArray[np.float32]:
    """A histogram of 8 levels of each colour, as the root of its shares (their product is Bhattacharyya's)."""
    bins = (view // 32).reshape(-1, 3).astype(np.int64) @ (64, 8, 1)
    counts = np.bincount(bins, minlength=512).astype(np.float32)
    return np.asarray(np.sqrt(counts / counts.sum()), np.float32)


def shrunk(view: Pixels) -> NDArray[np.float32]:
    """The image in 16x12 pixels, without its mean, of length 1."""
    small = cv2.resize(view, (16, 12), interpolation=cv2.INTER_AREA).astype(np.float32).ravel()
    small -= small.mean()
    return np.asarray(small / max(float(np.linalg.norm(small)), 1e-6), np.float32)


def extractor(**parameters: Any) -> Describe:
    operator = FeatureExtractor(**parameters)
    operator.setup()

    def describe(view: Pixels) -> NDArray[np.float32]:
        features = operator.process(Image(stamp=0, frame="camera", data=view), None)
        return np.asarray(features.vectors[0], np.float32)

    return describe


def with_head(weights: Path, file: Path) -> Path:
    """Weights of mobilenet_v2 may come without their last layer, which a description does not use."""
    import torch

    from operators.learning.backbone import current_names

    state = dict(current_names(torch.load(weights, map_location="cpu", weights_only=True)))
    state.setdefault("classifier.1.weight", torch.zeros(1000, 1280))
    state.setdefault("classifier.1.bias", torch.zeros(1000))
    torch.save(state, file)
    return file


def described(drives: list[Drive], describe: Describe) -> list[NDArray[np.float32]]:
    return [np.array([describe(view) for view in d.views]) for d in drives]


def same_place(query: Drive, base: Drive) -> NDArray[np.bool_]:
    """Pairs (Q, B) of views that show the same place of the same world."""
    if query.world != base.world:
        return np.zeros((len(query.views), len(base.views)), np.bool_)
    far = np.linalg.norm(query.positions[:, None] - base.positions[None], axis=2)
    turned = np.abs(np.angle(np.exp(1j * (query.headings[:, None] - base.headings[None]))))
    return np.asarray((far <= NEAR) & (turned <= ALIKE))


def known_again(queries: list[Drive], bases: list[Drive], q: list[Any], b: list[Any]) -> list[tuple[int, int]]:
    """Counts of each query drive: views with an answer, and those whose likest view of all bases is one."""
    every = np.concatenate(b)
    rows = []
    for drive_, features in zip(queries, q, strict=True):
        right = np.concatenate([same_place(drive_, base) for base in bases], axis=1)
        asked = right.any(axis=1)
        first = (features @ every.T).argmax(axis=1)
        rows.append((int(asked.sum()), int((asked & right[np.arange(len(first)), first]).sum())))
    return rows


def loops(drives: list[Drive], b: list[Any]) -> list[tuple[int, int]]:
    """The same within a drive: among its own views that are `OLDER` seconds older."""
    rows = []
    for drive_, features in zip(drives, b, strict=True):
        older = drive_.seconds[:, None] - drive_.seconds[None] >= OLDER
        right = same_place(drive_, drive_) & older
        asked = right.any(axis=1)
        first = np.where(older, features @ features.T, -np.inf).argmax(axis=1)
        rows.append((int(asked.sum()), int((asked & right[np.arange(len(first)), first]).sum())))
    return rows


def recalls(rows: list[tuple[int, int]]) -> dict[str, float]:
    """Recall@1 over all views, and of the worst world with ten views or more."""
    asked, right = np.array(rows).sum(axis=0)
    each = [b / a for a, b in rows if a >= 10]
    return {"asked": int(asked), "recall": float(right / asked), "worst": min(each)}


def score(weights: Path | None, mobilenet: Path | None, count: int, cache: Path) -> dict[str, Any]:
    ways: dict[str, Describe] = {"colours": colors, "16x12 pixels": shrunk}
    if mobilenet is not None:
        with tempfile.TemporaryDirectory() as folder:
            checkpoint = with_head(mobilenet, Path(folder) / "mobilenet_v2.pt")
            ways["mobilenet_v2, ImageNet"] = extractor(model="mobilenet_v2", checkpoint=str(checkpoint))
    if weights is not None:
        ways[weights.name] = extractor(weights=str(weights))
    own = [drive(world, seed, "own", cache) for world, seed in worlds(count)]
    others = {m: [drive(w, s, m, cache) for w, s in worlds(count)] for m in MOUNTS if m != "own"}
    table: dict[str, Any] = {}
    for name, describe in ways.items():
        base = described(own, describe)
        row = {"loops": recalls(loops(own, base))}
        for mount, drives in others.items():
            row[mount] = recalls(known_again(drives, own, described(drives, describe), base))
        table[name] = row
        cells = [f"{row[k]['recall']:.3f} ({row[k]['worst']:.2f})" for k in ("loops", *others)]
        print(f"| {name} | {' | '.join(cells)} |", flush=True)
    print({k: v["asked"] for k, v in row.items()})
    return table


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mobilenet", type=Path, help="state dict of torchvision's mobilenet_v2")
    parser.add_argument("--weights", type=Path, help="a file of `dataflow train classifier`")
    parser.add_argument("--worlds", type=int, default=12, help="how many")
    parser.add_argument("--cache", type=Path, default=Path("out") / "places", help="folder of rendered drives")
    parser.add_argument("--json", type=Path, help="file for all figures")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    table = score(arguments.weights, arguments.mobilenet, arguments.worlds, arguments.cache)
    if arguments.json:
        arguments.json.write_text(json.dumps(table, indent=2) + "\n")


if __name__ == "__main__":
    main()
