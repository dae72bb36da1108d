"""Several estimates side by side: how they are united, reduced to those that are likely, and given sensors' errors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from operators.fusion.filter.error_state import ROTATION, SIZE, VELOCITY, State, difference
from operators.fusion.filter.history import Hypothesis, Node

_LIKELY = 5.0
"""Logarithm of the ratio of weights beyond which a hypothesis does not count."""
_FOLLOWED = 20_000_000_000
"""Nanoseconds in motion for which headings are followed against the one told: nothing shows a heading at rest."""
_DOUBTED, _TRUSTED = 0.03, 0.01
"""Probability that the given first heading is wrong, from which it is in question, and until which. Headings
against it begin with 0.01 in all: by Ville's inequality a right one comes into question once in three times at most."""


def with_errors(node: Node, sigmas: Sequence[float]) -> Node:
    """Returns the node with an error of a sensor, 0, for each standard deviation, unless it has them."""
    made = []
    for h in node.hypotheses:
        known = len(h.state.covariance)
        covariance = np.zeros((SIZE + len(sigmas),) * 2)
        covariance[:known, :known] = h.state.covariance
        fresh = range(known, len(covariance))
        covariance[fresh, fresh] = np.square(sigmas[known - SIZE :])
        errors = np.concatenate([h.state.errors, np.zeros(len(fresh))])
        made.append(replace(h, state=replace(h.state, covariance=covariance, errors=errors)))
    return replace(node, hypotheses=tuple(made))


def likely(hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Returns the hypotheses that are not much less likely than the best."""
    best = max(h.weight for h in hypotheses)
    return [h for h in hypotheses if h.weight >= best - _LIKELY]


def refuted(hypotheses: Sequence[Hypothesis], before: bool) -> bool:
    """Returns whether the given first heading is refuted: by the best hypothesis, and from then on
    (`before`) until none of the likely ones is against it.
    """
    best = max(hypotheses, key=lambda h: h.weight)
    return any(h.against for h in (likely(hypotheses) if before else [best]))


def doubted(hypotheses: Sequence[Hypothesis], before: bool) -> bool:
    """Returns whether the given first heading is in question; `before`: it was."""
    best = max(h.weight for h in hypotheses)
    chances = [(math.exp(h.weight - best), h.against) for h in hypotheses]
    wrong = sum(chance for chance, against in chances if against) / sum(chance for chance, _ in chances)
    return wrong > (_TRUSTED if before else _DOUBTED)


def combined(hypotheses: Sequence[Hypothesis]) -> State:
    """Returns the likeliest state, with a covariance that holds the others too."""
    best = max(hypotheses, key=lambda h: h.weight)
    hypotheses = likely(hypotheses)
    if len(hypotheses) == 1:
        return best.state
    weights = np.exp([h.weight - best.weight for h in hypotheses])
    weights /= weights.sum()
    covariance = np.zeros_like(best.state.covariance)
    for weight, h in zip(weights, hypotheses, strict=True):
        apart = difference(best.state, h.state)
        covariance += weight * (h.state.covariance + np.outer(apart, apart))
    return replace(best.state, covariance=covariance)


def moves(state: State) -> bool:
    """Returns whether the body moves beyond doubt."""
    return float(state.velocity @ state.velocity) > 9.0 * float(np.trace(state.covariance[VELOCITY, VELOCITY]))


def reduced(hypotheses: Sequence[Hypothesis], moving: int) -> tuple[Hypothesis, ...]:
    """Drops hypotheses that have become unlikely or outlived their time in motion (ns), and unites those alike."""
    if len(hypotheses) == 1:
        return (replace(hypotheses[0], weight=0.0),)
    best = max(hypotheses, key=lambda h: h.weight)
    hypotheses = [h for h in hypotheses if h is best or not (h.against and moving > _FOLLOWED)]
    ordered = sorted(hypotheses, key=lambda h: -h.weight)
    kept: list[Hypothesis] = []
    for h in ordered:
        if h.weight < ordered[0].weight - 14.0:  # one in a million
            continue
        for k, other in enumerate(kept):
            apart = difference(other.state, h.state)[ROTATION]
            if float(apart @ np.linalg.solve(other.state.covariance[ROTATION, ROTATION], apart)) < 1.0:
                kept[k] = replace(other, weight=float(np.logaddexp(other.weight, h.weight)))
                break
        else:
            kept.append(h)
    return tuple(replace(h, weight=h.weight - kept[0].weight) for h in kept)
