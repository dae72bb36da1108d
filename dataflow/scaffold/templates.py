"""Holds the files as texts: `$name` and the like are filled in by `dataflow.scaffold.files`."""

from __future__ import annotations

from string import Template

OPERATOR = Template('''\
"""$Title: an operator."""

from __future__ import annotations

from dataclasses import dataclass

from dataflow.messages import Image, Number
from dataflow.operator import In, Operator, Out, Param


@dataclass
class State:
    """What the next result depends on: kept in recordings, so that a part of one is replayed and verified."""

    darkest: float = 1.0


class $Class(Operator):
    """Measures how bright an image is."""

    image: In[Image] = In(doc="what the camera sees")
    brightness: Out[Number] = Out(doc="mean of all pixels, 0 to 1")

    scale: float = Param(1.0, gt=0, tunable=True, doc="factor on the result")
    state: State

    def process(self, image: Image) -> Number:
        """Returns the brightness of an image; None gives no message. The result gets the image's timestamp."""
        value = self.scale * float(image.data.mean()) / 255
        if value < self.state.darkest:
            self.state.darkest = value
            self.log.info("darkest so far: %.3f", value)
        return Number(value=value)

    def summary(self) -> dict[str, float]:
        """Returns the figures that `dataflow run` prints at the end."""
        return {"darkest": self.state.darkest}
''')

OPERATOR_TEST = Template('''\
"""Tests of $Title."""

import numpy as np
import pytest

from dataflow.messages import Image
from dataflow.testing import play
from $module import $Class


def image(stamp: int, value: int) -> Image:
    return Image(stamp=stamp, frame="camera", data=np.full((4, 6), value, np.uint8))


def test_a_white_image_is_as_bright_as_can_be() -> None:
    played = play($Class(), {"image": [image(1, 255), image(2, 0)]})
    assert [number.value for number in played["brightness"]] == [1.0, 0.0]
    assert [number.stamp for number in played["brightness"]] == [1, 2]


def test_the_scale_is_a_factor_and_above_zero() -> None:
    (number,) = play($Class(scale=0.5), {"image": [image(1, 255)]})["brightness"]
    assert number.value == pytest.approx(0.5)
    with pytest.raises(ValueError, match="scale"):
        $Class(scale=0)


def test_restore_continues_from_a_snapshot() -> None:
    first, second = $Class(), $Class()
    play(first, {"image": [image(1, 51)]})
    second.restore(first.snapshot())
    assert second.summary() == {"darkest": pytest.approx(0.2)}
''')

TIMER = Template('''\
"""$Title: an operator that works by the clock of its messages."""

from __future__ import annotations

from dataflow.messages import Image, Number
from dataflow.operator import Batch, Operator, Out


class $Class(Operator, every="500ms"):
    """Counts the images of each half second. Ticks follow the timestamps, so a replay gives the same counts."""

    stateless = True  # what it gives depends on the inputs of the call alone

    image: Batch[Image] = Batch(doc="all images since the last tick")
    rate: Out[Number] = Out(doc="images a second")

    def process(self, image: tuple[Image, ...]) -> Number:
        """Returns the rate at a tick, also when no image came. The result gets the tick's timestamp."""
        return Number(value=len(image) / 0.5, unit="Hz")
''')

TIMER_TEST = Template('''\
"""$Title counts by timestamps."""

import numpy as np

from dataflow.messages import Image
from dataflow.testing import play
from $module import $Class

SECOND = 1_000_000_000


def test_images_are_counted_tick_by_tick() -> None:
    images = [Image(stamp=k * SECOND // 10, frame="c", data=np.zeros((2, 2), np.uint8)) for k in range(1, 16)]
    played = play($Class(), {"image": images})
    assert [number.stamp / SECOND for number in played["rate"]] == [0.5, 1.0, 1.5]
    assert [number.value for number in played["rate"]] == [10.0, 10.0, 10.0]
''')

SOURCE = Template('''\
"""$Title: a source, which reads a device."""

from __future__ import annotations

import time
from collections.abc import Iterator

from dataflow.messages import Number
from dataflow.operator import Out, Param, Source


class Device:
    """Stands in for the driver of a device: replace it by yours."""

    def read(self) -> float:
        """Waits for the next reading."""
        time.sleep(0.1)
        return 21.5

    def close(self) -> None:
        """Releases the device."""


class $Class(Source):
    """Reads a thermometer."""

    real_time = True  # it waits for no consumer: `dataflow run --live` reads it on a separate thread

    temperature: Out[Number] = Out(doc="degrees Celsius")

    count: int = Param(0, ge=0, doc="readings after which it ends; 0: never")

    def setup(self) -> None:
        """Opens the device. An error here is reported with this operator's name."""
        self.device = Device()

    def stream(self) -> Iterator[dict[str, Number]]:
        """Yields what was read at one moment. Timestamps strictly increase; take the device's own where it has them."""
        done = 0
        while not self.count or done < self.count:
            value = self.device.read()
            yield {"temperature": Number(stamp=time.time_ns(), value=value, unit="°C")}
            done += 1

    def close(self) -> None:
        """Releases the device at the end, also after an error."""
        self.device.close()
''')

SOURCE_TEST = Template('''\
"""$Title hands on what its device reads."""

import $module
from dataflow.testing import play
from $module import $Class


class FakeDevice:
    def __init__(self) -> None:
        self.left = [20.0, 20.5]
        self.closed = False

    def read(self) -> float:
        return self.left.pop(0)

    def close(self) -> None:
        self.closed = True


def test_every_reading_is_a_message(monkeypatch) -> None:
    device = FakeDevice()
    monkeypatch.setattr($module, "Device", lambda: device)
    played = play($Class(count=2))
    assert [number.value for number in played["temperature"]] == [20.0, 20.5]
    stamps = [number.stamp for number in played["temperature"]]
    assert stamps[0] < stamps[1]
    assert device.closed
''')

PROGRAM = Template('''\
"""$Title: an operator whose calls are made by a program in C++."""

from __future__ import annotations

from dataflow.messages import Image, Number
from dataflow.operator import In, Out, Param
from dataflow.program import Program


class $Class(Program):
    """Measures how bright an image is."""

    command = ("./$stem",)
    stateless = True

    image: In[Image] = In(doc="what the camera sees")
    brightness: Out[Number] = Out(doc="mean of all pixels, 0 to 1")

    scale: float = Param(1.0, gt=0, tunable=True, doc="factor on the result")
''')

PROGRAM_SOURCE = Template("""\
// The calls of $Title. Build it: c++ -std=c++17 -O2 -o $stem $stem.cpp
#include "dataflow.hpp"

class $Class : public dataflow::Operator {
  public:
    std::vector<dataflow::Message> setup(const dataflow::Parameters &parameters) override {
        parameter("scale", parameters.at("scale"));
        return {};
    }

    void parameter(const std::string &, const std::string &value) override { scale_ = std::stod(value); }

    std::vector<dataflow::Message> process(std::int64_t stamp, const std::vector<dataflow::Message> &inputs) override {
        const auto &pixels = inputs.at(0).arrays.at(0)->bytes;
        double sum = 0;
        for (auto pixel : pixels) sum += pixel;
        const double value = scale_ * sum / static_cast<double>(pixels.size()) / 255;
        return {{"brightness", "Number", stamp, {value, std::string()}, {}}};
    }

  private:
    double scale_ = 1;
};

int main() {
    $Class program;
    return dataflow::run(program);
}
""")

PROGRAM_TEST = Template('''\
"""Tests of $Title."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

import $module
from dataflow.messages import Image
from dataflow.testing import play
from $module import $Class

FOLDER = Path($module.__file__).parent


def test_the_mean_of_all_pixels() -> None:
    compiler = shutil.which("c++")
    if compiler is None:
        pytest.skip("no C++ compiler is installed here")
    command = [compiler, "-std=c++17", "-O2", "-o", "$stem", "$stem.cpp"]
    subprocess.run(command, cwd=FOLDER, check=True, timeout=300)
    images = [Image(stamp=stamp, frame="camera", data=np.full((4, 6), 51 * stamp, np.uint8)) for stamp in range(6)]
    played = play($Class(scale=0.5), {"image": images})
    assert [number.value for number in played["brightness"]] == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4, 0.5])
''')

GRAPH = Template("""\
# $Title: $about
#
#   dataflow check $file
#   dataflow run $file --view spawn
#   dataflow run $file --record out/run.mcap
graph: $name
namespace: robot1

params:
  frames: 60

operators:
  camera:  # a synthetic one; dataflow operators lists what there is
    use: operators.sources:SyntheticRgbd
    params: {frames: "$${frames}", rate: 30, width: 160, height: 120}
$more
""")

GRAPH_OPERATOR = Template("""\

  $node:
    use: $module:$Class
    inputs: {image: camera/image}
""")

GRAPH_CLOUD = """\

  cloud:
    use: operators.cloud:CloudBuilder
    inputs:
      depth: camera/depth
      image: camera/image
      depth_info: camera/depth_info
      image_info: camera/image_info
    params: {stride: 4}
"""

PROJECT = Template("""\
[build-system]
requires = ["setuptools>=77"]
build-backend = "setuptools.build_meta"

[project]
name = "$distribution"
version = "0.1.0"
description = "Operators and graphs of $name"
requires-python = ">=3.11"
dependencies = ["robot-dataflow[all]"]

[project.optional-dependencies]
dev = ["pytest>=8"]

# so that `dataflow operators` lists yours
[project.entry-points."dataflow.operators"]
$package = "$package"

[tool.setuptools.packages.find]
include = ["$package*"]

[tool.pytest.ini_options]
testpaths = ["tests"]
pythonpath = ["."]
""")

PACKAGE = Template('''\
"""Operators of $name."""

from $package.brightness import Brightness

__all__ = ["Brightness"]
''')

GRAPH_TEST = Template('''\
"""The graphs are sound, and run the same twice."""

from pathlib import Path

import pytest

import dataflow
from dataflow.graph import load_graph

GRAPHS = Path(__file__).parent.parent / "graphs"


@pytest.mark.parametrize("file", sorted(GRAPHS.glob("*.yaml")), ids=lambda file: file.stem)
def test_a_graph_is_sound(file: Path) -> None:
    load_graph(file)  # raises with line and column


def test_a_recorded_run_is_repeated_bit_for_bit(tmp_path: Path) -> None:
    recording = tmp_path / "run.mcap"
    dataflow.run(GRAPHS / "$package.yaml", record=recording, settings={"frames": 10})
    assert len(dataflow.open(recording)["brightness/brightness"]) == 10
    assert dataflow.verify(recording).identical
''')

README = Template("""\
# $name

    python3 -m venv .venv && . .venv/bin/activate
    pip install -e "PATH/TO/robot-dataflow[all]"  # where it was cloned to
    pip install -e ".[dev]"
    pytest
    dataflow run graphs/$package.yaml --record out/run.mcap --view out/run.rrd
    dataflow verify out/run.mcap

| | |
| --- | --- |
| `$package/` | operators: `dataflow new operator NAME --to $package` begins another |
| `graphs/` | which operators run, and how they are wired: `dataflow new graph NAME --to graphs` |
| `tests/` | tests of both |
""")

GITIGNORE = """\
.venv/
__pycache__/
*.egg-info/
/out/
"""

SERVICE = Template("""\
# $name, started with the machine. To install it:
#   $install
#   sudo systemctl daemon-reload && sudo systemctl enable --now $name
[Unit]
Description=dataflow $what
After=network.target
StartLimitIntervalSec=0

[Service]
User=$user
WorkingDirectory=$folder
RuntimeDirectory=$name
RuntimeDirectoryMode=0700
Environment=XDG_RUNTIME_DIR=%t/$name
ExecStart=$command
# SIGTERM to the supervisor alone: it ends the others in order, and has up to 60 s to close its files
KillMode=mixed
TimeoutStopSec=75
# a new run after a failure that the graph's restart policies do not cover
Restart=on-failure
RestartSec=2
LimitNOFILE=8192

[Install]
WantedBy=multi-user.target
""")

SERVICE_FILES = Template("""\
# systemd-tmpfiles: deletes recordings of $name older than $days days, and makes no folder; a run bounds its files
e $out - - - ${days}d
""")
