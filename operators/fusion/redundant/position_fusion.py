"""Places of things from several sensors as an operator."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Diagnostics, LandmarkSightings, Transforms
from dataflow.messages.geometry import transform_points
from dataflow.operator import Context, Duration, In, Operator, Out, Param, Sampled
from operators.fusion.redundant.combination import Bearing, Place, Unknown, place_consistency, place_misfits, placed
from operators.fusion.redundant.sensors import RedundantSensors
from operators.geometry.extrinsics import transform_between
from operators.localization.interpretation import cartesian

Array = NDArray[np.float64]


@dataclass
class State:
    """Holds what each sensor gave last, and how far the sensors agree."""

    sensors: RedundantSensors[LandmarkSightings]


class PositionFusion(Operator):
    """Combines positions of the same things by cameras, lidars and others, by their covariances.

    Things are matched by identity. Sightings with range count as positions with covariance; those with bearings alone
    are solved for together with the rest, so two cameras triangulate. Sensors whose sightings are at most `window` old
    count as simultaneous.

    Each sensor is compared with the others. Of three or more the one that contradicts the rest is left out; of two
    it is undecidable which is wrong, and the covariance grows until it holds both. The status reports either before it
    is averaged. Covariances follow how far a sensor is from the others, so a degrading one loses its weight.

    Method: positions and bearings in one weighted least squares, as in Hartley and Zisserman, "Multiple view geometry",
    2004, 12; contradictions by the chi-square test of the residuals.
    """

    sightings: In[LandmarkSightings] = In(many=True, doc="things seen by each sensor, with identities and covariances")
    extrinsics: Sampled[Transforms] = Sampled(many=True, required=False, doc="where the sensors are")
    places: Out[LandmarkSightings] = Out(doc="the things whose places are known, in `frame`")
    status: Out[Diagnostics] = Out(doc="which sensors agree; every second, and at once when one contradicts another")

    frame: str = Param("base_link", min_length=1, doc="frame of the result")
    window: Duration = Param("50ms", doc="how old a sensor's sightings may be")
    share: float = Param(0.999, gt=0, lt=1, doc="share of true sightings that do not count as a contradiction")
    largest: float = Param(2.0, gt=0, doc="places known to no better than this are not given", unit="m")

    state: State

    def initial_state(self) -> State:
        return State(RedundantSensors(self.window, self.share))

    def process(
        self,
        sightings: Mapping[str, LandmarkSightings],
        context: Context,
        extrinsics: Mapping[str, Transforms] | None = None,
    ) -> dict[str, Any]:
        """Raises ValueError for sightings without covariances or of a frame without place."""
        stamp = context.stamp
        self.state.sensors.take(sightings)
        seen: dict[int, dict[str, Place | Bearing]] = {}
        for name, message in self.state.sensors.simultaneous(stamp):
            for identity, one in self._of(name, message, _holding(message.frame, extrinsics or {})):
                seen.setdefault(identity, {})[name] = one
        found = [(identity, *place) for identity in sorted(seen) if (place := self._place(seen[identity])) is not None]
        places = LandmarkSightings(
            stamp=stamp,
            frame=self.frame,
            ids=np.array([identity for identity, _, _ in found], np.int64),
            positions=np.array([point for _, point, _ in found]).reshape(-1, 3),
            covariances=np.array([C for _, _, C in found]).reshape(-1, 3, 3),
        )
        return {"places": places, "status": self.state.sensors.status(stamp)}

    def summary(self) -> Mapping[str, float | int | str]:
        return self.state.sensors.summary()

    def _place(self, seen: Mapping[str, Place | Bearing]) -> tuple[Array, Array] | None:
        kept, growth = self.state.sensors.agreement.judge(
            list(seen), list(seen.values()), place_consistency, place_misfits
        )
        try:
            point, covariance = placed(kept, self.largest)
        except Unknown as reason:
            self.state.sensors.ignored[str(reason)] += 1
            return None
        return point, covariance * growth

    def _of(
        self, name: str, message: LandmarkSightings, extrinsics: Transforms | None
    ) -> list[tuple[int, Place | Bearing]]:
        """The sightings of a message in `frame`, with covariances that follow the sensor's innovations."""
        if message.covariances is None:
            raise ValueError(f"{name}: sightings have no covariances: how well a thing was seen must be known")
        T = transform_between(extrinsics, message.frame, self.frame)
        noise = self.state.sensors.agreement.noise(name)
        if message.ranges is None and message.positions is None:
            made: list[Place | Bearing] = list(_bearings(message, T, noise))
        else:
            points, spread = cartesian(message)
            points, spread = transform_points(T, points), T[:3, :3] @ spread @ T[:3, :3].T * noise
            made = [Place(point, C) for point, C in zip(points, spread, strict=True)]
        found = []
        for identity, one in zip(message.ids.tolist(), made, strict=True):
            if identity < 0:
                self.state.sensors.ignored[f"{name}: no identity"] += 1
            elif not _usable(one):
                self.state.sensors.ignored[f"{name}: not finite, or covariance not positive"] += 1
            else:
                found.append((identity, one))
        return found


def _holding(frame: str, extrinsics: Mapping[str, Transforms]) -> Transforms | None:
    """The transforms that hold a frame; any where none do, and None where there are none at all."""
    given = [transforms for _, transforms in sorted(extrinsics.items())]
    return next((one for one in given if frame in (*one.frames, *one.child_frames)), given[0] if given else None)


def _bearings(message: LandmarkSightings, T: Array, noise: float) -> list[Bearing]:
    assert message.bearings is not None
    assert message.covariances is not None
    b = message.bearings
    e = np.zeros_like(b) if message.elevations is None else message.elevations
    rays = np.column_stack([np.cos(e) * np.cos(b), np.cos(e) * np.sin(b), np.sin(e)]) @ T[:3, :3].T
    size = message.covariances.shape[1]
    sigmas = np.sqrt(noise * np.trace(message.covariances, axis1=1, axis2=2) / size)
    return [Bearing(T[:3, 3], ray, float(sigma)) for ray, sigma in zip(rays, sigmas, strict=True)]


def _usable(one: Place | Bearing) -> bool:
    if isinstance(one, Bearing):
        return bool(np.isfinite(one.direction).all()) and one.sigma > 0
    finite = bool(np.isfinite(one.position).all() and np.isfinite(one.covariance).all())
    return finite and float(np.linalg.eigvalsh(one.covariance)[0]) > 0
