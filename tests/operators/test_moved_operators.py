"""Former paths of this package's operators lead to where they are now."""

from __future__ import annotations

import pytest

from dataflow.graph.catalogue import look_up
from operators import MOVED_OPERATORS


@pytest.mark.parametrize("former", MOVED_OPERATORS)
def test_a_moved_operator_is_found_where_it_is_listed_now(former: str) -> None:
    found = look_up(former)

    assert found == look_up(found.operator.__name__)
    assert found.use == MOVED_OPERATORS[former]
