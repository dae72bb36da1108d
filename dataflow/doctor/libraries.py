"""Libraries: what the installed package declares, whether it is there in a fitting version, and whether it loads."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from importlib.metadata import PackageNotFoundError, requires, version

from dataflow.doctor.finding import Finding, State
from dataflow.extras import DISTRIBUTION, is_optional

GROUP = "libraries"
COLLECTIONS = ("all", "dev")
"""Extras that only bring others together, or serve work on dataflow itself."""
LOADED = (
    "zenoh",
    "rerun",
    "mcap",
    "numpy",
    "cv2",
    "onnxruntime",
    "scipy",
    "small_gicp",
    "h5py",
    "vqf",
    "open3d",
    "torch",
)
"""Modules with native code, which can be there and not load."""
LOAD_WITHIN = 90.0

_REQUIREMENT = re.compile(r"(?P<name>[\w.-]+)(?:\[[\w,-]+\])?\s*(?P<bounds>[^;]*)(?:;\s*(?P<marker>.*))?")
_EXTRA = re.compile(r"extra\s*==\s*['\"](\w+)['\"]")

_LOAD = """
import ctypes, importlib, importlib.util, json, sys
found = {}
for name in sys.argv[1:]:
    try:
        if name == "open3d" and importlib.util.find_spec("libusb_package"):  # Open3D links to libusb
            usb = importlib.import_module("libusb_package").get_library_path()
            ctypes.CDLL(str(usb), mode=ctypes.RTLD_GLOBAL)
        module = importlib.import_module(name)
        found[name] = ""
        if name == "onnxruntime":
            found["onnxruntime providers"] = " ".join(module.get_available_providers())
    except ModuleNotFoundError as error:
        found[name] = "missing" if error.name == name else f"needs {error.name}"
    except BaseException as error:
        found[name] = f"{type(error).__name__}: {error}"
print("\\n" + json.dumps(found))
"""


def check_libraries() -> Iterator[Finding]:
    """Versions first, which is quick, then one process that loads what has native code."""
    yield from check_versions(_declared(), version)
    yield from check_loading(load(LOADED))


def _declared() -> list[str]:
    try:
        return requires(DISTRIBUTION) or []
    except PackageNotFoundError:
        return []


def check_versions(declared: list[str], version_of: Callable[[str], str]) -> Iterator[Finding]:
    """A finding for every package that is missing or does not fit, and one for all that do."""
    fitting, missing = 0, dict[str, list[str]]()
    for text in declared:
        match = _REQUIREMENT.match(text)
        if match is None or match["name"] == DISTRIBUTION:
            continue
        found = _EXTRA.search(match["marker"] or "")
        extra = found[1] if found else ""
        if extra in COLLECTIONS:
            continue
        name, bounds = match["name"], match["bounds"].strip(" ()")
        try:
            installed = version_of(name)
        except PackageNotFoundError:
            if not extra:
                hint = f"pip install '{name}{bounds}'"
                yield Finding(GROUP, name, State.FAULT, "is not installed", hint)
            else:
                missing.setdefault(extra, []).append(name)
            continue
        if (broken := unmet(installed, bounds)) is not None:
            text = f"{installed} is installed; {broken} is needed"
            yield Finding(GROUP, name, State.WARNING, text, f"pip install '{name}{bounds}'")
        else:
            fitting += 1
    if not declared:
        hint = f"install {DISTRIBUTION}; from a checkout: pip install -e ."
        yield Finding(GROUP, DISTRIBUTION, State.WARNING, "is not installed, so its requirements are not known", hint)
    else:
        yield Finding(GROUP, "packages", State.OK, f"{fitting} installed in versions that fit")
    for extra, names in missing.items():
        text = f"without {', '.join(names)}"
        yield Finding(GROUP, f"extra [{extra}]", State.NOTE, text, f"pip install '{DISTRIBUTION}[{extra}]'")


def unmet(installed: str, bounds: str) -> str | None:
    """The first of bounds such as `>=1.2,<2` that a version does not meet."""
    have = _numbers(installed)
    for bound in filter(None, (part.strip() for part in bounds.split(","))):
        sign, wanted = re.match(r"[<>=!~]*", bound)[0], _numbers(bound.lstrip("<>=!~ "))  # type: ignore[index]
        width = max(len(have), len(wanted))
        left, right = (numbers + (0,) * (width - len(numbers)) for numbers in (have, wanted))
        met = {">=": left >= right, "<": left < right, ">": left > right, "<=": left <= right, "==": left == right}
        if not met.get(sign, True):
            return bound
    return None


def _numbers(text: str) -> tuple[int, ...]:
    return tuple(int(part) for part in re.match(r"[\d.]*", text)[0].split(".") if part)  # type: ignore[index]


def load(modules: tuple[str, ...]) -> Mapping[str, str]:
    """Loads modules in another process: by name what is wrong with it, "missing", or nothing."""
    try:
        done = subprocess.run(
            [sys.executable, "-P", "-c", _LOAD, *modules], capture_output=True, text=True, timeout=LOAD_WITHIN
        )
    except subprocess.TimeoutExpired:
        return dict.fromkeys(modules, f"does not load within {LOAD_WITHIN:g} s, alone or with the others")
    try:
        return dict(json.loads(done.stdout.strip().rpartition("\n")[2]))
    except ValueError:
        last = (done.stderr.strip() or f"exit code {done.returncode}").rpartition("\n")[2]
        return {"libraries": f"loading them ended the process: {last}"}


def check_loading(found: Mapping[str, str]) -> Iterator[Finding]:
    """A finding for every module that does not load, and one for those that do."""
    loaded = [name for name, fault in found.items() if not fault]
    for name, fault in found.items():
        if name == "onnxruntime providers" or not fault or (fault == "missing" and is_optional(name)):
            continue
        hint = "install it again, with the libraries that it names"
        yield Finding(GROUP, name, State.FAULT, f"does not load: {fault}", hint)
    if loaded:
        yield Finding(GROUP, "native code", State.OK, f"loads: {', '.join(loaded)}")
    if providers := found.get("onnxruntime providers"):
        yield Finding(GROUP, "onnxruntime", State.OK, f"runs networks on {providers}")
