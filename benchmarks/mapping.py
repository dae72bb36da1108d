"""Scores the occupancy grid and the surface map against the simulator's truth, world by world.

python benchmarks/mapping.py occupancy
python benchmarks/mapping.py surface
"""

from __future__ import annotations

import argparse
import os
import time
from typing import Any

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import numpy as np  # noqa: E402
from moving_things import LastSeen, Movers  # noqa: E402
from numpy.typing import NDArray  # noqa: E402
from scipy.ndimage import binary_dilation  # noqa: E402
from scipy.spatial import cKDTree  # noqa: E402

from dataflow.messages import (  # noqa: E402
    CameraInfo,
    DepthImage,
    Mesh,
    Message,
    OccupancyGrid,
    Odometry,
    PointCloud,
    Pose,
    SceneGraph,
)
from dataflow.messages import Transforms as TransformSet  # noqa: E402
from dataflow.messages.geometry import transform_points  # noqa: E402
from operators.cloud.cloud_builder import Rays, beside_edge, within_range  # noqa: E402
from operators.mapping import OccupancyMapper, TsdfMap  # noqa: E402
from operators.mapping.placing import placed  # noqa: E402
from operators.simulator import SimulatedRobot  # noqa: E402

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
WORLDS = ("office", "corridor", "table_top", "yard")
BAND = (0.05, 1.5)


def robot(world: str, seed: int, seconds: int, **more: Any) -> SimulatedRobot:
    """A robot on a tour among movers, with depth camera and LiDAR at 4 Hz unless set in `more`."""
    truth_of: dict[str, Any] = {"poses": 4.0, "boxes": False, "relations": 0.0, "activities": 0.0}
    params: dict[str, Any] = {
        "color_camera": {"rate": 0.0},
        "depth_camera": {"rate": 4.0},
        "lidar": {"rate": 4.0, "motion": True},
        "truth": truth_of | more.pop("truth", {}),
    }
    source = SimulatedRobot(world=world, seed=seed, duration=f"{seconds}s", route="tour", **(params | more))
    source.setup()
    return source


def moving_things(world: str, seed: int, seconds: int) -> Movers:
    """What moves in the same drive."""
    none = {"rate": 0.0}
    source = robot(world, seed, seconds, depth_camera=none, lidar=none, truth={"relations": 4.0, "spatial": False})
    found = (messages.get("scene") for messages in source.stream())
    return Movers({scene.stamp: scene for scene in found if isinstance(scene, SceneGraph)})


def depth_cloud(depth: DepthImage, info: CameraInfo) -> PointCloud:
    rays = Rays.through(info.K, (info.width, info.height), 3)
    usable = within_range(depth.data, 3, 0.3, 6.0) & ~beside_edge(depth.data, 3, 0.05)
    return PointCloud(stamp=depth.stamp, frame=depth.frame, points=rays.back_project(depth.data, usable))


class Scored:
    """One mapper on one sensor, with the true cells that its points fell into."""

    def __init__(self, truth: OccupancyGrid, solid: Mask, movers: Movers, **params: Any) -> None:
        self.mapper = OccupancyMapper(period=1_000_000, **params)
        self.mapper.setup()
        self.truth, self.solid, self.far = truth, solid, params["far"]
        self.last_seen = LastSeen(truth, movers, BAND)
        self.touched = np.zeros(truth.cells.shape, np.bool_)
        self.milliseconds: list[float] = []
        self.stamp = 0

    def add(self, cloud: PointCloud, pose: Pose | Odometry, extrinsics: TransformSet) -> None:
        begin = time.process_time()
        self.mapper.process(cloud, pose, extrinsics)
        self.milliseconds.append(1e3 * (time.process_time() - begin))
        self.stamp = cloud.stamp
        seen = placed(cloud, pose, extrinsics)
        assert seen is not None
        self.last_seen.add(self.stamp, seen.origin, seen.points, self.far)
        p = seen.points[np.linalg.norm(seen.points - seen.origin, axis=1) <= self.far]
        p = p[(p[:, 2] >= BAND[0]) & (p[:, 2] < BAND[1])]
        cell = np.floor((p[:, :2] - self.truth.position[:2]) / self.truth.resolution).astype(int)
        cell = cell[(cell >= 0).all(axis=1) & (cell < self.truth.cells.shape[::-1]).all(axis=1)]
        self.touched[cell[:, 1], cell[:, 0]] = True

    def row(self) -> list[float]:
        """IoU of free, of occupied, of occupied to within a cell; precision and recall of the last, known share, ms.

        Scored are the cells that are known in the map or contain a point. Occupied cells without a point (the inside
        of furniture) are left out of occupied, and count as wrong where the map has them free. Cells that are neither
        free nor hold a surface (the inside of walls, where no robot can be) are left out of occupied. Where a mover
        stood when the sensor last looked, neither is wrong.
        """
        held = self.last_seen.held & ~self.solid
        found = _on_grid(self.mapper.process(*_last(self))["map"], self.truth)
        taken, free = (found > 50) & ~held, (found >= 0) & (found <= 50) & ~held
        true_free = (self.truth.cells == 0) & ~self.solid & ~held
        seen = self.solid & self.touched
        known = (found >= 0) | self.touched
        near_true, near_found = (binary_dilation(m, np.ones((3, 3))) for m in (self.solid, taken))
        right, false, missed = (taken & near_true).sum(), (taken & ~near_true).sum(), (seen & ~near_found).sum()
        strict = (taken & self.solid).sum()
        return [
            _iou(free, true_free & known),
            float(strict / (strict + (taken & true_free).sum() + (seen & ~taken).sum())),
            float(right / (right + false + missed)),
            float(right / max(1, right + false)),
            float(1 - missed / max(1, seen.sum())),
            float((known & (self.truth.cells >= 0)).sum() / (self.truth.cells >= 0).sum()),
            float(np.median(self.milliseconds)),
        ]


def solid(truth: OccupancyGrid, mesh: Mesh) -> Mask:
    """Cells that hold a surface of the mesh within the band, those on either side of a surface on their border too."""
    points = on_surface(mesh.vertices.astype(np.float64), mesh.triangles, 8000, np.random.default_rng(0))
    points = points[(points[:, 2] >= BAND[0]) & (points[:, 2] <= BAND[1])]
    found: Mask = truth.cells == 100
    for x, y in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
        cell = np.floor((points[:, :2] + [1e-3 * x, 1e-3 * y] - truth.position[:2]) / truth.resolution).astype(int)
        cell = cell[(cell >= 0).all(axis=1) & (cell < found.shape[::-1]).all(axis=1)]
        found[cell[:, 1], cell[:, 0]] = True
    return found


def _last(scored: Scored) -> tuple[PointCloud, Pose]:
    """Returns an empty cloud that makes the mapper give its map."""
    scored.mapper.period = 1
    frame = scored.truth.frame
    nothing = PointCloud(stamp=scored.stamp, frame="none", points=np.zeros((0, 3), np.float32))
    return nothing, Pose(
        stamp=scored.stamp, frame=frame, position=np.zeros(3), orientation=np.array([0.0, 0.0, 0.0, 1.0])
    )


def _iou(a: Mask, b: Mask) -> float:
    return float((a & b).sum() / max(1, (a | b).sum()))


def _on_grid(found: Message, truth: OccupancyGrid) -> NDArray[np.int16]:
    """Returns the cells of a map on the grid of the true one; -1 where it does not reach."""
    assert isinstance(found, OccupancyGrid)
    row, column = (int(n) for n in np.rint((found.position[1::-1] - truth.position[1::-1]) / truth.resolution))
    out = np.full(truth.cells.shape, -1, np.int16)
    rows, columns = (
        slice(max(0, at), min(size, at + own))
        for at, size, own in zip((row, column), truth.cells.shape, found.cells.shape, strict=True)
    )
    out[rows, columns] = found.cells[rows.start - row : rows.stop - row, columns.start - column : columns.stop - column]
    return out


def occupancy(worlds: list[str], seeds: list[int], seconds: int) -> None:
    columns = "world | sensor | IoU free | IoU occupied, exact | to a cell | precision | recall | known | CPU ms"
    print(f"| {columns} |")
    print("| --- " * 9 + "|")
    rows: dict[str, list[list[float]]] = {"lidar": [], "depth": []}
    for world in worlds:
        for seed in seeds:
            source = robot(world, seed, seconds, truth={"occupancy": True, "band": BAND, "mesh": True})
            static = source.static_outputs()
            truth, info, extrinsics = static["occupancy"], static["depth_info"], static["extrinsics"]
            mesh = static["mesh"]
            assert isinstance(truth, OccupancyGrid)
            assert isinstance(mesh, Mesh)
            assert isinstance(info, CameraInfo)
            assert isinstance(extrinsics, TransformSet)
            true = solid(truth, mesh)
            movers = moving_things(world, seed, seconds)
            scored = {name: Scored(truth, true, movers, far=far) for name, far in (("lidar", 8.0), ("depth", 4.0))}
            for messages in source.stream():
                depth, points = messages.get("depth"), messages.get("points")
                base, camera = messages.get("true_base"), messages.get("ground_truth")
                if isinstance(points, PointCloud) and isinstance(base, Odometry):
                    scored["lidar"].add(points, base, extrinsics)
                if isinstance(depth, DepthImage) and isinstance(camera, Pose):
                    scored["depth"].add(depth_cloud(depth, info), camera, extrinsics)
            for name, one in scored.items():
                rows[name].append(one.row())
                print(f"| {world} {seed} | {name} | " + _cells(rows[name][-1]), flush=True)
    for name, found in rows.items():
        print(f"| mean | {name} | " + _cells(np.mean(found, axis=0).tolist()))
        print(f"| worst | {name} | " + _cells([*np.min(found, axis=0)[:-1], np.max(found, axis=0)[-1]]))


def _cells(values: list[float]) -> str:
    return " | ".join(f"{v:.3f}" for v in values[:-1]) + f" | {values[-1]:.0f} |"


class Ours:
    """TsdfMap, and the CPU milliseconds of each image and of the mesh."""

    def __init__(self, info: CameraInfo) -> None:
        self.operator, self.info = TsdfMap(period=1_000_000), info
        self.operator.setup()

    def add(self, depth: DepthImage, pose: Pose) -> None:
        self.operator.process(depth, pose, self.info)

    def mesh(self, stamp: int, frame: str) -> tuple[Array, NDArray[Any]]:
        self.operator.period = 1
        nothing = DepthImage(
            stamp=stamp, frame=self.info.frame, data=np.zeros((self.info.height, self.info.width), np.float32)
        )
        pose = Pose(stamp=stamp, frame=frame, position=np.zeros(3), orientation=np.array([0.0, 0.0, 0.0, 1.0]))
        mesh = self.operator.process(nothing, pose, self.info)["mesh"]
        assert isinstance(mesh, Mesh)
        return mesh.vertices.astype(np.float64), mesh.triangles


def on_surface(vertices: Array, triangles: NDArray[Any], per_square_metre: float, rng: np.random.Generator) -> Array:
    """Points (N, 3) drawn evenly from the surface."""
    corners = vertices[triangles]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    corners, area = corners[area > 0], area[area > 0]
    chosen = rng.choice(len(corners), int(area.sum() * per_square_metre), p=area / area.sum())
    root, second = np.sqrt(rng.random(len(chosen))), rng.random(len(chosen))
    weights = np.stack([1 - root, root * (1 - second), root * second], axis=1)
    return np.asarray(np.einsum("nk,nkd->nd", weights, corners[chosen]), np.float64)


def near(points: Array, others: Array, distance: float) -> Mask:
    return np.asarray(np.isfinite(cKDTree(others).query(points, distance_upper_bound=distance)[0]))


def surface(worlds: list[str], seeds: list[int], seconds: int) -> None:
    """Precision is over the mesh; recall over the true surface within 2 cm of noise-free returns nearer than 4 m."""
    print("| world | F(5 cm) | precision | recall | mean distance, cm | CPU ms an image | mesh, s |")
    print("| --- " * 7 + "|")
    rows: list[list[float]] = []
    for world in worlds:
        for seed in seeds:
            source = robot(world, seed, seconds, truth={"mesh": True}, lidar={"rate": 0.0})
            exact = {"rate": 4.0, "noise": 0.0, "quantum": 0.0002, "edge_holes": 0.0, "specks": 0.0}
            clean = robot(world, seed, seconds, lidar={"rate": 0.0}, depth_camera=exact)
            static = source.static_outputs()
            true, info = static["mesh"], static["depth_info"]
            assert isinstance(true, Mesh)
            assert isinstance(info, CameraInfo)
            one, spent = Ours(info), list[float]()
            returns = []
            for measured, sharp in zip(source.stream(), clean.stream(), strict=True):
                depth, pose, ideal = measured["depth"], measured["ground_truth"], sharp["depth"]
                assert isinstance(depth, DepthImage)
                assert isinstance(pose, Pose)
                assert isinstance(ideal, DepthImage)
                frame = pose.frame
                begin = time.process_time()
                one.add(depth, pose)
                spent.append(1e3 * (time.process_time() - begin))
                seen = depth_cloud(ideal, info).points.astype(np.float64)
                returns.append(transform_points(pose.matrix(), seen[seen[:, 2] < 4.0]))
            rng = np.random.default_rng(0)
            still = on_surface(true.vertices.astype(np.float64), true.triangles, 4000, rng)
            due = still[rng.random(len(still)) < 0.2]
            due = due[near(due, np.concatenate(returns), 0.02)]
            tree = cKDTree(still)
            begin = time.process_time()
            vertices, triangles = one.mesh(depth.stamp, frame)
            took = time.process_time() - begin
            found = on_surface(vertices, triangles, 1000, rng)
            off = tree.query(found, distance_upper_bound=0.3)[0]
            precision, recall = float((off < 0.05).mean()), float(near(due, found, 0.05).mean())
            score = 2 * precision * recall / (precision + recall)
            mean = 100 * float(np.minimum(off, 0.3).mean())
            rows.append([score, precision, recall, mean, float(np.median(spent)), took])
            print(f"| {world} {seed} | " + _figures(rows[-1]), flush=True)
    worst = [*np.min(rows, axis=0)[:3], *np.max(rows, axis=0)[3:]]
    print("| mean | " + _figures(np.mean(rows, axis=0).tolist()))
    print("| worst | " + _figures(worst))


def _figures(values: list[float]) -> str:
    return (
        f"{values[0]:.3f} | {values[1]:.3f} | {values[2]:.3f} | {values[3]:.2f} | {values[4]:.0f} | {values[5]:.1f} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["occupancy", "surface"])
    parser.add_argument("--worlds", nargs="+", default=list(WORLDS))
    parser.add_argument("--seeds", type=int, nargs="+", default=[21, 22])
    parser.add_argument("--seconds", type=int, default=30)
    arguments = parser.parse_args()
    {"occupancy": occupancy, "surface": surface}[arguments.what](arguments.worlds, arguments.seeds, arguments.seconds)


if __name__ == "__main__":
    main()
