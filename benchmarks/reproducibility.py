"""Is a library repeatable in the mode it is used in? Each mode runs in many processes; one digest means yes.

python benchmarks/reproducibility.py [--runs 20] [--only WORD]
"""

from __future__ import annotations

import argparse
import os
import platform
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

import numpy as np
import numpy.typing as npt
import xxhash

from dataflow.execution.threads import environment

Floats = npt.NDArray[np.float64]
SECONDS = 120.0


@dataclass(frozen=True, slots=True)
class Mode:
    """A library in one setting. `allowed`: in operators; the others show what those stay away from."""

    library: str
    package: str
    what: str
    threads: int
    allowed: bool
    work: Callable[[int], bytes]

    @property
    def name(self) -> str:
        return f"{self.library}, {self.what}, {self.threads} thread{'s' if self.threads > 1 else ''}"


def scans() -> tuple[Floats, Floats]:
    """Two noisy scans of one room, (N, 3) metres, from slightly different places."""
    rng = np.random.default_rng(7)
    n = 6000
    floor = np.column_stack([rng.uniform(-5, 5, n), rng.uniform(-4, 4, n), np.zeros(n)])
    wall = np.column_stack([np.full(n, 5.0), rng.uniform(-4, 4, n), rng.uniform(0, 3, n)])
    side = np.column_stack([rng.uniform(-5, 5, n), np.full(n, 4.0), rng.uniform(0, 3, n)])
    box = rng.uniform([1, -1, 0], [2, 0, 1], (n // 3, 3))
    room = np.concatenate([floor, wall, side, box])
    angle = 0.03
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    moved = room @ turn.T + [0.1, -0.05, 0.01]
    return room + rng.normal(0, 0.01, room.shape), moved + rng.normal(0, 0.01, room.shape)


def images() -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.uint8]]:
    """Two views of one texture, (480, 640) uint8, a few pixels apart."""
    import cv2

    noise: Any = np.random.default_rng(7).integers(0, 256, (520, 700), np.uint8)
    texture = cv2.equalizeHist(cv2.GaussianBlur(noise, (0, 0), 2.0)).astype(np.uint8)
    return np.ascontiguousarray(texture[:480, :640]), np.ascontiguousarray(texture[3:483, 5:645])


def raw(*values: Any) -> bytes:
    """The bytes of arrays and numbers, one after the other."""
    return b"".join(np.asarray(value).tobytes() for value in values)


def small_gicp(threads: int) -> bytes:
    import small_gicp

    target, source = scans()
    result = small_gicp.align(target, source, downsampling_resolution=0.1, num_threads=threads)
    return raw(result.T_target_source, result.H, result.error)


def open3d_icp(threads: int) -> bytes:
    from operators.simulator.rendering.native import open3d

    o3d = open3d()
    clouds = []
    for points in scans():
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius=0.3, max_nn=30))
        clouds.append(cloud)
    found = o3d.pipelines.registration.registration_icp(
        clouds[1],
        clouds[0],
        0.5,
        np.eye(4),
        o3d.pipelines.registration.TransformationEstimationPointToPlane(),
    )
    return raw(found.transformation, found.inlier_rmse)


def kiss_icp(threads: int) -> bytes:
    from kiss_icp.config import KISSConfig
    from kiss_icp.kiss_icp import KissICP

    config = KISSConfig()
    config.data.deskew = False
    config.mapping.voxel_size = 0.2
    config.registration.max_num_threads = threads
    odometry = KissICP(config)
    for points in (*scans(), *scans()):
        odometry.register_frame(points, np.linspace(0, 1, len(points)))
    return raw(odometry.last_pose)


def opencv_tracking(threads: int) -> bytes:
    """What visual odometry does: corners, pyramidal Lucas-Kanade, a pose by RANSAC."""
    import cv2

    cv2.setNumThreads(threads)
    cv2.setRNGSeed(1)
    before, after = images()
    nowhere: Any = None
    corners: Any = cv2.goodFeaturesToTrack(before, 800, 0.01, 8)
    moved, status, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, nowhere, winSize=(21, 21), maxLevel=3)
    seen = status[:, 0] == 1
    depth = 1.0 + np.random.default_rng(3).random(int(seen.sum()))
    camera = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
    rays = (corners[seen, 0].astype(np.float64) - [320, 240]) / 500
    points = np.column_stack([rays * depth[:, None], depth])
    _, rotation, translation, inliers = cv2.solvePnPRansac(points, moved[seen].astype(np.float64), camera, None)
    return raw(moved, rotation, translation, inliers)


def opencv_stereo(threads: int) -> bytes:
    """What stereo depth does: semi-global matching in three directions."""
    import cv2

    cv2.setNumThreads(threads)
    left, right = images()
    matcher: Any = cv2.StereoSGBM.create(0, 128, 5, 200, 800, mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY)
    return raw(matcher.compute(left, right))


def opencv_filters(threads: int) -> bytes:
    """What cloud building, the simulator and network inputs do: resampling and smoothing in floating point."""
    import cv2

    cv2.setNumThreads(threads)
    image = images()[0].astype(np.float32) / 255
    rows, columns = np.mgrid[0:480, 0:640].astype(np.float32)
    bent = cv2.remap(image, columns + 3 * np.sin(rows / 20), rows + 2 * np.cos(columns / 30), cv2.INTER_LINEAR)
    small = cv2.resize(cv2.GaussianBlur(bent, (0, 0), 1.5), (352, 352), interpolation=cv2.INTER_LINEAR)
    return raw(small, cv2.Sobel(bent, cv2.CV_32F, 1, 0))


def onnxruntime_network(threads: int) -> bytes:
    """A small convolutional network, in a session with the options that the operators use."""
    import onnx
    import onnxruntime
    from onnx import TensorProto, helper, numpy_helper

    rng = np.random.default_rng(7)
    shapes = [(32, 3, 3, 3), (64, 32, 3, 3), (64, 64, 3, 3)]
    weights = [
        numpy_helper.from_array(rng.normal(0, 0.1, shape).astype(np.float32), f"w{i}") for i, shape in enumerate(shapes)
    ]
    nodes = []
    for i in range(len(shapes)):
        nodes.append(helper.make_node("Conv", [f"x{i}", f"w{i}"], [f"y{i}"], pads=[1, 1, 1, 1], strides=[2, 2]))
        nodes.append(helper.make_node("Relu", [f"y{i}"], [f"x{i + 1}"]))
    nodes.append(helper.make_node("ReduceMean", ["x3"], ["out"], keepdims=0))
    inputs = [helper.make_tensor_value_info("x0", TensorProto.FLOAT, [1, 3, 352, 352])]
    graph = helper.make_graph(
        nodes, "net", inputs, [helper.make_tensor_value_info("out", TensorProto.FLOAT, None)], weights
    )
    graph.output.append(helper.make_tensor_value_info("x3", TensorProto.FLOAT, None))
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
    model.ir_version = min(model.ir_version, onnx.IR_VERSION, 10)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    options.use_deterministic_compute = True
    session = onnxruntime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])
    image = rng.random((1, 3, 352, 352), np.float32)
    return raw(*session.run(None, {"x0": image}))


def torch_network(threads: int) -> bytes:
    """A convolution, its gradient and a long sum, as in training."""
    import torch

    torch.set_num_threads(threads)
    torch.manual_seed(7)
    layer = torch.nn.Conv2d(3, 32, 3)
    loss = layer(torch.rand(4, 3, 128, 128)).square().sum()
    loss.backward()
    total = torch.rand(1_000_003).sum()
    gradient = layer.weight.grad
    assert gradient is not None
    return raw(gradient.numpy(), loss.detach().numpy(), total.numpy())


def numpy_algebra(threads: int) -> bytes:
    """BLAS and LAPACK through numpy: a product, a decomposition, a solution."""
    rng = np.random.default_rng(7)
    a = rng.normal(size=(400, 400))
    return raw(a @ a.T, np.linalg.svd(a, compute_uv=False), np.linalg.solve(a, a[:, 0]))


MODES = (
    Mode("OpenCV", "opencv-python-headless", "corners, optical flow, PnP RANSAC", 1, True, opencv_tracking),
    Mode("OpenCV", "opencv-python-headless", "remap, resize, blur, Sobel", 1, True, opencv_filters),
    Mode("OpenCV", "opencv-python-headless", "semi-global matching", 1, True, opencv_stereo),
    Mode("onnxruntime", "onnxruntime", "convolutional network", 1, True, onnxruntime_network),
    Mode("numpy", "numpy", "BLAS and LAPACK", 1, True, numpy_algebra),
    Mode("small_gicp", "small_gicp", "GICP", 1, True, small_gicp),
    Mode("torch", "torch", "convolution, gradient, sum", 1, True, torch_network),
    Mode("OpenCV", "opencv-python-headless", "corners, optical flow, PnP RANSAC", 4, False, opencv_tracking),
    Mode("OpenCV", "opencv-python-headless", "semi-global matching", 4, False, opencv_stereo),
    Mode("onnxruntime", "onnxruntime", "convolutional network", 4, False, onnxruntime_network),
    Mode("numpy", "numpy", "BLAS and LAPACK", 4, False, numpy_algebra),
    Mode("torch", "torch", "convolution, gradient, sum", 4, False, torch_network),
    Mode("small_gicp", "small_gicp", "GICP", 4, False, small_gicp),
    Mode("kiss-icp", "kiss-icp", "four scans", 1, False, kiss_icp),
    Mode("kiss-icp", "kiss-icp", "four scans", 4, False, kiss_icp),
    Mode("Open3D", "open3d", "point-to-plane ICP", 1, False, open3d_icp),
    Mode("Open3D", "open3d", "point-to-plane ICP", 4, False, open3d_icp),
)


def digest_in_a_process(mode: Mode) -> str:
    """The digest of one run in a new process, with the environment that processes have."""
    here = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
    variables = environment(mode.threads)
    variables["PYTHONPATH"] = os.pathsep.join([here, variables["PYTHONPATH"]])
    command = [sys.executable, __file__, "--one", str(MODES.index(mode))]
    done = subprocess.run(command, env=variables, capture_output=True, text=True, timeout=SECONDS, check=False)
    if done.returncode:
        last = (done.stderr.strip() or "no output").splitlines()[-1]
        raise RuntimeError(f"{mode.name}: exit code {done.returncode}: {last}")
    return done.stdout.split()[-1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=20, help="processes a mode")
    parser.add_argument("--jobs", type=int, default=2, help="processes at a time")
    parser.add_argument("--only", default="", help="modes whose name holds this word")
    parser.add_argument("--one", type=int, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.one is not None:
        mode = MODES[arguments.one]
        print(xxhash.xxh3_128_hexdigest(mode.work(mode.threads)))
        return
    print(f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}, {arguments.runs} runs\n")
    print("| library | version | what | threads | for operators | digests | repeatable | first digest |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    broken = []
    for mode in MODES:
        if arguments.only.lower() not in mode.name.lower():
            continue
        with ThreadPoolExecutor(arguments.jobs) as pool:
            found = Counter(pool.map(digest_in_a_process, [mode] * arguments.runs))
        one = len(found) == 1
        print(
            f"| {mode.library} | {version(mode.package)} | {mode.what} | {mode.threads} | "
            f"{'yes' if mode.allowed else 'no'} | {len(found)} | {'yes' if one else '**no**'} | "
            f"`{found.most_common(1)[0][0][:12]}` |",
            flush=True,
        )
        if mode.allowed and not one:
            broken.append(mode.name)
    if broken:
        sys.exit(f"not repeatable, and yet for operators: {'; '.join(broken)}")


if __name__ == "__main__":
    main()
