"""One image of a monocular odometry, and the corners that are followed through images."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dataflow.messages.geometry import invert, transform_points
from operators.geometry.pinhole import Pixels, project, unproject
from operators.geometry.se3 import Matrix
from operators.monitoring.image_flaws import Flaw, Watch
from operators.odometry.features import Gray, detect_corners, track_both_ways
from operators.odometry.images import gray_of, reduced
from operators.odometry.mono.map import MonoMap, Numbers, View, found_in
from operators.odometry.mono.two_view import turned
from operators.odometry.rgbd.surface import scaled_intrinsics

BACK = 1.0  # pixels by which a track may miss its beginning when followed back


@dataclass(frozen=True, eq=False)
class MonoFrame:
    """An image, reduced to what the odometry works on, and what is wrong with it."""

    stamp: int
    gray: Gray
    K: Matrix  # (3, 3) of gray
    flaw: Flaw | None
    T_reference: Matrix | None  # where another odometry has the camera, metres
    watch: Watch  # to compare the next image with


def observe(
    image: NDArray[np.uint8], stamp: int, K: Matrix, width: int, last: Watch, T_reference: Matrix | None
) -> MonoFrame:
    """Reduces an image by whole factors to no less than a width, and looks for flaws, such as repeating the last."""
    factor = max(1, image.shape[1] // width)
    gray = reduced(gray_of(image), factor)
    watch = Watch().seen(image, np.zeros((1, 1), np.float32))
    flaw = watch.image_flaw(last, gray)
    return MonoFrame(stamp, np.ascontiguousarray(gray), scaled_intrinsics(K, 1.0 / factor), flaw, T_reference, watch)


@dataclass(frozen=True, eq=False)
class Tracks:
    """Corners of an image, by ascending number, and the pose that it was given."""

    gray: Gray
    T_world_camera: Matrix
    numbers: Numbers
    pixels: Pixels  # (N, 2)

    def followed(self, frame: MonoFrame, T_predicted: Matrix, known: MonoMap) -> "Tracks":
        """Tracks the corners into the next image from where its predicted pose puts them."""
        R = (invert(T_predicted) @ self.T_world_camera)[:3, :3]
        guess = project(unproject(self.pixels, frame.K) @ R.T, frame.K)
        rows, there = known.find(self.numbers)
        if there.any():
            guess[there] = project(transform_points(invert(T_predicted), known.points[rows[there]]), frame.K)
        pixels, found = track_both_ways(self.gray, frame.gray, self.pixels, guess, BACK)
        return Tracks(frame.gray, T_predicted, self.numbers[found], pixels[found])

    def replenished(self, count: int, following: int) -> "Tracks":
        """Adds corners where the image has none, numbered from `following`, up to a count with those that are there."""
        fresh = detect_corners(self.gray, count, self.pixels)
        numbers = np.concatenate([self.numbers, np.arange(following, following + len(fresh))])
        return replace(self, numbers=numbers, pixels=np.concatenate([self.pixels, fresh]))

    def only(self, kept: NDArray[np.bool_]) -> "Tracks":
        return replace(self, numbers=self.numbers[kept], pixels=self.pixels[kept])

    def view(self, frame: MonoFrame, covariance: Matrix) -> View:
        """Returns the frame as a keyframe that saw these corners."""
        return View(
            frame.stamp, self.T_world_camera, self.gray, self.numbers, self.pixels, covariance, frame.T_reference
        )

    def turn_since(self, last: "Tracks", K: Matrix, sigma: float) -> Matrix | None:
        """Returns the rotation R_last_camera (3, 3) that these corners hold, None where they show a translation."""
        rows, _ = found_in(last.numbers, self.numbers)
        rays, before = unproject(self.pixels, K), last.pixels[rows]
        R = turned(rays, unproject(before, K), sigma / float(K[0, 0]))
        off = np.linalg.norm(project(rays @ R.T, K) - before, axis=1)
        return R if float(np.median(off)) < 2.0 * sigma else None


def from_view(view: View, known: MonoMap, frame: MonoFrame, T_world_camera: Matrix) -> Tracks:
    """Tracks the points that a keyframe saw into an image whose pose is nearly known."""
    numbers, points, pixels = known.seen_in(view)
    guess = project(transform_points(invert(T_world_camera), points), frame.K)
    ends, found = track_both_ways(view.gray, frame.gray, pixels, guess, BACK)
    return Tracks(frame.gray, T_world_camera, numbers[found], ends[found])
