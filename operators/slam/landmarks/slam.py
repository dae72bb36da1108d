"""SLAM with point landmarks as an operator."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Diagnostics, LandmarkSightings, Odometry, Transforms
from dataflow.messages.geometry import invert, transform_points
from dataflow.operator import In, Operator, Out, Param, Sampled
from operators.geometry.extrinsics import transform_between
from operators.geometry.planar import PLANAR, flat, placed_in, planar
from operators.localization.interpretation import cartesian
from operators.slam.landmarks.association import Association
from operators.slam.landmarks.filter import LandmarkFilter
from operators.status import counted_status

Array = NDArray[np.float64]


@dataclass
class State:
    """The filter, the last odometry, and the sightings since: stamp (ns), identities, positions and covariances."""

    filter: LandmarkFilter
    last: Odometry | None = None
    pending: list[tuple[int, NDArray[np.int64], Array, Array]] = field(default_factory=list)
    ignored: Counter[str] = field(default_factory=Counter)
    reported: int = -1
    word: str = ""


class LandmarkSlam(Operator, merge=True):
    """Localises a robot in the plane among point landmarks that it maps as it goes: EKF-SLAM on the invariant error.

    The map frame is the first pose. Sightings, polar or Cartesian, are taken at their own stamp, between the odometry
    messages around it. Motion noise is that of each message's twist covariance, taken as independent from message to
    message; where there is none that can be used, that of a differential drive by the parameters. Where innovations
    show more noise, it is taken for as large as they show. Where odometry jumps (its origin began anew), the robot may
    be anywhere that it can have reached.

    Landmarks without identity are matched at once where no other can be meant and all fit together (joint
    compatibility). The others begin landmarks, which are united with earlier ones when a constellation of them leaves
    no doubt (delayed association). A sighting too far from a known landmark to be it and too near to be another is
    ignored and counted, and so is what is not finite. While landmarks are not seen at their places, the robot is lost:
    its covariance is that of a robot astray until landmarks from before are found again.

    Methods: Barrau and Bonnabel, "An EKF-SLAM algorithm with consistency properties", 2015; Neira and Tardos, "Data
    association in stochastic mapping using the joint compatibility test", 2001.
    """

    odometry: In[Odometry] = In(doc="planar motion: increments between messages count, the pose itself does not")
    sightings: In[LandmarkSightings] = In(doc="landmarks seen from the robot")
    extrinsics: Sampled[Transforms] = Sampled(
        required=False, doc="holds the transform between the robot's frame and that of the sightings"
    )
    pose: Out[Odometry] = Out(doc="the robot in the map frame, with covariance, at every odometry message")
    correction: Out[Transforms] = Out(doc="the odometry frame in the map frame (REP 105), whenever sightings moved it")
    landmarks: Out[LandmarkSightings] = Out(doc="the map: every landmark in the map frame, with covariance")
    status: Out[Diagnostics] = Out(
        doc="mapped, inconsistent or lost, with innovations and counts; every second and when it changes"
    )

    map_frame: str = Param("map", min_length=1, doc="name of the frame that the first pose defines")
    association: Literal["known", "unknown"] = Param(
        "known", doc="known uses the identities of sightings, and associates those that have none; unknown ignores them"
    )
    gate: float = Param(0.99, gt=0, lt=1, doc="share of true pairs that association lets through")
    new_landmark: float = Param(
        0.999999, gt=0, lt=1, doc="a sighting is of a new landmark beyond this quantile of every known one"
    )
    forward_noise: float = Param(0.02, gt=0, doc="standard deviation of 1 m of travel, along it", unit="m/√m")
    side_noise: float = Param(0.005, gt=0, doc="and across it", unit="m/√m")
    turn_noise: float = Param(0.02, gt=0, doc="standard deviation of the heading after 1 m of travel", unit="rad/√m")
    spin_noise: float = Param(0.02, ge=0, doc="and after 1 rad of turning", unit="√rad")
    max_speed: float = Param(
        50.0, gt=0, doc="odometry that is faster has jumped and is not used for this step", unit="m/s"
    )

    state: State

    def initial_state(self) -> State:
        return State(LandmarkFilter(Association(self.gate, self.new_landmark)))

    def process(
        self, odometry: Odometry | None, sightings: LandmarkSightings | None, extrinsics: Transforms | None = None
    ) -> dict[str, Any] | None:
        """Raises ValueError where no transform relates the sightings' frame to the robot's."""
        if odometry is not None and not self._moves(odometry):
            odometry = None
        base = odometry or self.state.last
        if sightings is not None:
            if base is None:
                self.state.ignored["before odometry"] += sightings.count
            else:
                T_base_sensor = transform_between(extrinsics, sightings.frame, base.child_frame)
                self.state.pending.append((sightings.stamp, *self._planar(sightings, T_base_sensor)))
        if odometry is None:
            return None
        seen = self._advance(odometry)
        x, y = self.state.filter.position
        T_map_base = planar(x, y, self.state.filter.heading)
        covariance = self.state.filter.pose_covariance()
        result: dict[str, Any] = {
            "pose": placed_in(self.map_frame, odometry.child_frame, T_map_base, covariance, odometry)
        }
        if seen:
            result["correction"] = Transforms.from_matrix(
                T_map_base @ invert(flat(odometry)),
                stamp=odometry.stamp,
                frame=self.map_frame,
                child_frame=odometry.frame,
            )
            result["landmarks"] = LandmarkSightings(
                stamp=odometry.stamp,
                frame=self.map_frame,
                ids=np.array(self.state.filter.ids, np.int64),
                positions=self.state.filter.landmarks,
                covariances=self.state.filter.landmark_covariances(),
            )
        word, level, text = self.state.filter.state
        if self.state.reported < 0 or odometry.stamp - self.state.reported >= 10**9 or word != self.state.word:
            self.state.reported, self.state.word = odometry.stamp, word
            figures = {name: f"{n:.3g}" if isinstance(n, float) else n for name, n in self.summary().items()}
            result["status"] = counted_status("landmarks", odometry.stamp, text, level, figures)
        return result

    def summary(self) -> Mapping[str, float | int]:
        counts = self.state.filter.counts
        ignored = {f"ignored, {reason}": number for reason, number in sorted(self.state.ignored.items())}
        return {
            "landmarks": len(self.state.filter.ids),
            "sightings matched": counts.matched,
            "sightings of new landmarks": counts.added,
            "ignored, ambiguous": counts.ambiguous,
            "landmarks found to be one": counts.merged,
            "landmarks dropped": counts.dropped,
            "odometry's noise over what was told": math.sqrt(self.state.filter.consistency.odometry_variance),
            "innovations squared over their expectation": self.state.filter.consistency.ratio,
        } | ignored

    def _moves(self, odometry: Odometry) -> bool:
        """Returns whether odometry can be used; if not, it is counted, and the next one covers both steps."""
        if not (np.isfinite(odometry.position).all() and np.isfinite(odometry.orientation).all()):
            self.state.ignored["odometry: not finite"] += 1
            return False
        if self.state.last is not None and odometry.stamp <= self.state.last.stamp:
            self.state.ignored["odometry: stamp not later than the last"] += 1
            return False
        return True

    def _planar(self, sightings: LandmarkSightings, T_base_sensor: Array) -> tuple[NDArray[np.int64], Array, Array]:
        """Identities, positions (N, 2) and covariances (N, 2, 2) in the robot's frame, of what is usable."""
        if sightings.covariances is None:
            raise ValueError("sightings have no covariances: how well a landmark was seen must be known")
        points, spread = cartesian(sightings)
        spread = spread[:, :2, :2]
        yaw = math.atan2(T_base_sensor[1, 0], T_base_sensor[0, 0])
        R = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
        level = transform_points(T_base_sensor, points)[:, :2]
        usable = np.asarray(np.isfinite(level).all(axis=1) & np.isfinite(spread).all(axis=(1, 2)))
        usable &= np.linalg.det(np.where(usable[:, None, None], spread, 0.0)) > 0
        self.state.ignored["invalid"] += int((~usable).sum())
        ids = sightings.ids if self.association == "known" else np.full(sightings.count, -1)
        first = np.zeros(len(ids), bool)
        first[np.unique(ids, return_index=True)[1]] = True
        again = ~first & (ids >= 0)  # one landmark is one sighting of a message
        self.state.ignored["twice in a message"] += int((usable & again).sum())
        usable &= ~again
        return ids[usable], level[usable], R @ spread[usable] @ R.T

    def _advance(self, odometry: Odometry) -> bool:
        """Moves to an odometry message, with the sightings on the way; returns whether there were any."""
        last, self.state.last = self.state.last, odometry
        if last is None:
            step, covariance, span = np.zeros(3), np.zeros((3, 3)), 1
            begin = odometry.stamp
        else:
            begin, span = last.stamp, odometry.stamp - last.stamp
            T = invert(flat(last)) @ flat(odometry)
            step = np.array([T[0, 3], T[1, 3], math.atan2(T[1, 0], T[0, 0])])
            reach = self.max_speed * span * 1e-9
            if math.hypot(step[0], step[1]) > reach:
                self.state.ignored["step of odometry: a jump"] += 1
                step, covariance = None, np.diag([reach**2, reach**2, min(math.pi, 10.0 * span * 1e-9) ** 2])
            else:
                covariance = self._noise(odometry, step, span * 1e-9)
        due, self.state.pending = self.state.pending, []
        done = 0.0
        for stamp, ids, points, spread in due:
            share = min(1.0, max(done, (stamp - begin) / span)) if last is not None else 0.0
            self._move(step, covariance, done, share)
            done = share
            self.state.filter.see(ids.tolist(), points, spread)
        self._move(step, covariance, done, 1.0)
        return bool(due)

    def _move(self, step: Array | None, covariance: Array, begin: float, end: float) -> None:
        """Moves along a part of a step: on an arc, at constant speed; a jump if there is none."""
        if end <= begin or not covariance.any():
            return
        if step is None:
            self.state.filter.jump(covariance * (end - begin))
            return
        T = invert(_arc(step, begin)) @ _arc(step, end)
        self.state.filter.move(T[:2, 3], step[2] * (end - begin), covariance * (end - begin))

    def _noise(self, odometry: Odometry, step: Array, seconds: float) -> Array:
        """Covariance (3, 3) of a step (x, y, heading)."""
        if odometry.twist_covariance is not None:
            given = odometry.twist_covariance[np.ix_(PLANAR, PLANAR)]
            if np.isfinite(given).all() and (np.diag(given) >= 0).all():
                return np.asarray(given * seconds**2)
            self.state.ignored["covariance of odometry: not finite or negative"] += 1
        way, turned = float(np.hypot(step[0], step[1])) + 1e-6, abs(float(step[2]))
        heading = self.turn_noise**2 * way + self.spin_noise**2 * turned
        return np.diag([self.forward_noise**2 * way, self.side_noise**2 * way, heading])


def _arc(step: Array, share: float) -> Array:
    """The motion (4, 4) after a share of a step (x, y, turn) at constant velocity."""
    turn = float(step[2])
    half = turn / 2
    chord = half / math.tan(half) if abs(turn) > 1e-6 else 1.0
    vx, vy = chord * step[0] + half * step[1], chord * step[1] - half * step[0]
    part = turn * share
    a, b = (share, share * part / 2) if abs(turn) < 1e-6 else (math.sin(part) / turn, (1 - math.cos(part)) / turn)
    return planar(a * vx - b * vy, b * vx + a * vy, part)
