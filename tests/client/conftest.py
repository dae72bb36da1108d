"""Makes the operators of the runtime's tests importable."""

from __future__ import annotations

import sys
from pathlib import Path

RUNTIME = Path(__file__).resolve().parent.parent / "runtime"
sys.path += [str(RUNTIME)]
