"""Times calls of an operator whose program is in C++, beside the same in Python: python benchmarks/programs.py"""

from __future__ import annotations

import importlib
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from dataflow.messages import Image, Number
from dataflow.operator import Context, In, Operator, Out
from dataflow.program import Program
from dataflow.scaffold.files import operator_files

CALLS = 300


class InPython(Operator):
    """The same as the program's."""

    image: In[Image] = In(doc="what the camera sees")
    brightness: Out[Number] = Out(doc="mean of all pixels, 0 to 1")

    def process(self, image: Image) -> Number:
        """Measures how bright an image is."""
        return Number(stamp=image.stamp, value=float(image.data.mean()) / 255)


def median_ms(operator: Operator, image: Image) -> float:
    """The median time of a call."""
    operator.setup()
    took = []
    for _ in range(CALLS):
        begun = time.perf_counter()
        operator.process(context=Context(1), image=image) if isinstance(operator, Program) else operator.process(image)
        took.append(time.perf_counter() - begun)
    operator.close()
    return float(np.median(took)) * 1000


def main() -> None:
    """Prints a row for each size of image."""
    with tempfile.TemporaryDirectory() as folder:
        for file, text in operator_files("brightness", "program").items():
            Path(folder, file).write_text(text, encoding="utf-8")
        subprocess.run(["c++", "-std=c++17", "-O2", "-o", "brightness", "brightness.cpp"], cwd=folder, check=True)
        sys.path.insert(0, folder)
        in_cpp = importlib.import_module("brightness").Brightness
        print(f"median of {CALLS} calls, ms\n{'image':>12} {'Python':>8} {'C++':>8}")
        for height, width in ((4, 6), (480, 640), (1080, 1920)):
            image = Image(stamp=1, frame="camera", data=np.full((height, width, 3), 7, np.uint8))
            print(f"{width:>7}x{height:<4} {median_ms(InPython(), image):8.2f} {median_ms(in_cpp(), image):8.2f}")


if __name__ == "__main__":
    main()
