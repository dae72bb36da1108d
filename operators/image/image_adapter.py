"""Images that follow the light and the noise, as an operator."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dataflow.messages import Diagnostics, Image
from dataflow.messages.diagnostics import Level
from dataflow.operator import Counts, In, Operator, Out, Param
from operators.image.adaptation import Adaptation, measure
from operators.status import counted_status


class ImageAdapter(Operator):
    """Brings dark and noisy images nearer to those that networks were trained on, by what it measures in each.

    Put it in front of a detector or a segmenter: what it does there under switched lamps, noise and blur is a table in
    benchmarks/adaptation.md. Images that are neither dark nor noisy pass bit for bit. The result of an image depends on
    that image alone, so it is the same wherever a replay begins.

    Methods: Immerkær, "Fast noise variance estimation", 1996; Lee, "Digital image enhancement and noise filtering by
    use of local statistics", 1980.
    """

    image: In[Image] = In(doc="RGB or grey")
    adapted: Out[Image] = Out(doc="the same view, brighter and with less noise where it needs that")
    status: Out[Diagnostics] = Out(doc="with every image: its noise and brightness, and what was done; counts")

    adapt: bool = Param(True, live=True, doc="off passes every image as it is")
    usual_noise: float = Param(3.0, ge=0, le=50, live=True, doc="grey levels of noise that are left as they are")
    brightness: float = Param(80.0, ge=1, le=200, live=True, doc="mean grey level to which darker images are raised")
    most_gain: float = Param(5.0, ge=1, le=20, live=True, doc="the exposure is lengthened so many times at most")
    most_noise: float = Param(8.0, gt=0, le=50, live=True, doc="nor so far that noise exceeds so many grey levels")
    state: Counts

    def process(self, image: Image) -> Mapping[str, Any]:
        self.state.counts["images"] += 1
        if not self.adapt or min(image.width, image.height) < 3:
            return {"adapted": image, "status": self._status(image.stamp, "passed as it is")}
        adaptation = Adaptation(self.usual_noise, self.brightness, self.most_gain, self.most_noise)
        measured = measure(image.data)
        gain, excess = adaptation.gain(measured), adaptation.excess(measured)
        self.state.counts.update({"made brighter": int(gain > 1), "noise removed": int(excess > 0)})
        text = f"noise {measured.noise:.1f}, of which {excess:.1f} removed; brightness {measured.brightness:.0f}"
        text += f", exposed {gain:.1f} times as long" if gain > 1 else ""
        pixels = adaptation.apply(image.data, measured)
        adapted = image if pixels is image.data else image.replace(data=pixels)
        return {"adapted": adapted, "status": self._status(image.stamp, text)}

    def _status(self, stamp: int, text: str) -> Diagnostics:
        return counted_status("image_adapter", stamp, text, Level.OK, self.state.counts)
