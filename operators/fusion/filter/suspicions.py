"""Errors that sensors were not told to have, looked for in a window: late stamps, speeds of a wrong scale.

A delay looks like another heading, speed or bias until the robot has turned and braked, and a filter that was
linearised about those believes them. The motion in the window is therefore fitted anew, by the method of Gauss and
Newton, with such errors and without; the evidence is how much better it fits with them (generalised likelihood ratio).
Forster et al., "On-manifold preintegration for real-time visual-inertial odometry", 2017; Friedland, "Treatment of bias
in recursive filtering", 1969; Willsky and Jones, "A generalized likelihood ratio approach to the detection and
estimation of jumps in linear systems", 1976.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from dataflow.operator import Remembered
from operators.estimation.chi_square import quantile
from operators.fusion.filter.error_state import (
    POSITION,
    ROTATION,
    SIZE,
    VELOCITY,
    State,
    difference,
    exp_rotation,
    moved,
    shifted,
)
from operators.fusion.filter.measurements import Measurement, Model, Velocity
from operators.fusion.filter.sensor_errors import SensorErrors
from operators.fusion.filter.window import Step, Window, places

Array = NDArray[np.float64]
CHANCE = 6e-5
"""Probability of evidence as strong in a window where nothing is wrong, that of four standard deviations."""
_RARE = 6e-7
"""The same of five, for a window that slides: it passes u standard deviations by chance about u² times as often as
windows side by side (Pickands, "Upcrossing probabilities for stationary Gaussian processes", 1969), four of them once
in six hours, five once in 400."""
_CEASES = 0.25
"""Share of the first evidence at which an error that was found no longer counts, and one is looked for at all."""
_EVERY = 1_000_000_000
"""Nanoseconds from one look to the next."""
_FEWEST = 5
"""Steps that a fit needs."""
_ROUNDS = 4
"""Linearisations of a fit at most; the next look goes on where they end."""
_SETTLED = 1e-2
"""Change of rotations (rad), biases and errors (s, shares) that ends them."""
_EXPLAINS = 1.5
"""Mean of a fit's squared residuals by their covariance, above which the noise is other than told: it shows nothing."""
LATE, SCALE = "late", "scale"
_SPREAD = {LATE: 1.0, SCALE: 0.2}
"""Standard deviations of errors before anything is measured, s and shares."""
_MOST = 0.5
"""Change of an error in one round at most, s or a share."""
_LOOSE = (1e3, 1e2, 0.1)
"""Standard deviations of a window's first position, velocity and tilt (m, m/s, rad)."""
_TURNED = 2.0
"""Standard deviation of its heading, rad."""
_MOMENT = 1e-3
"""Seconds over which the change of a prediction is taken."""


@dataclass(frozen=True, eq=False)
class WindowFit:
    """Holds the motion that fits a window best: the state at its first step, and sensors' errors (S,).

    `cost`: squared residuals by their covariance; `sigmas` (S,) of the errors; `freedom`: how many were measured;
    `end`: the state at the last step, of the time `until` (ns), with its covariance;
    `promise`: by how much the cost would be less with errors, as far as it is linear.
    """

    time: int
    state: State
    errors: Array
    cost: float = 0.0
    sigmas: Array = field(default_factory=lambda: np.zeros(0))
    freedom: int = 0
    until: int = 0
    end: State | None = None
    promise: float = 0.0

    @property
    def explains(self) -> bool:
        """Returns whether what was measured agrees with the fit as well as its noise lets expect."""
        return self.cost <= _EXPLAINS * max(self.freedom, 1)


class Suspicions(Remembered):
    """Looks once a second for sensors whose stamps are late, or whose speeds are of a wrong scale."""

    _looked: int
    _found: tuple[str, str, float, float] | None
    _suspected: list[tuple[str, str]]
    _fits: list[WindowFit]  # without errors, and with them

    def __init__(self, known: SensorErrors, gravity: Array, biases: tuple[float, float]) -> None:
        self._known, self._gravity = known, gravity
        self._loose = np.repeat([*_LOOSE, *biases], 3)
        self._looked, self._found, self._suspected, self._fits, self._sure = 0, None, [], [], True

    @property
    def found(self) -> tuple[str, str, float, float] | None:
        """Returns sensor, kind, size and standard deviation (s, or a share) of the error that explains most, if any."""
        return self._found

    def look(self, time: int, window: Window, sure: bool = True) -> WindowFit | None:
        """Looks, once a second; returns the motion of late, None if it was not fitted or if speeds are wrong.

        `sure`: nothing contradicts the given first heading.
        """
        if time - self._looked < _EVERY:
            return None
        self._looked, self._sure = time, sure
        suspected = self._suspects(window)
        fits = len(window.steps) - window.first >= _FEWEST and bool(suspected)
        if suspected != self._suspected or not fits:
            self._suspected, self._fits, self._found = suspected, [], None
        if not fits:
            return None
        ceases = _CEASES * float(quantile(1 - CHANCE, len(suspected)))
        without = self._fitted(window, False)
        if self._found is None and without.promise < ceases:  # a second fit is not worth its time
            self._fits = [without]
            return without if without.explains else None
        self._fits = [without, self._fitted(window, True)]
        begins = float(quantile(1 - (_RARE if window.first else CHANCE), len(suspected)))
        self._found = self._judged(without, self._fits[1], ceases if self._found else begins)
        if self._found is not None and self._found[1] == SCALE:
            return None
        fit = self._fits[self._found is not None]
        return fit if fit.explains else None

    def _suspects(self, window: Window) -> list[tuple[str, str]]:
        """Returns sensors and the kinds of error that are looked for: those that are not estimated."""
        estimated = {(name, LATE) for name, _ in self._known.clocks} | {(name, SCALE) for name, _ in self._known.scales}
        every = {
            (one.sensor, kind)
            for step in window.steps[window.first :]
            for one in step.measured
            if (kind := suspected(one.model)) is not None
        }
        return sorted(every - estimated)

    def _judged(self, without: WindowFit, erring: WindowFit, enough: float) -> tuple[str, str, float, float] | None:
        noise = max(erring.cost / erring.freedom, 1.0)  # the given noise may be too small
        if without.cost - erring.cost < enough * noise or not erring.explains:
            return None
        k = int(np.argmax(np.abs(erring.errors) / erring.sigmas))
        return *self._suspected[k], float(erring.errors[k]), float(erring.sigmas[k])

    def _fitted(self, window: Window, erring: bool) -> WindowFit:
        """Returns the motion that explains a window best, with errors of sensors or without."""
        steps = window.steps[window.first :]
        state, errors = self._begun(window, erring)
        prior, size = self._prior(steps[0]), SIZE + len(errors) * erring
        spread = np.diag([_SPREAD[kind] ** -2.0 for _, kind in self._suspected])
        for _ in range(_ROUNDS):
            information, score, cost, freedom, end, effects = self._linear(steps, state, errors)
            away = difference(state, steps[0].start)
            information[:SIZE, :SIZE] += prior
            score[:SIZE] += prior @ away
            information[SIZE:, SIZE:] += spread
            score[SIZE:] -= spread @ errors
            change = np.asarray(np.linalg.solve(information[:size, :size], score[:size]), np.float64)
            cost += float(away @ prior @ away + errors @ spread @ errors - score[:size] @ change)
            state = moved(state, change[:SIZE])
            if erring:
                errors = errors + change[SIZE:].clip(-_MOST, _MOST)
            if np.abs(change[ROTATION.start :]).max() < _SETTLED:
                break
        spreads = np.linalg.inv(information)
        sigmas, promise = np.sqrt(np.diag(spreads)[SIZE:]), float(score @ spreads @ score - score[:size] @ change)
        known = effects[:SIZE, :size]
        covariance = end.covariance + known @ np.linalg.solve(information[:size, :size], known.T)
        end = moved(end, known @ change, covariance)
        return WindowFit(steps[0].time, state, errors, cost, sigmas, freedom, steps[-1].time, end, promise)

    def _begun(self, window: Window, erring: bool) -> tuple[State, Array]:
        """Returns the state at the window's first step and the errors (S,) from which a fit begins."""
        times = [step.time for step in window.steps[: window.first + 1]]
        if not self._fits or self._fits[0].time not in times:
            return window.steps[window.first].start, np.zeros(len(self._suspected))
        fit = self._fits[-1 if erring else 0]
        state = fit.state
        for step in window.steps[times.index(fit.time) + 1 : window.first + 1]:
            state = step.motion.moved(state, self._gravity)[0]
        return state, fit.errors

    def _prior(self, first: Step) -> Array:
        """Returns what is known (15, 15) of the first state of a window before anything is measured."""
        if first.told and self._sure:
            scale = np.sqrt(np.diag(first.start.covariance))  # metres by the thousand beside biases: inverted without
            return np.asarray(np.linalg.inv(first.start.covariance / np.outer(scale, scale)) / np.outer(scale, scale))
        up = first.start.rotation[2]
        information = np.diag(self._loose**-2.0)
        information[ROTATION, ROTATION] += np.outer(up, up) * (_TURNED**-2.0 - self._loose[ROTATION.start] ** -2.0)
        return information

    def _linear(self, steps: Sequence[Step], x: State, errors: Array) -> tuple[Array, Array, float, int, State, Array]:
        """Returns information (15 + S, 15 + S) and score (15 + S,) of the first state and of the sensors' errors.

        Beside them the sum of squared residuals, and how many; the state at the last step, and how it changes with
        these. The noise of the motion is filtered out.
        """
        K, count = len(self._known.sigmas), len(errors)
        wander = self._known.wander
        P = np.diag(np.concatenate([np.zeros(SIZE), np.square(self._known.sigmas)]))
        effects, mean = np.zeros((SIZE + K, SIZE + count)), np.zeros(SIZE + K)
        effects[:SIZE, :SIZE] = np.eye(SIZE)
        information, score = np.zeros((SIZE + count,) * 2), np.zeros(SIZE + count)
        cost, freedom = 0.0, 0
        x = replace(x, errors=np.zeros(K))
        for k, step in enumerate(steps):
            if k:
                x, F, Q = step.motion.moved(x, self._gravity)
                left = 1.0 - wander.decay * step.motion.seconds
                mean = np.concatenate([F @ mean[:SIZE], left * mean[SIZE:]])
                effects = np.vstack([F @ effects[:SIZE], left[:, None] * effects[SIZE:]])
                G = np.zeros((SIZE + K,) * 2)
                G[:SIZE, :SIZE], G[SIZE:, SIZE:] = F, np.diag(left)
                P = G @ P @ G.T
                P[:SIZE, :SIZE] += Q
                P[SIZE:, SIZE:] += np.diag(wander.noise**2 * step.motion.seconds)
            for entry in step.measured:
                residual, H, signature = self._row(entry, x, step, errors)
                residual = residual - H @ mean
                A = H @ effects
                A[:, SIZE:] += signature
                PH = P @ H.T
                white = np.linalg.solve(H @ PH + entry.noise, np.column_stack([A, residual, PH.T]))
                information += A.T @ white[:, : SIZE + count]
                score += A.T @ white[:, SIZE + count]
                cost += float(residual @ white[:, SIZE + count])
                freedom += len(residual)
                gain = white[:, SIZE + count + 1 :].T
                mean, effects, P = mean + gain @ residual, effects - gain @ A, P - gain @ PH.T
        end = moved(replace(x, errors=np.zeros(0)), mean[:SIZE], P[:SIZE, :SIZE])
        return information, score, cost, freedom, end, effects

    def _row(self, entry: Measurement, x: State, step: Step, errors: Array) -> tuple[Array, Array, Array]:
        """Returns residual (M,), Jacobian (M, 15 + K), and what each error adds to the residual (M, S)."""
        suspect = entry.sensor, suspected(entry.model)
        own = self._suspected.index(suspect) if suspect in self._suspected else -1
        delay = float(errors[own]) - entry.assumed if own >= 0 and suspect[1] == LATE else 0.0
        residual, there = entry.model.innovation(_back(x, step, delay, self._gravity), step.gyro)
        H = np.zeros((len(residual), SIZE + len(x.errors)))
        H[:, :SIZE] = there
        if delay:
            H[:, VELOCITY] -= delay * there[:, POSITION]
            H[:, ROTATION] = there[:, ROTATION] @ exp_rotation((step.gyro - x.gyro_bias) * delay)
        signature = np.zeros((len(residual), len(errors)))
        if suspect[1] == SCALE and own >= 0:
            assert isinstance(entry.model, Velocity)
            signature[:, own] = entry.model.value
            residual = residual - entry.model.value * errors[own]
        elif own >= 0 or entry.clock >= 0:
            around = [_back(x, step, delay - s * _MOMENT, self._gravity) for s in (-0.5, 0.5)]
            before, after = (entry.model.innovation(at, step.gyro)[0] for at in around)
            if own >= 0:
                signature[:, own] = (after - before) / _MOMENT
            else:
                H[:, SIZE + entry.clock] = (after - before) / _MOMENT
        return self._known.taken_off(entry.sensor, entry.model, x, residual, H), H, signature


def suspected(model: Model) -> str | None:
    """Returns which error is looked for in a kind of measurement, None for none: rest has no scale."""
    if places(model):
        return LATE
    speeds = isinstance(model, Velocity) and len(model.value) == 3 and model.value.any()
    return SCALE if speeds else None


def _back(x: State, step: Step, seconds: float, gravity: Array) -> State:
    """Returns a state as it was some time (s) before a step."""
    acceleration = x.rotation @ (step.accel - x.accel_bias) + gravity
    there = shifted(x, step.gyro - x.gyro_bias, acceleration, -seconds)
    return replace(there, position=there.position + 0.5 * seconds**2 * acceleration)
