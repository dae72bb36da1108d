"""Loads Open3D, also on a machine without libusb, which its wheel links to although ray casting never uses it."""

from __future__ import annotations

import ctypes
import importlib
from types import ModuleType


def open3d() -> ModuleType:
    """The `open3d` module. Raises ImportError with what to install."""
    try:
        ctypes.CDLL("libusb-1.0.so.0", mode=ctypes.RTLD_GLOBAL)
    except OSError:
        _load_bundled_libusb()
    try:
        return importlib.import_module("open3d")
    except ImportError as error:
        hint = "it comes with: pip install 'robot-dataflow[sim]', but not for aarch64 with Python 3.12 or newer"
        raise ImportError(f"the simulator casts rays with Open3D, which cannot be imported: {error}; {hint}") from error


def _load_bundled_libusb() -> None:
    """Makes the libusb of the `libusb_package` wheel known to the linker under the name that Open3D asks for."""
    try:
        package = importlib.import_module("libusb_package")
    except ImportError:
        return  # Open3D may still do without; if not, its own error is raised by the caller
    path = package.get_library_path()
    if path is not None:
        ctypes.CDLL(str(path), mode=ctypes.RTLD_GLOBAL)
