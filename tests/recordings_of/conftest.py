"""Makes the operators of the kept recordings importable, here and in the processes of a run."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parent))
