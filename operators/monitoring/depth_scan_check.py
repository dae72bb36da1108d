"""The depth camera against the LiDAR, as an operator."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from dataflow.messages import CameraInfo, DepthImage, Diagnostics, Odometry, PointCloud, Transforms
from dataflow.messages.diagnostics import Level
from dataflow.operator import Counts, In, Operator, Out, Param, Sampled
from operators.cloud.deskewing import deskewed
from operators.geometry import se3
from operators.geometry.calibration import check_calibration
from operators.geometry.extrinsics import transform_between
from operators.monitoring.depth_scan import DepthScanAgreement, DepthScanErrors
from operators.status import counted_status

_SURE = 4.0  # standard deviations by which a misfit must stand out
_AT_ONCE = 2_000_000  # ns: differences of stamps that need no motion


@dataclass
class State(Counts):
    """Holds the misfit by the pairs so far."""

    agreement: DepthScanAgreement = field(default_factory=DepthScanAgreement)


class DepthScanCheck(Operator, tolerance="60ms"):
    """Warns when depth images and LiDAR scans do not lie on each other: one is turned, shifted, or of a wrong scale.

    Which of the two is wrong it cannot say, but by how much: the angle and shift between them against the extrinsics,
    and the share by which depths are too long. Where stamps or points differ in time, the LiDAR's velocity is needed.

    Method: projective association, Blais and Levine, "Registering multiview range data to create 3D computer objects",
    1995, with the scale as one more unknown.
    """

    cloud: In[PointCloud] = In(doc="one turn of the LiDAR")
    depth: In[DepthImage] = In(doc="depth, metres")
    depth_info: Sampled[CameraInfo] = Sampled(doc="calibration of the depth camera")
    extrinsics: Sampled[Transforms] = Sampled(doc="holds the transform between the two sensors")
    motion: Sampled[Odometry] = Sampled(
        required=False, max_age="500ms", doc="the LiDAR's odometry, by whose velocity its points are moved"
    )
    status: Out[Diagnostics] = Out(doc="with every scan; a warning while they do not fit")

    angle: float = Param(1.0, gt=0, tunable=True, doc="largest angle between the two", unit="°")
    shift: float = Param(0.05, gt=0, tunable=True, doc="largest shift", unit="m")
    scale: float = Param(0.02, gt=0, tunable=True, doc="largest share by which depths may be too long or short")
    pairs: int = Param(5, ge=1, tunable=True, doc="pairs that must have been seen before it warns")

    state: State

    def process(
        self,
        cloud: PointCloud,
        depth: DepthImage,
        depth_info: CameraInfo,
        extrinsics: Transforms,
        motion: Odometry | None = None,
    ) -> Diagnostics:
        """Raises ValueError where the image does not fit its calibration, or no transform relates the sensors."""
        check_calibration("depth", depth, depth_info)
        apart = cloud.stamp - depth.stamp
        points = cloud.points.astype(np.float64)
        if cloud.time_offsets is not None or abs(apart) > _AT_ONCE:
            velocity = _velocity(motion, extrinsics, cloud.frame)
            if velocity is None:
                self.state.counts["without a velocity"] += 1
                return self._status(cloud.stamp)
            offsets = np.zeros(cloud.count) if cloud.time_offsets is None else cloud.time_offsets.astype(np.float64)
            points = deskewed(points, offsets + apart * 1e-9, velocity)
        T = transform_between(extrinsics, cloud.frame, depth.frame)
        usable = points[np.isfinite(points).all(axis=1)]
        taken = self.state.agreement.add(depth.data, depth_info.K, usable, T)
        self.state.counts["pairs" if taken else "with few common surfaces"] += 1
        return self._status(cloud.stamp)

    def on_reset(self, input: str) -> None:
        """The clock of a stream began anew; the sensors are where they were, so what is known of them stays."""

    def _status(self, stamp: int) -> Diagnostics:
        found = self.state.agreement.misfit()
        wrong = self._wrong(found) if self.state.agreement.pairs >= self.pairs else []
        text = f"depth against LiDAR: {', '.join(wrong)}" if wrong else "depth and LiDAR fit"
        figures = {
            "angle (°)": f"{np.rad2deg(found.angle):.2f}",
            "shift (m)": f"{found.distance:.3f}",
            "scale": f"{1 + found.scale:.4f}",
        }
        return counted_status(
            "depth_scan_check", stamp, text, Level.WARN if wrong else Level.OK, {**figures, **self.state.counts}
        )

    def _wrong(self, found: DepthScanErrors) -> list[str]:
        shift, turn, scale = (
            _SURE * float(s) for s in (found.sigmas[:3].max(), found.sigmas[3:6].max(), found.sigmas[6])
        )
        wrong = []
        if abs(found.scale) > max(self.scale, scale):
            wrong.append(f"depths are {abs(found.scale):.1%} too {'long' if found.scale > 0 else 'short'}")
        if found.angle > max(float(np.deg2rad(self.angle)), turn):
            wrong.append(f"turned by {np.rad2deg(found.angle):.1f}° against the extrinsics")
        if found.distance > max(self.shift, shift):
            wrong.append(f"shifted by {found.distance:.2f} m against the extrinsics")
        return wrong


def _velocity(motion: Odometry | None, extrinsics: Transforms, frame: str) -> np.ndarray | None:
    """The velocity (6,) of the LiDAR in its own axes."""
    if motion is None or motion.linear is None or motion.angular is None:
        return None
    carried = se3.adjoint(transform_between(extrinsics, motion.child_frame, frame))
    return np.asarray(carried @ np.concatenate([motion.linear, motion.angular]))
