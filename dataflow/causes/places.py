"""Finds the line of the operator's code that led to a call."""

from __future__ import annotations

import importlib.util
import sys
import sysconfig
from collections.abc import Iterable
from pathlib import Path
from types import CodeType, FrameType, ModuleType

_ENGINE = str(Path(__file__).parent.parent)
_PATHS = sysconfig.get_paths()
_LIBRARIES = ("/site-packages/", "/dist-packages/")
_STANDARD = tuple({_PATHS["stdlib"], _PATHS["platstdlib"]})


class Places:
    """Divides code by its file: the engine's, the standard library's, that of installed libraries, and the rest, which
    is the operator's own. The packages of `modules` are own code wherever they are installed."""

    def __init__(self, modules: Iterable[str]) -> None:
        self._own = tuple(folder for name in modules for folder in _folders(name.partition(".")[0]))
        self._known: dict[str, str] = {}

    def of(self, code: CodeType) -> str:
        """Returns "own", "engine", "standard" or "library"."""
        file = code.co_filename
        if (found := self._known.get(file)) is None:
            found = self._known[file] = self._place(file)
        return found

    def modules(self) -> list[ModuleType]:
        """Returns the loaded modules of own code."""
        loaded = [(module, getattr(module, "__file__", None)) for module in list(sys.modules.values())]
        return [module for module, file in loaded if isinstance(file, str) and self._place(file) == "own"]

    def _place(self, file: str) -> str:
        if file.startswith(self._own):
            return "own"
        if file.startswith(_ENGINE):
            return "engine"
        if any(folder in file for folder in _LIBRARIES):
            return "library"
        return "standard" if file.startswith((*_STANDARD, "<")) else "own"

    def led(self, frame: FrameType | None) -> tuple[FrameType, FrameType | None] | None:
        """Returns the innermost frame of own code among the callers, and the frame that its line called, if any; None
        where none is."""
        inside: FrameType | None = None
        while frame is not None:
            if self.of(frame.f_code) == "own":
                return frame, inside
            inside, frame = frame, frame.f_back
        return None

    def passes(self, frame: FrameType) -> bool:
        """Returns whether a caller is the engine or the standard library, whose waits need the real clocks."""
        return self.owner(frame) in ("engine", "standard")

    def asked_by(self, frame: FrameType | None) -> str:
        """Returns whose code asks for something, itself or by the standard library; "engine" where there is none."""
        while frame is not None:
            if (owner := self.owner(frame)) != "standard":
                return owner
            frame = frame.f_back
        return "engine"

    def owner(self, frame: FrameType) -> str:
        """Returns whose code a frame runs; what `exec` made, such as the `__init__` of a dataclass, is its caller's."""
        while frame.f_code.co_filename.startswith("<string") and frame.f_back is not None:
            frame = frame.f_back
        return self.of(frame.f_code)


def _folders(package: str) -> list[str]:
    if package == "dataflow" or package in sys.stdlib_module_names:
        return []
    spec = importlib.util.find_spec(package)
    if spec is None:
        return []
    return [*(spec.submodule_search_locations or ()), *([spec.origin] if spec.origin else [])]
