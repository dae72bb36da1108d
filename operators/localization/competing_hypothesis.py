"""The likeliest other place: distinguishes a pose from that in a mirrored place, which would explain as much.

A cloud settles in one of several places that look alike, and its spread does not reflect the others. So when the robot
has been looked for, places elsewhere that explain the observation are tried, and the best is followed beside the cloud
until the observations decide between the two. Later, too, places that explain an observation better are tried now and
then, and whenever the pose explains it badly: a robot that was carried to a place that looks alike loses no fit.
Multiple-hypothesis localisation: Jensfelt and Kristensen, "Active global
localization for a mobile robot using multiple hypothesis tracking", 2001.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dataflow.operator import Remembered
from operators.estimation.particles import effective_size, evidence_of, moments, normalised, systematic, wrapped
from operators.localization.motion import composed, moved
from operators.localization.observations import Observation

Array = NDArray[np.float64]
_FAR, _TURNED = 1.0, 0.5
"""Metres or radians from the pose at which a place is another one."""
_DECIDED = 8.0
"""Logarithm of the ratio of likelihoods that decides between two places."""
_FORGETTING = 0.02
"""Share of the evidence that each observation ages by: what neighbouring scans say is much alike."""
_WORSE = 5.0
"""Logarithm of the ratio above which a place that was found explains the observation too badly to be followed."""
_BETTER = 5.0
"""Logarithm of the ratio by which a place must explain an observation better, once nowhere else was found."""
_AGAIN = 10
"""Observations after which places elsewhere are tried again."""
_SEARCHES, _TRIED, _FOLLOWED = 3, 200, 100
_REFUTED = 16
"""Places that were decided against last and are not tried again, at most."""
_NEAR = (0.1, 0.1, 0.05)


@dataclass(eq=False)
class _Other:
    """A cloud (N, 3) about another place with logarithms of weights, and the evidence for the pose against it."""

    poses: Array
    logarithms: Array
    lead: float = 0.0

    def update(self, observation: Observation, count: float, rng: np.random.Generator) -> float:
        """Weighs the cloud; returns the logarithm of the observation's likelihood in it."""
        logarithms, _ = observation.score(self.poses)
        evidence = evidence_of(normalised(self.logarithms), count * logarithms)
        self.logarithms = self.logarithms + count * logarithms
        weights = normalised(self.logarithms)
        if effective_size(weights) < 0.5 * len(weights):
            self.poses = self.poses[systematic(weights, len(weights), float(rng.random()))]
            self.logarithms = np.zeros(len(weights))
        return evidence


class CompetingHypothesis(Remembered):
    """Looks for another place until a few searches found none, and follows the one that it found."""

    _other: _Other | None
    _searched: int
    _since: int
    _expected: Array | None
    _refuted: Array  # (N, 3) places that were decided against

    def __init__(self) -> None:
        self.forget()

    @property
    def decided(self) -> bool:
        """Notes that a search elsewhere found no place that explains the observations."""
        return self._other is None and self._searched >= _SEARCHES

    @property
    def mean(self) -> Array | None:
        """The other place (3,), if there is one."""
        if self._other is None:
            return None
        return moments(self._other.poses, normalised(self._other.logarithms))[0]

    @property
    def lead(self) -> float:
        """Logarithm of how much likelier the pose is than the other place."""
        return 0.0 if self._other is None else self._other.lead

    def settle(self) -> None:
        """Takes the pose as known: nowhere else is looked for it."""
        self._other, self._searched, self._since = None, _SEARCHES, 0

    def forget(self) -> None:
        """Begins anew: the pose is another one than before."""
        self._other, self._searched, self._since, self._expected = None, 0, 0, None
        self._refuted = np.zeros((0, 3))

    def move(self, step: Array, covariance: Array, rng: np.random.Generator) -> None:
        """Moves by a step (3,) in the robot's frame, with noise."""
        if self._expected is not None:
            self._expected = composed(self._expected[None], step)[0]
        self._refuted = composed(self._refuted, step)
        if self._other is not None:
            self._other.poses = moved(self._other.poses, step, covariance, rng)

    def update(
        self,
        mean: Array,
        evidence: float,
        observation: Observation,
        count: float,
        doubtful: bool,
        rng: np.random.Generator,
    ) -> Array | None:
        """Takes an observation that has the given evidence, a logarithm, where the pose's mean (3,) is.

        `count`: what its sensor counts; `doubtful`: observations fit worse than usual. Returns the cloud (N, 3) of the
        other place where that explains all so much better that it is the pose.
        """
        if self._expected is not None and apart(self._expected, mean):
            self.forget()
        self._expected = mean
        if self._other is None:
            self._since += 1
            if self._searched < _SEARCHES:
                self._search([mean, *self._refuted], evidence - _WORSE, observation, count, rng)
            elif doubtful or self._since >= _AGAIN:
                self._search([mean], evidence + _BETTER, observation, count, rng)
            return None
        gained = evidence - self._other.update(observation, count, rng)
        self._other.lead = (1.0 - _FORGETTING) * self._other.lead + gained
        place = self.mean
        assert place is not None
        if not apart(place, mean):
            self._other = None
        elif self._other.lead > _DECIDED:
            self._other, self._refuted = None, np.vstack([self._refuted, place])[-_REFUTED:]
        elif self._other.lead < -_DECIDED:
            poses = self._other.poses[systematic(normalised(self._other.logarithms), _FOLLOWED, float(rng.random()))]
            self.forget()
            return poses
        return None

    def _search(
        self, known: list[Array], least: float, observation: Observation, count: float, rng: np.random.Generator
    ) -> None:
        """Follows the likeliest place that is none of the known ones, if it is likely enough."""
        self._searched, self._since = self._searched + 1, 0
        if not observation.whole:
            return
        tried = observation.propose(_TRIED, rng)
        tried = tried[[all(apart(pose, one) for one in known) for pose in tried]]
        if not len(tried):
            return
        logarithms = count * observation.score(tried)[0]
        best = int(logarithms.argmax())
        if logarithms[best] < least:
            return
        poses = tried[best] + np.array(_NEAR) * rng.standard_normal((_FOLLOWED, 3))
        poses[:, 2] = wrapped(poses[:, 2])
        self._other, self._searched = _Other(poses, np.zeros(_FOLLOWED)), 0


def apart(one: Array, other: Array) -> bool:
    """Returns whether two poses (3,) are of different places."""
    far = float(np.hypot(one[0] - other[0], one[1] - other[1])) > _FAR
    return far or abs(float(wrapped(one[2] - other[2]))) > _TURNED
