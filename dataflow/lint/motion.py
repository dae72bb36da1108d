"""Checks that the motion in a recording is one motion, by what states it twice.

An orientation turns by its angular velocity, a position moves by its velocity, an acceleration at rest points up, and
a gyroscope turns with the body that it is mounted on. Where they contradict each other and one usual mistake
(degrees, another order of a quaternion, an inverse, another frame) makes them agree, that mistake is named.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from dataflow.lint.inputs import Finding, LintInput
from dataflow.messages import Imu, Odometry, Pose, Transforms

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]

WINDOW = 0.25
"""Seconds over which the two are compared, at least."""
PAIRED = 0.5
"""Seconds of a window for two streams, whose clocks may differ a little."""
FEWEST = 4
"""Windows."""
TURNED, MOVED = 0.5, 0.5
"""rad and m of motion in all, below which nothing is judged."""
WRONG, RIGHT = 0.5, 0.2
"""Differences over sums: above the one, two motions contradict each other; below the other, they are the same."""
DEGREES = np.pi / 180
UPRIGHT = 0.9
"""The upward share of the mean acceleration of a robot that is not thrown about."""

Reading = dict[str, tuple[F64, F64]]
"""By what it would be a mistake of (none: as it stands), the two motions (N, 3) of each window."""


@dataclass(frozen=True, slots=True)
class Motion:
    """The motion in a stream's messages; None for what not all of them give. Orientations are (x, y, z, w) as stored.

    `body` is the frame that moves, `world` that in which it does; rates and accelerations are of the body.
    """

    world: str
    body: str
    stamps: F64
    orientations: F64 | None = None
    rates: F64 | None = None
    accelerations: F64 | None = None
    positions: F64 | None = None
    velocities: F64 | None = None

    def windows(self, length: float) -> tuple[I64, I64]:
        """The first and the last message of each window of at least `length` (s); none over a gap."""
        cells = np.floor((self.stamps - self.stamps[0]) / length)
        edges = np.flatnonzero(np.diff(cells, prepend=-1.0, append=np.inf)).clip(max=len(self.stamps) - 1)
        begins, ends = edges[:-1], edges[1:]
        longest = 4 * max(length, float(np.median(np.diff(self.stamps))))
        whole = (ends > begins) & (self.stamps[ends] - self.stamps[begins] < longest)
        return begins[whole], ends[whole]

    def integral(self, values: F64) -> F64:
        """The sum (N, 3) of values a second over time, from the first message to each."""
        steps = (values[1:] + values[:-1]) / 2 * np.diff(self.stamps)[:, None]
        return np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])


def check_motion(data: LintInput) -> Iterator[Finding]:
    """Looks at all messages of inertial sensors, odometry and poses."""
    motions = {}
    for name, facts in data.streams.items():
        if facts.readable and facts.count > FEWEST and facts.type in ("Imu", "Odometry", "Pose"):
            motion = _motion_of(data, name)
            if motion is not None:
                motions[name] = motion
    wrong = set()
    for name, motion in motions.items():
        for text in _contradictions(motion):
            wrong.add(name)
            yield Finding("motion", name, "warning", text)
    sound = {name: motion for name, motion in motions.items() if name not in wrong}
    yield from _check_pairs(sound, _mounts(data))


def _motion_of(data: LintInput, stream: str) -> Motion | None:
    """The motion in a stream; None where fewer messages than `FEWEST` have stamps that go forward."""
    rows: list[tuple[object, ...]] = []
    stamps: list[int] = []
    world = body = ""
    for message in data.messages(stream):
        if stamps and message.stamp <= stamps[-1]:
            continue
        if isinstance(message, Imu):
            body = message.frame
            rows.append((message.orientation, message.angular_velocity, message.linear_acceleration, None, None))
        elif isinstance(message, Odometry):
            world, body = message.frame, message.child_frame
            rows.append((message.orientation, message.angular, None, message.position, message.linear))
        elif isinstance(message, Pose):
            world, body = message.frame, message.child_frame
            rows.append((message.orientation, None, None, message.position, None))
        stamps.append(message.stamp)
    if len(rows) <= FEWEST:
        return None
    columns = [None if any(v is None for v in column) else np.array(column) for column in zip(*rows, strict=True)]
    finite = [None if c is None or not np.isfinite(c).all() else c for c in columns]
    return Motion(world, body, np.array(stamps) * 1e-9, *finite)


def _contradictions(motion: Motion) -> Iterator[str]:
    """Mistakes for which a stream's motion contradicts itself."""
    begins, ends = motion.windows(WINDOW)
    if motion.orientations is None or len(begins) < FEWEST:
        return
    if motion.rates is not None:
        turned = motion.integral(motion.rates)
        mistake = _mistake(_turnings(motion.orientations, begins, ends, turned[ends] - turned[begins]), TURNED)
        if mistake:
            yield f"its orientations contradict its angular velocity; the two agree if {mistake}"
            return
    if motion.accelerations is not None and (mistake := _falling(motion.orientations, motion.accelerations)):
        yield mistake
    if motion.positions is not None and motion.velocities is not None:
        moved = motion.integral(motion.velocities)
        mistake = _mistake(_movements(motion, begins, ends, moved[ends] - moved[begins]), MOVED)
        if mistake:
            yield f"its positions contradict its velocity; the two agree if {mistake}"


def _turning(stored: F64, begins: I64, ends: I64) -> F64:
    """The rotation vectors (N, 3) of a body from one message to another, in its own axes."""
    turns = Rotation.from_quat(stored)
    return np.asarray((turns[begins].inv() * turns[ends]).as_rotvec())


def _turnings(stored: F64, begins: I64, ends: I64, turned: F64) -> Reading:
    turns = Rotation.from_quat(stored)
    given = _turning(stored, begins, ends)
    return {
        "": (given, turned),
        "the angular velocity is in degrees, and rad/s is wanted": (given, turned * DEGREES),
        "the quaternions are stored as (w, x, y, z), and (x, y, z, w) is wanted": (
            _turning(_w_first(stored), begins, ends),
            turned,
        ),
        "the orientations are inverted (the world's in the body), or the angular velocity has the opposite sign": (
            np.asarray((turns[begins] * turns[ends].inv()).as_rotvec()),
            turned,
        ),
        "the angular velocity is given in the world's axes, and the body's are wanted": (
            np.asarray((turns[ends] * turns[begins].inv()).as_rotvec()),
            turned,
        ),
    }


def _movements(motion: Motion, begins: I64, ends: I64, moved: F64) -> Reading:
    assert motion.positions is not None
    assert motion.orientations is not None
    steps = motion.positions[ends] - motion.positions[begins]
    given = np.asarray(Rotation.from_quat(motion.orientations)[begins].inv().apply(steps))
    return {
        "": (given, moved),
        f"the velocity is given in {motion.world!r}, and in {motion.body!r} is wanted": (steps, moved),
        "the positions are in millimetres, and metres are wanted": (given / 1000, moved),
        "the velocity is in mm/s, and m/s is wanted": (given, moved / 1000),
        "the velocity is in km/h, and m/s is wanted": (given, moved / 3.6),
        "the velocity has the opposite sign": (given, -moved),
    }


def _w_first(stored: F64) -> F64:
    return stored[:, [1, 2, 3, 0]]


def _difference(a: F64, b: F64) -> float:
    """Of two motions, over the sum of both: 0 for the same, about 0.7 for unrelated ones, 1 where one stands still."""
    both = float(np.linalg.norm(a, axis=1).sum() + np.linalg.norm(b, axis=1).sum())
    return float(np.linalg.norm(a - b, axis=1).sum()) / both if both else 0.0


def _mistake(readings: Reading, least: float) -> str:
    """The one mistake that makes motions agree which contradict each other as they stand; empty for none.

    `least`: of the motion that they then agree on.
    """
    errors = {mistake: _difference(*pair) for mistake, pair in readings.items()}
    best = min(errors, key=lambda mistake: errors[mistake])
    if errors[""] < WRONG or errors[best] > RIGHT or np.linalg.norm(readings[best][0], axis=1).sum() < least:
        return ""
    return best


def _falling(stored: F64, accelerations: F64) -> str:
    """Returns which mistake turns the mean acceleration upwards that points elsewhere now; empty where none does."""
    size = float(np.linalg.norm(accelerations, axis=1).mean())

    def upward(quaternions: F64) -> float:
        return float(Rotation.from_quat(quaternions).apply(accelerations)[:, 2].mean()) / size if size else 1.0

    given = upward(stored)
    if given < WRONG and upward(_w_first(stored)) > UPRIGHT:
        return (
            "its acceleration does not point up by its orientations; it does if the quaternions are stored as "
            "(w, x, y, z), and (x, y, z, w) is wanted"
        )
    if given < -UPRIGHT:
        return (
            "its acceleration points down by its orientations: at rest it is +9.81 m/s² upwards, and orientations "
            "are given east-north-up (REP 103), not north-east-down"
        )
    return ""


Mounts = Mapping[str, tuple[str, Rotation]]
"""Static transforms: child frame → its parent, and the rotation that maps the child's coordinates to the parent's."""


def _mounts(data: LintInput) -> Mounts:
    found: dict[str, tuple[str, Rotation]] = {}
    for name, facts in data.streams.items():
        if facts.readable and facts.static and facts.type == "Transforms":
            for message in data.messages(name):
                assert isinstance(message, Transforms)
                for parent, child, turn in zip(message.frames, message.child_frames, message.rotations, strict=True):
                    found[child] = parent, Rotation.from_quat(turn)
    return found


def _way(frame: str, mounts: Mounts) -> list[str]:
    """The frames from one up to the root of what it is mounted on."""
    way = [frame]
    while way[-1] in mounts and mounts[way[-1]][0] not in way:
        way.append(mounts[way[-1]][0])
    return way


def _placed(frame: str, mounts: Mounts, inverted: str = "") -> Rotation:
    """The rotation that maps a frame's coordinates to those of its root; one transform is inverted."""
    turn = Rotation.identity()
    for child in _way(frame, mounts)[:-1]:
        step = mounts[child][1]
        turn = (step.inv() if child == inverted else step) * turn
    return turn


def _check_pairs(motions: Mapping[str, Motion], mounts: Mounts) -> Iterator[Finding]:
    """Gyroscopes against the orientations of other streams, through the static transforms between their frames."""
    named = set()
    for name, gyro in motions.items():
        if gyro.rates is None or gyro.world:
            continue
        for other, body in motions.items():
            pair = None if other == name or not body.world else _pair(gyro, body)
            if pair is None:
                continue
            turned, seen, _ = pair
            much, by_rate = (np.linalg.norm(rows, axis=1)[:, None] for rows in (seen, turned))
            in_degrees = "its angular velocity is in degrees, and rad/s is wanted"
            text = f"its turning contradicts that of {other}; the two agree if "
            if mistake := _mistake({"": (much, by_rate), in_degrees: (much, by_rate * DEGREES)}, TURNED):
                yield Finding("motion", name, "warning", text + mistake)
                break
            connected = _way(gyro.body, mounts)[-1] == _way(body.body, mounts)[-1]
            mistake = _mistake(_mounted(gyro.body, body.body, mounts, *pair), TURNED) if connected else ""
            if mistake and mistake not in named:
                named.add(mistake)
                yield Finding("motion", name, "warning", text + mistake)


def _pair(gyro: Motion, body: Motion) -> tuple[F64, F64, F64] | None:
    """The turning (N, 3) over windows that both have seen: a gyroscope's, a body's by its orientations, and that by its
    quaternions as (w, x, y, z)."""
    if gyro.rates is None or body.orientations is None:
        return None
    begins, ends = body.windows(PAIRED)
    both = (body.stamps[begins] >= gyro.stamps[0]) & (body.stamps[ends] <= gyro.stamps[-1])
    begins, ends = begins[both], ends[both]
    if len(begins) < FEWEST:
        return None
    sums = gyro.integral(gyro.rates)
    at_begin, at_end = (
        np.column_stack([np.interp(body.stamps[which], gyro.stamps, sums[:, axis]) for axis in range(3)])
        for which in (begins, ends)
    )
    stored = body.orientations
    return at_end - at_begin, _turning(stored, begins, ends), _turning(_w_first(stored), begins, ends)


def _mounted(sensor: str, body: str, mounts: Mounts, turned: F64, seen: F64, first: F64) -> Reading:
    """The turning in the body's frame: by the static transforms as they stand, and with one of them inverted."""

    def through(inverted: str = "") -> F64:
        turn = _placed(body, mounts, inverted).inv() * _placed(sensor, mounts, inverted)
        return np.asarray(turn.apply(turned))

    readings = {
        "": (seen, through()),
        "the quaternions of that are stored as (w, x, y, z), and (x, y, z, w) is wanted": (first, through()),
    }
    for child in dict.fromkeys([*_way(sensor, mounts)[:-1], *_way(body, mounts)[:-1]]):
        mistake = f"the static transform of {child!r} in {mounts[child][0]!r} is inverted"
        readings[mistake] = seen, through(child)
    return readings
