"""Makes the operators of the kept recordings importable."""

from __future__ import annotations

import sys
from pathlib import Path

KEPT = Path(__file__).resolve().parent.parent / "recordings_of"
sys.path.append(str(KEPT))
