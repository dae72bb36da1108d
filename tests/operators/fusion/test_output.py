"""The status of the filter: a row for each sensor."""

from __future__ import annotations

import numpy as np
import pytest

from dataflow.messages import Level
from operators.fusion.filter.gate import Health, RejectedMeasurement
from operators.fusion.output import diagnostics

NOW = 100 * 10**9
DOUBT = RejectedMeasurement(NOW, np.ones(3), np.eye(3), "Position")


@pytest.mark.parametrize(
    ("health", "warnings", "text", "level"),
    [
        (Health(), {}, "silent", Level.STALE),
        (Health(last_used=NOW - 10**9), {}, "used", Level.OK),
        (Health(last_used=NOW - 3 * 10**9), {}, "silent", Level.STALE),
        (Health(last_used=NOW - 3 * 10**9, doubts=(DOUBT,)), {}, "refused", Level.ERROR),
        (Health(last_used=NOW - 10**9, doubts=(DOUBT,)), {}, "used", Level.OK),
        (Health(last_used=NOW, nis=4.0), {}, "covariance too small", Level.WARN),
        (Health(last_used=NOW, nis=4.0), {"gps": "it is late"}, "it is late", Level.WARN),
    ],
)
def test_row_of_a_sensor_names_its_state(health: Health, warnings: dict[str, str], text: str, level: Level) -> None:
    status = diagnostics(NOW, {"gps": health}, {}, {}, warnings)
    row = list(status.names).index("gps")
    assert status.messages[row] == text
    assert status.levels[row] == level
