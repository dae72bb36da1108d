"""Environments and wheels with a package `tiny`, made without a network."""

from __future__ import annotations

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path


def packages(environment: Path) -> Path:
    """Returns where the packages of an environment lie."""
    return environment / "lib" / f"python{sys.version_info[0]}.{sys.version_info[1]}" / "site-packages"


def install(environment: Path, version: str, gain: float) -> None:
    """Puts one version of `tiny` in place of any other."""
    folder = packages(environment)
    for old in folder.glob("tiny-*"):
        shutil.rmtree(old)
    shutil.rmtree(folder / "__pycache__", ignore_errors=True)  # it may be of a text of the same size and second
    (folder / "tiny.py").write_text(f"GAIN = {gain}\n")
    about = folder / f"tiny-{version}.dist-info"
    about.mkdir(exist_ok=True)
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: tiny\nVersion: {version}\n")
    (about / "RECORD").write_text("tiny.py,,\n")


def environment(folder: Path, version: str, gain: float) -> Path:
    """Makes an environment that has this installation's Python and `tiny`."""
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(folder)], check=True, timeout=60)
    install(folder, version, gain)
    return folder


def wheel(folder: Path, version: str, gain: float) -> None:
    """Writes `tiny` as a wheel."""
    folder.mkdir(exist_ok=True)
    about = f"tiny-{version}.dist-info"
    with zipfile.ZipFile(folder / f"tiny-{version}-py3-none-any.whl", "w") as file:
        file.writestr("tiny.py", f"GAIN = {gain}\n")
        file.writestr(f"{about}/METADATA", f"Metadata-Version: 2.1\nName: tiny\nVersion: {version}\n")
        file.writestr(
            f"{about}/WHEEL", "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
        )
        file.writestr(f"{about}/RECORD", "")
