"""Mean vectors of objects by id."""

from __future__ import annotations

import numpy as np
import pytest
from repeated import assert_repeats

from dataflow.execution.failure import OperatorFailure
from dataflow.messages import FeatureVector
from dataflow.testing import play
from operators.recognition import FeatureMemory

HALF = 0.5**0.5


def vectors(stamp: int, rows: dict[int, tuple[float, ...]], model: str = "m") -> FeatureVector:
    return FeatureVector(
        stamp=stamp, model=model, vectors=np.array([*rows.values()], np.float32), ids=np.array([*rows], np.int64)
    )


def given(*messages: FeatureVector, **params: int) -> list[dict[int, list[float]]]:
    """The means of each answer by id."""
    answers = play(FeatureMemory(**params), {"features": list(messages)})["means"]
    return [dict(zip(a.ids.tolist(), a.vectors.round(4).tolist(), strict=True)) for a in answers]


def test_the_mean_direction_is_over_all_views_and_given_when_one_is_new() -> None:
    first, second, third = given(
        vectors(1, {4: (1, 0), 7: (0, 1)}), vectors(2, {4: (0, 1)}), vectors(3, {7: (0, 0), 4: (0, 1)})
    )
    assert first == {4: [1, 0], 7: [0, 1]}
    assert second == {4: [pytest.approx(HALF, abs=1e-4)] * 2}
    assert list(third) == [4], "what was not described is not given"
    assert third[4][1] == pytest.approx(2 / 5**0.5, abs=1e-4)


def test_memory_resets_on_another_model_and_forgets_old_vectors() -> None:
    assert given(vectors(1, {4: (1, 0)}), vectors(2, {4: (0, 1)}, "other"))[1] == {4: [0, 1]}
    answers = given(*(vectors(k, {i: (1, 0)}) for k, i in enumerate((1, 2, 1, 3))), vectors(9, {2: (0, 1)}), most=2)
    assert answers[-1] == {2: [0, 1]}, "2 was described before 1 and 3, so it is begun anew"


def test_restored_feature_memory_continues_identically() -> None:
    assert_repeats(FeatureMemory, [(vectors(1, {4: (1, 0)}),), (vectors(2, {4: (0, 1)}),)], 1)


def test_vectors_without_ids_are_refused() -> None:
    with pytest.raises(OperatorFailure, match="features have no ids"):
        given(vectors(1, {1: (1, 0)}).replace(ids=None))
