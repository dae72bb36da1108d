"""A module that reads files and folders of the folder `LOOKING`: while it is imported, and when it is called."""

from __future__ import annotations

import importlib.metadata
import os
from glob import glob
from pathlib import Path
from typing import Any

import helped

from dataflow.messages import Number
from dataflow.operator import In, Operator

FOLDER = Path(os.environ["LOOKING"])
AT_IMPORT = (FOLDER / "at_import").read_text()


class Made(Operator):
    """The engine looks for packages when a class of operators is made."""

    x: In[Number]

    def process(self, x: Number) -> None: ...


def read() -> dict[str, object]:
    (FOLDER / "made").mkdir(exist_ok=True)
    (FOLDER / "made" / "written").write_text("")
    return {
        "listed": sorted(_tried(os.listdir, FOLDER / "listed")),
        "scanned": sorted(entry.name for entry in _tried(os.scandir, FOLDER / "scanned")),
        "found": len(glob(str(FOLDER / "found" / "*"))),
        "time": _tried(os.path.getmtime, FOLDER / "dated"),
        "size": _tried(os.stat, FOLDER / "sized"),
        "there": (FOLDER / "asked").exists(),
        "here": os.getcwd(),
        "here too": str(Path.cwd()),
        "made": len(os.listdir(FOLDER / "made")),
        "written": (FOLDER / "made" / "written").exists(),
        "packages": importlib.metadata.version("numpy"),
        "helped": helped.HELPED,
    }


def _tried(function: Any, path: Path) -> Any:
    try:
        return function(path)
    except FileNotFoundError:
        return []
