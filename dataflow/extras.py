"""Names the extra of this distribution that installs a missing package."""

from __future__ import annotations

import platform
import re
import traceback
from functools import cache

DISTRIBUTION = "robot-dataflow"
_OF_MODULES = {
    "cv2": "opencv-python-headless",
    "foxglove": "foxglove-sdk",
    "rerun": "rerun-sdk",
    "ruamel": "ruamel.yaml",
    "small_gicp": "small-gicp",
}
"""Module → distribution, where the names differ."""
INSTALL = "it comes with: pip install"
_COLLECTIONS = ("all", "dev")
_BY_CALLER = {"operators.": "perception", "dataflow.view": "view", "dataflow.sweep.plan": "remote", "dataflow.": "bags"}
"""Package of the importing module → the extra that serves it, where several extras bring what is missing."""

_REQUIREMENT = re.compile(r"([\w.-]+)[^;]*;\s*(?:(.*)\s+and\s+)?extra\s*==\s*['\"](\w+)['\"]")


def missing_extra(error: BaseException | None) -> str:
    """Returns "it comes with: pip install ..." for an error that a missing package caused; "" if no extra has it.

    Where the package has no build for processors as this one with every Python, that condition is given, too.
    """
    while error is not None:
        if isinstance(error, ModuleNotFoundError) and error.name:
            if not (extras := _extras().get(_distribution(error.name))):
                return ""
            extra = _chosen(tuple(extras), error)
            where = f", where {extras[extra]}" if platform.machine() in extras[extra] else ""
            return f"{INSTALL} '{DISTRIBUTION}[{extra}]'{where}"
        error = error.__cause__ or error.__context__
    return ""


def is_optional(module: str) -> bool:
    """Returns whether only extras bring a module."""
    return _distribution(module) in _extras()


def _distribution(module: str) -> str:
    top = module.partition(".")[0]
    return _OF_MODULES.get(top, top)


@cache
def _extras() -> dict[str, dict[str, str]]:
    """Returns, by distribution, the extras that bring it, sorted, each with the condition under which it does."""
    from importlib.metadata import PackageNotFoundError, requires  # a command that lacks nothing need not load it

    try:
        declared = requires(DISTRIBUTION) or []
    except PackageNotFoundError:
        return {}
    found: dict[str, dict[str, str]] = {}
    for text in declared:
        if (match := _REQUIREMENT.match(text)) and match[3] not in _COLLECTIONS and match[1] != DISTRIBUTION:
            found.setdefault(match[1], {})[match[3]] = (match[2] or "").strip("()")
    return {name: dict(sorted(extras.items())) for name, extras in found.items()}


def _chosen(extras: tuple[str, ...], error: BaseException) -> str:
    """Returns the extra that the importing module belongs to, else the first."""
    for frame, _ in reversed(list(traceback.walk_tb(error.__traceback__))):
        caller = str(frame.f_globals.get("__name__", ""))
        for package, extra in _BY_CALLER.items():
            if caller.startswith(package) and extra in extras:
                return extra
    return extras[0]
