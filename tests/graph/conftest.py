"""Makes `graph_operators` importable, as a user's own package of operators would be."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))
