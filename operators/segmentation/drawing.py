"""Classes of pixels painted over the image that they were found in."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from dataflow.messages import Image, SegmentationMap
from operators.detection.drawing import Color, color_of
from operators.network_input import three_channels


def draw_segmentation(
    image: Image, segmentation: SegmentationMap, palette: Mapping[str, Color] | None = None, opacity: float = 0.5
) -> Image:
    """Returns a colour image with every pixel in the colour of its class, so far opaque; void ones stay as they are.

    `palette` gives (R, G, B) from 0 to 255 by class name; a class that it lacks has the colour of its name, the same as
    that of `draw_detections`. Raises ValueError where the map is of an image of another size.
    """
    if segmentation.classes.shape != image.data.shape[:2]:
        height, width = segmentation.classes.shape
        raise ValueError(
            f"a map of {width}x{height} pixels cannot be painted over an image of {image.width}x{image.height}"
        )
    pixels = three_channels(image.data).astype(np.float32)
    for k in np.unique(segmentation.classes).tolist():
        if k == segmentation.void:
            continue
        name = segmentation.class_names[k] if segmentation.class_names else str(k)
        color = (palette or {}).get(name) or color_of(name)
        own = segmentation.classes == k
        pixels[own] += np.float32(opacity) * (np.array(color, np.float32) - pixels[own])
    return Image(stamp=image.stamp, frame=image.frame, data=np.rint(pixels).astype(np.uint8))
