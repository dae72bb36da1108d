"""Detections drawn into the image that they were found in."""

from __future__ import annotations

import colorsys
import zlib

import cv2
import numpy as np

from dataflow.messages import Detections2D, Image

Color = tuple[int, int, int]


def draw_detections(image: Image, detections: Detections2D) -> Image:
    """Returns a colour image with boxes, labels and scores, and masks and ids where there are any; the given one stays
    as it is.

    A class has the same colour in every image. Raises ValueError where the boxes are of an image of another size.
    """
    height, width = image.data.shape[:2]
    if (detections.width, detections.height) != (width, height):
        raise ValueError(
            f"detections in an image of {detections.width}x{detections.height} pixels cannot be drawn into one of "
            f"{width}x{height}"
        )
    grey = not image.is_color
    pixels = np.array(np.repeat(image.data[..., None], 3, axis=2) if grey else image.data, np.uint8)
    scale = max(0.35, height / 1200)
    line = max(1, round(height / 300))
    labels = detections.labels()
    order = np.argsort(detections.scores, kind="stable").tolist()  # the surest on top
    for k in order if detections.masks is not None else ():
        mask = detections.mask(k)
        pixels[mask] = (pixels[mask] + np.array(color_of(labels[k]), np.float32)) / 2
    for k in order:
        left, upper, right, lower = np.rint(detections.boxes[k]).astype(int).tolist()
        color = color_of(labels[k])
        cv2.rectangle(pixels, (left, upper), (right, lower), color, line)
        number = "" if detections.ids is None else f" #{int(detections.ids[k])}"
        text = f"{labels[k]}{number} {float(detections.scores[k]):.2f}"
        (wide, high), below = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)
        x = max(0, min(left, width - wide))
        y = upper - below if upper - below - high >= 0 else min(upper + high + below, height - 1)
        cv2.rectangle(pixels, (x, y - high - below // 2), (x + wide, y + below), color, cv2.FILLED)
        cv2.putText(pixels, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, scale, (0, 0, 0), 1, cv2.LINE_AA)
    return Image(stamp=image.stamp, frame=image.frame, data=pixels)


def color_of(label: str) -> Color:
    """Returns the colour of a class: light, so that black text on it can be read."""
    hue = zlib.crc32(label.encode()) / 2**32
    red, green, blue = colorsys.hsv_to_rgb(hue, 0.65, 1.0)
    return round(255 * red), round(255 * green), round(255 * blue)
