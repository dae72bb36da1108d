"""Makes the test operators importable, here and in processes, and environments with a tiny package."""

from __future__ import annotations

import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path.append(str(HERE))
