"""The columns of a sweep's table."""

from __future__ import annotations

import math
import subprocess
import sys

import pyarrow as pa
import pytest

from dataflow.sweep.columns import table

SCHEMA = pa.schema(
    [("text", pa.string()), ("whole", pa.int64()), ("real", pa.float64()), ("map", pa.map_(pa.string(), pa.float64()))]
)
ROWS = [
    {"text": "é", "whole": 3, "real": 1.5, "map": [("k", 1.0), ("naïve", -math.inf)]},
    {"whole": None, "real": None, "map": []},
    {"text": "", "whole": -(2**60), "real": math.inf, "map": [("q", 2.0)]},
    *({"text": str(k), "whole": k, "real": k / 3, "map": []} for k in range(20)),
]


@pytest.mark.parametrize("rows", [ROWS, ROWS[:1], []], ids=len)
def test_a_table_is_that_of_pyarrow(rows: list[dict[str, object]]) -> None:
    made = table(rows, SCHEMA)

    made.validate(full=True)
    assert made.equals(pa.Table.from_pylist(rows, SCHEMA))


def test_a_table_takes_no_pandas() -> None:
    code = (
        "import sys, pyarrow as pa; from dataflow.sweep.columns import table; "
        "table([{'a': 'x', 'n': 1}], pa.schema([('a', pa.string()), ('n', pa.int64())])); "
        "sys.exit('pandas' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], timeout=60, check=False).returncode == 0
