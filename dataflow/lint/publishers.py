"""Checks that one device publishes on a topic: two that do are distinguished by what each keeps."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from itertools import islice, pairwise

import dataflow.messages as messages
from dataflow.lint.inputs import Finding, LintInput

_TYPES = {cls.SCHEMA for cls in (
    messages.CameraInfo, messages.CompressedDepth, messages.CompressedImage, messages.CompressedVideo,
    messages.DepthImage, messages.Image, messages.Image16, messages.Imu, messages.LaserScan, messages.MagneticField,
    messages.NavSatFix, messages.Odometry, messages.PointCloud,
)}  # fmt: skip
LOOKED_AT = 100
"""Messages of a stream that are looked at, from the first one."""
TURNS = 4
"""Changes to another device and back that are no change of a setting."""


def check_publishers(data: LintInput) -> Iterator[Finding]:
    """Looks at the first messages of every stream of a sensor."""
    for name, facts in data.streams.items():
        if not (facts.readable and facts.count > TURNS and facts.type in _TYPES):
            continue
        devices = [_device(message) for message in islice(data.messages(name), LOOKED_AT)]
        if len(set(devices)) < 2 or sum(a != b for a, b in pairwise(devices)) < TURNS:
            continue
        who = ", ".join(f"{device} ({number})" for device, number in sorted(Counter(devices).items()))
        text = f"{len(set(devices))} devices publish on it by turns: {who}; each wants a topic"
        yield Finding("publishers", name, "warning", text)


def _device(message: messages.Message) -> str:
    """What a device keeps from message to message, in words."""
    match message:
        case messages.CameraInfo():
            size = f"{message.width}x{message.height}"
            return f"frame {message.frame!r} of {size} with fx {message.fx:.6g}, cx {message.cx:.6g}"
        case messages.Image() | messages.Image16() | messages.DepthImage():
            return f"frame {message.frame!r} of {message.data.shape[1]}x{message.data.shape[0]}"
        case messages.Odometry():
            return f"frame {message.child_frame!r} in {message.frame!r}"
        case _:
            return f"frame {getattr(message, 'frame', '')!r}"
