"""The `dataflow` command for `python -m dataflow.cli.main`, and the commands as a typer application."""

from __future__ import annotations

import sys

if __name__ == "__main__" and not sys.flags.safe_path:
    del sys.path[0]  # the current folder, before anything is imported: what lies there must not replace modules

from dataflow.cli.app import app
from dataflow.cli.start import main

__all__ = ["app", "main"]

if __name__ == "__main__":
    main()
