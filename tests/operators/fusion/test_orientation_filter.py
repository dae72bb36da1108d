"""The orientation filter finds inclination and heading, bridges gaps, and says what it ignores."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from operator_runs import assert_resumes_alike
from scipy.spatial.transform import Rotation, Slerp

from dataflow.messages import Imu, MagneticField
from dataflow.testing import Played, play
from operators.evaluation.orientation_metrics import differences, errors, without_mean_heading
from operators.fusion import OrientationFilter
from operators.fusion.orientation_filter import Orientation
from operators.sources.broad_imu import read_trial

RATE = 100
FIELD = np.array([0.0, 20e-6, -45e-6])  # the earth's, east-north-up
BIAS = np.array([0.01, -0.02, 0.015])


class Turns:
    """A sensor that rests for two seconds, then turns about all axes; with the bias and noise of a cheap one."""

    def __init__(self, seconds: float = 12.0, seed: int = 1) -> None:
        rng = np.random.default_rng(seed)
        self.stamps = (np.arange(int(seconds * RATE)) * 1e9 / RATE).astype(np.int64) + 10**9
        knots = np.arange(0, seconds + 2, 1.0)
        angles = np.cumsum(rng.uniform(-0.7, 0.7, (len(knots), 3)), axis=0)
        angles[:3] = [0.3, -0.2, 1.0]
        self.truth = Slerp(knots, Rotation.from_euler("xyz", angles))((self.stamps - 10**9) * 1e-9)
        turned = (self.truth[:-1].inv() * self.truth[1:]).as_rotvec() * RATE
        self.gyro = np.vstack([turned[:1], turned]) + BIAS + rng.normal(0, 1e-3, (len(self.stamps), 3))
        self.accel = self.truth.inv().apply([0, 0, 9.81]) + rng.normal(0, 0.02, self.gyro.shape)
        self.field = self.truth.inv().apply(FIELD) + rng.normal(0, 2e-7, self.gyro.shape)

    def imu(self, keep: slice = slice(None)) -> list[Imu]:
        return [
            Imu(stamp=int(t), frame="imu", angular_velocity=w, linear_acceleration=f)
            for t, w, f in zip(self.stamps[keep], self.gyro[keep], self.accel[keep], strict=True)
        ]

    def fields(self) -> list[MagneticField]:
        pairs = zip(self.stamps, self.field, strict=True)
        return [MagneticField(stamp=int(t), frame="imu", field=m) for t, m in pairs]

    def errors(self, played: Played, *, relative: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        at = np.searchsorted(self.stamps, [m.stamp for m in played["oriented"]])
        estimates = [m.orientation for m in played["oriented"]]
        difference = differences(estimates, self.truth.as_quat()[at])
        return errors(without_mean_heading(difference) if relative else difference)


def test_the_field_gives_the_heading_and_gravity_the_inclination() -> None:
    made = Turns()
    played = play(OrientationFilter(), {"imu": made.imu(), "magnetic_field": made.fields()})
    total, _, inclination = made.errors(played)
    assert np.degrees(total[200:].max()) < 3
    assert np.degrees(inclination[200:].max()) < 1.5
    assert len(total) == len(made.stamps) - 15


def test_without_a_field_the_inclination_is_known_and_the_heading_relative() -> None:
    made = Turns()
    played = play(OrientationFilter(), {"imu": made.imu()})
    total, heading, inclination = made.errors(played)
    assert np.degrees(inclination[200:].max()) < 1.5
    assert np.degrees(heading.min()) > 30
    assert np.degrees(made.errors(played, relative=True)[0].max()) < 5
    assert len(total) == len(heading)
    assert "no magnetic field" in played["status"][0].messages[0]


def test_status_names_rest_and_where_the_heading_comes_from() -> None:
    made = Turns(14.0)
    made.field[1200:] += [60e-6, 0.0, 0.0]  # beside iron
    played = play(OrientationFilter(), {"imu": made.imu(), "magnetic_field": made.fields()})
    words = [(m.messages[0], int(m.levels[0])) for m in played["status"]]
    disturbed = ("in motion; magnetic field disturbed: heading from the gyroscope meanwhile", 1)
    assert words[0] == disturbed  # until the field has been the same for some seconds
    assert words[-2:] == [("in motion; heading from the magnetic field", 0), disturbed]
    assert any(word.startswith("at rest; ") for word, _ in words)
    asked = play(OrientationFilter(heading="relative"), {"imu": made.imu()})["status"][-1]
    assert asked.messages == ("in motion; heading from the gyroscope alone, as asked",)
    assert asked.levels.tolist() == [0]


def test_dropped_samples_are_bridged() -> None:
    made = Turns()
    samples = [m for k, m in enumerate(made.imu()) if k < 50 or k % 7]
    played = play(OrientationFilter(), {"imu": samples, "magnetic_field": made.fields()})
    assert np.degrees(made.errors(played)[0][200:].max()) < 4


def test_long_gap_restarts_the_filter_and_is_counted() -> None:
    made = Turns()
    operator = OrientationFilter(heading="relative")
    samples = made.imu()
    played = play(operator, {"imu": samples[:300] + samples[400:]})
    assert operator.summary()["ignored, gap, begun anew"] == 1
    assert len(played["oriented"]) == len(samples) - 100 - 2 * 15


def test_non_finite_input_is_ignored_and_counted() -> None:
    made = Turns(4.0)
    samples, fields = made.imu(), made.fields()
    samples[150] = Imu(
        stamp=samples[150].stamp, frame="imu", angular_velocity=[np.nan, 0, 0], linear_acceleration=[0, 0, 9.8]
    )
    fields[200] = MagneticField(stamp=fields[200].stamp, frame="imu", field=[np.nan, 0, 0])
    operator = OrientationFilter()
    played = play(operator, {"imu": samples, "magnetic_field": fields})
    figures = operator.summary()
    assert figures["ignored, sample not finite"] == figures["ignored, field not finite or zero"] == 1
    assert np.isfinite([m.orientation for m in played["oriented"]]).all()


def test_a_field_in_another_frame_is_an_error() -> None:
    field = MagneticField(stamp=1, frame="mast", field=FIELD)
    operator = OrientationFilter()
    operator.setup()
    with pytest.raises(ValueError, match="in the frame 'mast' but the inertial samples in 'imu'"):
        operator.process(Turns(1.0).imu()[0], field)


def test_restored_operator_resumes_alike() -> None:
    made = Turns(4.0)
    assert_resumes_alike(OrientationFilter, list(zip(made.imu(), made.fields(), strict=True)), 250)


@pytest.mark.data
def test_error_on_broad_is_within_that_of_its_paper(data_dir: Path) -> None:
    trial = read_trial(data_dir / "broad_imu" / "16_undisturbed_fast_translation_B.hdf5")
    filter = Orientation(1 / trial.rate)
    scored, found = trial.movement & np.isfinite(trial.orientations).all(axis=1), []
    for k in range(25_000):
        filter.feel(round(k * 1e9 / trial.rate), trial.gyroscope[k], trial.accelerometer[k])
        if np.isfinite(trial.magnetometer[k]).all():
            filter.see(trial.magnetometer[k])
        found.append(filter.orientation(magnetic=True))
    rows = np.flatnonzero(scored[:25_000])
    difference = differences(np.array(found)[rows], np.roll(trial.orientations, -1, axis=1)[rows])
    assert np.degrees(np.sqrt((errors(difference)[0] ** 2).mean())) < 1.0
