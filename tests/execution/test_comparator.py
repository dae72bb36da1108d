"""What a re-execution is compared by: differences are counted once for each output, and all of them have a digest."""

from __future__ import annotations

import pytest

from dataflow.execution.comparator import Comparator
from dataflow.messages import Number
from dataflow.records.comparison import Verification
from dataflow.records.firing import Emission, FiringRecord


def judged(*made: float | None, error: str = "") -> Verification:
    """What comparing calls shows that made 0.0 in the run: `made` instead, or nothing, with an error."""
    comparator = Comparator("x", ("out",), {})
    for index, value in enumerate(made):
        then = Number(stamp=index, value=0.0)
        record = FiringRecord("x", 0, index, "fire", index, outputs=(Emission(index, index, then.digest()),))
        comparator.error(record, RuntimeError(error) if error else None)
        list(comparator.outputs(record, {} if value is None else {"out": Number(stamp=index, value=value)}))
    return comparator.result


def test_a_call_that_raises_in_place_of_its_output_is_one_difference() -> None:
    found = judged(None, None, 0.0, error="no answer is recorded")

    assert (found.outputs, found.differing) == (3, 3)


def test_a_call_that_raises_without_an_output_is_a_difference() -> None:
    comparator = Comparator("x", ("out",), {})

    comparator.error(FiringRecord("x", 0, 0, "fire", 0, outputs=(None,)), RuntimeError("no"))

    assert comparator.result.differing == 1


@pytest.mark.parametrize(("made", "same"), [((1.0, 0.0, 2.0), True), ((1.0, 0.0, 3.0), False), ((1.0, 2.0), False)])
def test_digest_distinguishes_the_outputs_of_all_calls(made: tuple[float, ...], same: bool) -> None:
    assert (judged(1.0, 0.0, 2.0).differences == judged(*made).differences) is same


def test_nothing_differs_where_all_is_as_recorded() -> None:
    assert judged(0.0, 0.0).differences == ""


def test_digest_distinguishes_messages_that_the_run_did_not_make() -> None:
    found = []
    for value in (1.0, 2.0):
        comparator = Comparator("x", ("out",), {})
        list(
            comparator.outputs(
                FiringRecord("x", 0, 0, "fire", 0, outputs=(None,)), {"out": Number(stamp=0, value=value)}
            )
        )
        found.append(comparator.result.differences)

    assert found[0] != found[1]
