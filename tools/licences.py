"""Finds the licence of everything that the project's dependencies bring, and writes docs/licences.md.

python tools/licences.py > docs/licences.md
"""

from __future__ import annotations

import re
import sys
import tomllib
from collections.abc import Iterable, Mapping
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path

from packaging.requirements import Requirement

REPOSITORY = Path(__file__).resolve().parents[1]
PARTS = ("", "perception", "view", "bags", "foxglove", "notebook", "sim", "torch", "train")
"""The dependencies that users install: those of the package itself, and its extras but `dev` and the unlisted."""
UNLISTED = ("lidar", "mcp", "ray", "realsense")
"""Extras that development does not install; what they bring cannot be looked up."""
COPYLEFT = re.compile(r"\bA?GPL|(?<!Lesser )(?<!Library )General Public License", re.IGNORECASE)

BY_WORDS = {
    "Apache Software License": "Apache-2.0",
    "Apache 2": "Apache-2.0",
    "Apache 2.0": "Apache-2.0",
    "BSD License": "BSD-3-Clause",
    "3-Clause BSD License": "BSD-3-Clause",
    "BSD 3-Clause License": "BSD-3-Clause",
    "Eclipse Public License 2.0 (EPL-2.0)": "EPL-2.0",
    "FreeBSD": "BSD-2-Clause",
    "ISC License (ISCL)": "ISC",
    "MIT License": "MIT",
    "Mozilla Public License 2.0 (MPL 2.0)": "MPL-2.0",
    "Python Software Foundation License": "PSF-2.0",
}
"""Licences as metadata name them, by classifier or in words: the SPDX identifier."""

EITHER = {"eclipse-zenoh"}
"""Packages with several classifiers of which one may be chosen."""

_GCC = "GPL-3.0 with the GCC runtime library exception"
NOTES = {
    "eclipse-zenoh": "either of the two, as one chooses; used under Apache-2.0",
    "libusb-package": "the wheel brings libusb (LGPL-2.1), loaded at run time",
    "numpy": f"the wheel brings libgfortran ({_GCC}) and libquadmath (LGPL-2.1), linked dynamically",
    "open3d": "other libraries are built into the wheel; its metadata do not list them",
    "opencv-python-headless": "the wheel brings FFmpeg and libquadmath (LGPL-2.1), "
    f"and libgfortran ({_GCC}), linked dynamically",
    "scipy": f"the wheel brings libgfortran ({_GCC}) and libquadmath (LGPL-2.1), linked dynamically",
    "small-gicp": f"the wheel brings libgomp ({_GCC}), linked dynamically",
    "torch": "the usual wheel for Linux asks for NVIDIA's CUDA packages, which are proprietary and not listed here",
}
NOT_LISTED = ("cuda-", "nvidia-")
"""Prefixes of the packages that only some platforms' wheels of torch ask for."""

PAGE = """\
# Licences

<!-- Written by `python tools/licences.py > docs/licences.md`. -->

The project is under the [Apache License 2.0](../LICENSE), weights, recording and documentation included. It contains
no code, weights or data of others. The networks' weights were trained on images that the project rendered itself
([how](../operators/weights/README.md)).

It imports libraries, each under its own licence. The table lists those of their packages' metadata, here on Linux;
other contents of their wheels are noted where they are known to matter. The tests check that the installed package
imports nothing that is under the GPL or AGPL, directly or through what it imports.

`[dev]` brings evo (GPL-3.0) for the tests, which compare our trajectory errors with its, and PyAV (BSD-3-Clause), whose
wheel brings FFmpeg with x264 and x265 (GPL-2.0): with them tests encode clips of made patterns. Neither `dataflow` nor
`operators` imports one of the two: video is decoded by OpenCV's FFmpeg, which has no such encoders.

`[dev]` brings libfaketime (GPL-2.0), too, a library of C that nothing imports or links with: where a user has installed
it, the processes of re-runs by `dataflow verify --why` load it (`LD_PRELOAD`).

`[ray]`, `[remote]`, `[mcp]`, `[lidar]` and `[realsense]` are not in the table: Ray, pyrealsense2 and aiohttp are
under Apache-2.0, fsspec, s3fs and velodyne-decoder under BSD-3-Clause, mcp under MIT; what mcp brings is under MIT,
Apache-2.0, BSD and PSF-2.0, what velodyne-decoder brings under Apache-2.0, BSD and MIT, and libusb under LGPL-2.1,
loaded at run time.
"""


def canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def licence(found: Distribution) -> str:
    """The SPDX expression of a package, as far as its metadata tell; else their words."""
    meta = found.metadata
    if expression := meta.get("License-Expression"):
        return str(expression)
    named = [c.split(" :: ")[-1] for c in meta.get_all("Classifier") or () if c.startswith("License ::")]
    if named:
        joint = " OR " if canonical(found.name) in EITHER else " AND "
        return joint.join(BY_WORDS.get(word, word) for word in named)
    words = str(meta.get("License") or "unknown").strip().splitlines()[0]
    return BY_WORDS.get(words, words)


def closure(requirements: Iterable[str]) -> dict[str, Distribution | None]:
    """Every package that the requirements bring on this machine, by its canonical name; None: not installed."""
    found: dict[str, Distribution | None] = {}
    waiting = [(Requirement(text), frozenset[str]()) for text in requirements]
    seen: set[tuple[str, frozenset[str]]] = set()
    while waiting:
        requirement, extras = waiting.pop()
        if requirement.marker is not None and not any(
            requirement.marker.evaluate({"extra": extra}) for extra in (extras or {""})
        ):
            continue
        key = canonical(requirement.name), frozenset(requirement.extras)
        if key in seen:
            continue
        seen.add(key)
        try:
            package = found[key[0]] = distribution(requirement.name)
        except PackageNotFoundError:
            found[key[0]] = None
            continue
        waiting += [(Requirement(text), key[1]) for text in package.requires or ()]
    return found


def declared(extra: str = "") -> list[str]:
    """The requirements of pyproject.toml: the package's own, or an extra's, with those of the extras that it names."""
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    found: list[str] = []
    for text in project["optional-dependencies"][extra] if extra else project["dependencies"]:
        requirement = Requirement(text)
        own = canonical(requirement.name) == canonical(project["name"])
        found += [line for other in sorted(requirement.extras) for line in declared(other)] if own else [text]
    return found


def packages() -> dict[str, tuple[str, str]]:
    """Licence and part (the first of `PARTS` that brings it) of every package, by name. Raises for an absent one."""
    table: dict[str, tuple[str, str]] = {}
    absent = []
    for part in PARTS:
        for name, found in closure(declared(part)).items():
            if name.startswith(NOT_LISTED):
                continue
            if found is None:
                absent.append(name)
            else:
                table.setdefault(name, (licence(found), part))
    if absent:
        raise SystemExit(f"not installed here, so their licences are not known: {', '.join(sorted(set(absent)))}")
    return dict(sorted(table.items()))


def markdown(table: Mapping[str, tuple[str, str]]) -> str:
    """The page."""
    lines = ["| package | licence | with | |", "| --- | --- | --- | --- |"]
    for name, (words, part) in table.items():
        brought = f"`[{part}]`" if part else "the package"
        lines.append(f"| {name} | {words} | {brought} | {NOTES.get(name, '')} |".replace("|  |", "| |"))
    return PAGE + "\n" + "\n".join(lines) + "\n"


if __name__ == "__main__":
    found = packages()
    if forbidden := [f"{name} ({words})" for name, (words, _) in found.items() if COPYLEFT.search(words)]:
        raise SystemExit(f"under the GPL or AGPL: {', '.join(forbidden)}")
    sys.stdout.write(markdown(found))
