"""Makes the operators of the kept recordings, and of the runtime's tests, importable."""

from __future__ import annotations

import sys
from pathlib import Path

TESTS = Path(__file__).resolve().parent.parent
sys.path += [str(TESTS / "recordings_of"), str(TESTS / "runtime")]
