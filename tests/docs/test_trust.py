"""docs/trust.md names whatever opens a port."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
OPENS = re.compile(r"\.bind\(\(|\.listen\(|create_server\(|start_server\(|HTTPServer\(\(|--web-viewer")
NAMED = {
    "dataflow/debugging/dap/session.py": "`dataflow debug --dap PORT`",
    "dataflow/foxglove/server.py": "`dataflow foxglove`",
    "dataflow/client/metrics.py": "`dataflow metrics`",
    "dataflow/view/sink.py": "`--view serve`",
    "operators/sources/ports.py": "Sources of sensors on the network",
}
CLOSED_AT_ONCE = {"dataflow/doctor/machine.py", "dataflow/machines/keys.py"}
"""They look whether a port is free."""


def test_every_port_that_is_opened_is_named() -> None:
    files = [path for room in ("dataflow", "operators") for path in (ROOT / room).rglob("*.py")]
    opening = {str(path.relative_to(ROOT)) for path in files if OPENS.search(path.read_text(encoding="utf-8"))}
    assert opening - CLOSED_AT_ONCE == NAMED.keys()
    page = (ROOT / "docs/trust.md").read_text(encoding="utf-8")
    assert [text for text in NAMED.values() if text not in page] == []
