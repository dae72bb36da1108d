"""A jointed human body: its parts, and where they are for a posture. Arms and legs follow hands and feet.

Proportions after Drillis and Contini (1966), as shares of the height.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from operators.simulator.shapes import Array, Material, Shape, at, bone, box, ellipsoid, lathe
from operators.simulator.things.furniture import any_tone, dark, tone

Rng = np.random.Generator

_THIGH, _SHIN, _FOOT = 0.245, 0.246, 0.039
_TORSO, _NECK = 0.288, 0.052
_UPPER, _FORE, _HAND = 0.186, 0.146, 0.055
_SHOULDER, _HIP = 0.118, 0.055  # half widths


@dataclass(frozen=True, eq=False)
class Posture:
    """Posture of a body: pelvis (3,) and heading, lean forward (rad), soles (2, 3), hands (2, 3); left first."""

    pelvis: Array
    yaw: float
    lean: float
    feet: Array
    hands: Array


@dataclass(frozen=True, eq=False)
class Body:
    """One person's shape. `parts` are in the order of `poses()`."""

    height: float
    parts: tuple[Shape, ...]

    @property
    def hip_height(self) -> float:
        """Height of the pelvis when standing at ease, metres."""
        return 0.985 * (_THIGH + _SHIN + _FOOT) * self.height

    def shoulder(self, posture: Posture, side: int) -> Array:
        """Place of a shoulder: side 0 is left."""
        _, left, up = _axes(posture.yaw, posture.lean)
        sign = 1 - 2 * side
        return np.asarray(posture.pelvis + self.height * (_TORSO * 0.93 * up + sign * _SHOULDER * left))

    def mouth(self, posture: Posture) -> Array:
        """A place in front of the mouth."""
        forward, _, up = _axes(posture.yaw, posture.lean * 0.6)
        _, _, spine = _axes(posture.yaw, posture.lean)
        return np.asarray(posture.pelvis + self.height * (_TORSO + _NECK) * spine + 0.05 * up + 0.13 * forward)

    def grip(self, posture: Posture, side: int) -> Array:
        """Returns where the hand really is: its target, or as near to it as the arm reaches."""
        _, _, end = self._arm(posture, side)
        return end

    def poses(self, posture: Posture) -> Array:
        """`T_world_part` (P, 4, 4)."""
        h = self.height
        forward, _, up = _axes(posture.yaw, posture.lean)
        ahead = _axes(posture.yaw, 0.0)[0]
        poses = [
            _frame(posture.pelvis - 0.02 * h * up, forward, up),
            _frame(posture.pelvis + 0.05 * h * up, forward, up),
        ]
        head_forward, _, head_up = _axes(posture.yaw, posture.lean * 0.4)
        poses.append(_frame(posture.pelvis + h * (_TORSO + _NECK) * up, head_forward, head_up))
        for side in (0, 1):
            shoulder, elbow, hand = self._arm(posture, side)
            poses.append(_aimed(shoulder, elbow, forward))
            poses.append(_aimed(elbow, hand, forward))
            sign = 1 - 2 * side
            hip = posture.pelvis + sign * _HIP * h * _axes(posture.yaw, 0)[1]
            ankle = posture.feet[side] + np.array([0, 0, _FOOT * h])
            knee, ankle = _two_bones(hip, ankle, _THIGH * h, _SHIN * h, ahead)
            poses.append(_aimed(hip, knee, ahead))
            poses.append(_aimed(knee, ankle, ahead))
            poses.append(_frame(ankle - np.array([0, 0, _FOOT * h]), ahead, np.array([0, 0, 1.0])))
        return np.array(poses)

    def _arm(self, posture: Posture, side: int) -> tuple[Array, Array, Array]:
        shoulder = self.shoulder(posture, side)
        forward, left, _ = _axes(posture.yaw, posture.lean)
        out = (1 - 2 * side) * left
        bend = -0.7 * forward + 0.1 * out - np.array([0, 0, 0.5])
        elbow, hand = _two_bones(
            shoulder, posture.hands[side], _UPPER * self.height, (_FORE + _HAND * 0.6) * self.height, bend
        )
        return shoulder, elbow, hand


@dataclass(frozen=True)
class Appearance:
    """Holds what a person wears, as patches that are added to the parts of the body: trunk, hips and head."""

    skin: Material
    hair: Material
    shirt: Material
    trousers: Material
    shoes: Material
    sleeve: Material
    shin: Material
    on_hips: Shape = ()
    on_trunk: Shape = ()
    on_head: Shape = ()


def drawn_body(rng: Rng) -> Body:
    """A person of drawn height, build, skin, hair and clothes."""
    h = rng.uniform(1.58, 1.88)
    build = rng.uniform(0.9, 1.12)
    skin = Material("plain", tone(rng, (0.04, 0.085), (0.25, 0.6), (0.4, 0.95)), tile=0.3)
    hair = Material("carpet", tone(rng, (0.03, 0.12), (0.1, 0.7), (0.1, 0.75)), tile=0.12)
    shirt = Material(("fabric", "checked", "plain")[int(rng.integers(3))], any_tone(rng), tile=0.25)
    trousers = Material("fabric", tone(rng, (0, 1), (0.1, 0.6), (0.14, 0.6)), tile=0.3)
    shoes = Material("plain", dark(rng), tile=0.3)
    sleeve = shirt if rng.uniform() < 0.6 else skin
    return _dressed(h, build, Appearance(skin, hair, shirt, trousers, shoes, sleeve, trousers))


def varied_body(rng: Rng) -> Body:
    """A person of any look: also tall and small, in skirts and shorts, with hats, long hair and rucksacks."""
    h, build = rng.uniform(1.52, 1.93), rng.uniform(0.86, 1.25)
    skin = Material("plain", tone(rng, (0.03, 0.09), (0.2, 0.65), (0.3, 0.97)), tile=0.3)
    hair = Material("carpet", tone(rng, (0.0, 0.14), (0.0, 0.75), (0.06, 0.9)), tile=0.12)
    cloths = ("fabric", "checked", "plain", "carpet")
    shirt = Material(cloths[int(rng.integers(4))], any_tone(rng), tile=0.25)
    trousers = Material(cloths[int(rng.integers(3))], tone(rng, (0, 1), (0.0, 0.9), (0.1, 0.95)), tile=0.3)
    shoes = Material("plain", any_tone(rng) if rng.uniform() < 0.4 else dark(rng), tile=0.3)
    sleeve = shirt if rng.uniform() < 0.5 else skin
    bare = rng.uniform() < 0.3
    hips: Shape = ()
    trunk: Shape = ()
    head: Shape = ()
    if bare and rng.uniform() < 0.6:  # a skirt down to above the knees
        waist, hem = 0.075 * h * build, 0.115 * h * build
        hips = at(lathe([(hem, 0.0), (waist, 0.17 * h)], trousers, segments=16), z=-0.13 * h)
    if rng.uniform() < 0.25:
        cloth = Material("fabric", any_tone(rng), tile=0.3)
        trunk = box((0.07 * h, 0.15 * h, 0.22 * h), cloth, center=(-0.105 * h * build, 0, 0.1 * h), cell=0.2)
    worn = rng.uniform()
    if worn < 0.3:  # a hat with a brim
        felt = Material("fabric", any_tone(rng), tile=0.2)
        brim = [(0.1 * h, 0.0), (0.058 * h, 0.012 * h), (0.052 * h, 0.06 * h), (0.0, 0.07 * h)]
        head = at(lathe(brim, felt, segments=16), x=-0.008 * h, z=0.062 * h)
    elif worn < 0.6:  # long hair, down to the shoulders
        head = at(ellipsoid(0.03 * h, 0.052 * h, 0.085 * h, hair, segments=12, rings=8), x=-0.045 * h, z=-0.015 * h)
    shin = skin if bare else trousers
    return _dressed(h, build, Appearance(skin, hair, shirt, trousers, shoes, sleeve, shin, hips, trunk, head))


def _dressed(h: float, build: float, look: Appearance) -> Body:
    """A body of a height (m) and build with a look."""
    skin, hair, shirt, trousers = look.skin, look.hair, look.shirt, look.trousers
    face = Material("face", skin.tint, tile=0)
    hips = at(ellipsoid(0.062 * h * build, 0.09 * h * build, 0.075 * h, trousers, segments=14, rings=8))
    torso = bone(0.2 * h, 0.085 * h * build, 0.1 * h * build, shirt, segments=14, flat=0.66)
    neck = at(bone(0.06 * h, 0.032 * h, 0.03 * h, skin, segments=8), z=-0.075 * h)
    head = at(ellipsoid(0.052 * h, 0.044 * h, 0.066 * h, face, segments=16, rings=10), z=0.028 * h)
    cap = at(ellipsoid(0.056 * h, 0.05 * h, 0.058 * h, hair, segments=14, rings=8), x=-0.013 * h, z=0.046 * h)
    parts = [hips + look.on_hips, torso + look.on_trunk, neck + head + cap + look.on_head]
    for side in (1, -1):
        upper = bone(_UPPER * h, 0.031 * h * build, 0.025 * h * build, shirt)
        fore = bone(_FORE * h, 0.025 * h * build, 0.018 * h, look.sleeve)
        hand = at(ellipsoid(0.014 * h, 0.024 * h, 0.032 * h, skin, segments=8, rings=6), z=(_FORE + _HAND * 0.5) * h)
        thigh = bone(_THIGH * h, 0.05 * h * build, 0.034 * h * build, trousers, segments=12)
        shin = bone(_SHIN * h, 0.034 * h * build, 0.024 * h, look.shin)
        sole = (0.04 * h, 0.004 * h * side, 0.0225 * h)
        foot = box((0.15 * h, 0.055 * h, 0.045 * h), look.shoes, center=sole, cell=0.2)
        parts += [upper, fore + hand, thigh, shin, foot]
    return Body(h, tuple(parts))


def _axes(yaw: float, lean: float) -> tuple[Array, Array, Array]:
    """Forward, left and up of a trunk that leans forward."""
    c, s = math.cos(yaw), math.sin(yaw)
    flat, left = np.array([c, s, 0.0]), np.array([-s, c, 0.0])
    vertical = np.array([0, 0, 1.0])
    return math.cos(lean) * flat - math.sin(lean) * vertical, left, math.cos(lean) * vertical + math.sin(lean) * flat


def _frame(origin: Array, forward: Array, up: Array) -> Array:
    T = np.eye(4)
    T[:3, 0], T[:3, 1], T[:3, 2], T[:3, 3] = forward, np.cross(up, forward), up, origin
    return T


def _aimed(start: Array, end: Array, forward: Array) -> Array:
    """A bone's pose: z from start to end, x as near to forward as it can be."""
    z = (end - start) / max(float(np.linalg.norm(end - start)), 1e-9)
    x = forward - (forward @ z) * z
    if np.linalg.norm(x) < 1e-3:
        x = np.cross(z, [0.0, 1.0, 0.0]) + np.cross(z, [1.0, 0.0, 0.0]) * 1e-3
    return _frame(start, x / np.linalg.norm(x), z)


def _two_bones(root: Array, target: Array, first: float, second: float, bend: Array) -> tuple[Array, Array]:
    """Middle joint and end of a limb of two bones whose middle joint points towards `bend`."""
    to = target - root
    reach = float(np.linalg.norm(to))
    direction = to / max(reach, 1e-9)
    d = min(max(reach, abs(first - second) + 1e-3), (first + second) * 0.9995)
    along = (d * d + first * first - second * second) / (2 * d)
    side = bend - (bend @ direction) * direction
    side /= max(float(np.linalg.norm(side)), 1e-9)
    off = math.sqrt(max(first * first - along * along, 0))
    return root + along * direction + off * side, root + d * direction
