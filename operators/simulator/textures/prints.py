"""Textures that show something: labels, covers, posters, screens, the view from a window, a face."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from operators.simulator.textures.painting import SIZE, Pixels, Rng, bright, grey, lines, noise, rect, rgb
from operators.simulator.textures.stuffs import wood


def cardboard(rng: Rng) -> Pixels:
    canvas = rgb(grey(rng, 215, (6, 5), (100, 6))) + 4 * rgb(noise(rng, 4, 128))
    rect(canvas, 0, SIZE * 0.44, SIZE, SIZE * 0.12, (236, 222, 190))
    x, y = rng.uniform(12, 120, 2)
    rect(canvas, x, y * 0.5, 90, 46, (246, 246, 240))
    lines(rng, canvas, x + 6, y * 0.5 + 6, 78, 36, 8, (50, 50, 60))
    for k in range(14):
        rect(canvas, 150 + k * 5, 190, int(rng.integers(1, 4)), 40, (40, 40, 44))
    return canvas


def books(rng: Rng) -> Pixels:
    """Spines side by side."""
    canvas = np.full((SIZE, SIZE, 3), 40, np.float32)
    x = 0
    while x < SIZE:
        width = int(rng.integers(12, 34))
        top = int(rng.integers(4, 50))
        color = bright(rng) * rng.uniform(0.5, 1)
        rect(canvas, x, top, width - 2, SIZE, color)
        for _ in range(int(rng.integers(1, 4))):
            y = rng.uniform(top + 8, SIZE - 30)
            rect(canvas, x + 3, y, width - 8, rng.uniform(3, 22), np.clip(color + rng.uniform(-90, 130), 0, 255))
        x += width
    return canvas + 4 * rgb(noise(rng, 128))


def cover(rng: Rng) -> Pixels:
    """The front of a book or a package."""
    color = bright(rng)
    canvas = np.empty((SIZE, SIZE, 3), np.float32)
    canvas[:] = color
    band = 255 - color
    rect(canvas, 0, rng.uniform(20, 90), SIZE, rng.uniform(30, 70), band)
    cv2.circle(canvas, (int(rng.uniform(70, 190)), 185), int(rng.uniform(25, 50)), tuple(map(float, band * 0.8)), -1)
    lines(rng, canvas, 30, 28, 190, 60, 20, np.clip(color * 0.4, 0, 255))
    return canvas + 4 * rgb(noise(rng, 100))


def poster(rng: Rng) -> Pixels:
    """A picture in a frame."""
    sky, ground = bright(rng), bright(rng) * 0.7
    ramp = np.linspace(0, 1, SIZE, dtype=np.float32)[:, None, None]
    canvas = np.ascontiguousarray(np.broadcast_to(sky * (1 - ramp) + ground * ramp, (SIZE, SIZE, 3)), np.float32)
    style = int(rng.integers(3))
    for _ in range(int(rng.integers(6, 14))):
        color = tuple(map(float, bright(rng)))
        x, y = (int(v) for v in rng.uniform(10, SIZE - 10, 2))
        if style == 0:
            cv2.circle(canvas, (x, y), int(rng.uniform(8, 48)), color, -1)
        elif style == 1:
            points = rng.uniform(0, SIZE, (3, 2)).astype(np.int32)
            cv2.fillPoly(canvas, [points], color)
        else:
            w, h = rng.uniform(10, 90, 2)
            rect(canvas, x, y, w, h, color)
    if rng.uniform() < 0.5:
        rect(canvas, 24, 196, 208, 44, (244, 242, 236))
        lines(rng, canvas, 34, 202, 188, 34, 11, (30, 30, 36))
    rect(canvas, 0, 0, SIZE - 1, SIZE - 1, rng.choice([(30, 28, 26), (236, 234, 228), (110, 76, 46)]), 14)
    return canvas + 5 * rgb(noise(rng, 90))


def screen(rng: Rng) -> Pixels:
    """A computer's screen: windows with text and a chart."""
    canvas = np.empty((SIZE, SIZE, 3), np.float32)
    dark = rng.uniform() < 0.5
    canvas[:] = (34, 38, 52) if dark else (205, 216, 228)
    canvas += 10 * rgb(noise(rng, 4))
    for _ in range(3):
        x, y = rng.uniform(6, 110), rng.uniform(14, 110)
        w, h = rng.uniform(90, 135), rng.uniform(70, 125)
        paper = (24, 26, 34) if dark else (250, 250, 250)
        rect(canvas, x, y, w, h, paper)
        rect(canvas, x, y, w, 10, bright(rng))
        if rng.uniform() < 0.4:
            values = np.cumsum(rng.normal(0, 8, 18)) + y + h * 0.55
            line = np.stack([np.linspace(x + 6, x + w - 6, 18), np.clip(values, y + 16, y + h - 6)], axis=1)
            cv2.polylines(canvas, [line.astype(np.int32)], False, tuple(map(float, bright(rng))), 3)
        else:
            ink = bright(rng) if dark else np.array((40.0, 44, 60))
            lines(rng, canvas, x + 6, y + 16, w - 12, h - 22, 9, ink)
    rect(canvas, 0, 0, SIZE - 1, SIZE - 1, (16, 16, 18), 12)
    return canvas


def keys(rng: Rng) -> Pixels:
    canvas = np.full((SIZE, SIZE, 3), 60, np.float32)
    for i in range(5):
        for j in range(14):
            shade = 225 if rng.uniform() < 0.85 else 140
            rect(canvas, 8 + j * 17.3, 14 + i * 47, 13, 36, (shade, shade, shade + 4))
    return canvas


def window(rng: Rng) -> Pixels:
    """The view from a window, with its frame."""
    ramp = np.linspace(0, 1, SIZE, dtype=np.float32)[:, None, None]
    sky = np.array([150, 190, 235]) * (1 - ramp) + np.array([226, 236, 244]) * ramp
    canvas = np.ascontiguousarray(np.broadcast_to(sky, (SIZE, SIZE, 3)), np.float32) + 10 * rgb(noise(rng, 5))
    x = 0.0
    while x < SIZE:
        w, h = rng.uniform(24, 60), rng.uniform(50, 150)
        color = rng.uniform(110, 190) * np.array([1.0, 0.96, 0.9])
        rect(canvas, x, SIZE - h, w, h, color)
        for i in range(int(h // 16)):
            for j in range(int(w // 12)):
                rect(canvas, x + 4 + 12 * j, SIZE - h + 5 + 16 * i, 6, 8, color * rng.uniform(0.45, 1.25))
        x += w
    rect(canvas, 0, SIZE - 26, SIZE, 26, (96, 132, 84))
    frame = (238, 238, 236)
    rect(canvas, 0, 0, SIZE - 1, SIZE - 1, frame, 16)
    rect(canvas, SIZE / 2 - 5, 0, 10, SIZE, frame)
    return canvas


def whiteboard(rng: Rng) -> Pixels:
    canvas = np.full((SIZE, SIZE, 3), 246, np.float32)
    inks = [(30.0, 40.0, 150.0), (170.0, 30.0, 36.0), (20.0, 110.0, 60.0), (30.0, 30.0, 34.0)]
    for _ in range(7):
        ink = inks[int(rng.integers(4))]
        x, y = rng.uniform(16, 150), rng.uniform(16, 200)
        if rng.uniform() < 0.5:
            strokes = rng.normal(0, [3, 5], (22, 2)) + np.array([3, 0])
            steps = np.cumsum(strokes, axis=0) + np.array([x, y])
            cv2.polylines(canvas, [steps.astype(np.int32)], False, ink, 2)
        else:
            rect(canvas, x, y, rng.uniform(20, 70), rng.uniform(16, 40), ink, 2)
    lines(rng, canvas, 24, 20, 150, 60, 14, inks[3])
    rect(canvas, 0, 0, SIZE - 1, SIZE - 1, (170, 172, 176), 10)
    return canvas


def door(rng: Rng) -> Pixels:
    """A door leaf: two sunken panels and grain."""
    canvas = wood(rng).transpose(1, 0, 2).copy() * 1.05
    for y, h in ((22, 88), (134, 100)):
        rect(canvas, 44, y, 168, h, (120, 116, 110), 4)
        canvas[y + 4 : y + h - 4, 48:208] *= 0.9
        rect(canvas, 60, y + 14, 136, h - 28, (214, 208, 200), 2)
    return canvas


def leaf(rng: Rng) -> Pixels:
    canvas = rgb(grey(rng, 190, (12, 26), (60, 18)))
    rect(canvas, SIZE / 2 - 5, 0, 10, SIZE, (235, 240, 215))
    return canvas


def ball(rng: Rng) -> Pixels:
    """Segments in two shades, like a beach ball's."""
    canvas = np.full((SIZE, SIZE, 3), 238, np.float32)
    second = bright(rng)
    for k in range(0, 6, 2):
        rect(canvas, k * SIZE / 6, 0, SIZE / 6, SIZE, second)
    rect(canvas, 0, SIZE * 0.47, SIZE, SIZE * 0.06, (90, 90, 96))
    return canvas + 5 * rgb(noise(rng, 64))


def label(rng: Rng) -> Pixels:
    """A bottle's label or a mug's print, on a plain ground."""
    canvas = rgb(grey(rng, 236, (40, 5)))
    color = bright(rng)
    rect(canvas, 0, 96, SIZE, 96, color)
    for x in (0, SIZE // 2):
        cv2.circle(canvas, (x + 40, 144), 30, (250.0, 250.0, 244.0), -1)
        lines(rng, canvas, x + 78, 110, 44, 70, 16, np.clip(color * 0.35, 0, 255))
    return canvas


def robot(rng: Rng) -> Pixels:
    """A robot's shell: panels, a stripe, vents."""
    canvas = rgb(grey(rng, 235, (30, 4)))
    rect(canvas, 0, 150, SIZE, 30, bright(rng))
    for k in range(0, SIZE, 64):
        rect(canvas, k, 0, 2, SIZE, (130, 130, 136))
        for j in range(5):
            rect(canvas, k + 14, 30 + 12 * j, 34, 5, (60, 62, 70))
    return canvas


def face(rng: Rng) -> Pixels:
    """A head's skin: eyes and mouth on the half towards +x (the seam of the lathe), the rest plain."""
    canvas = rgb(grey(rng, 236, (20, 4), (80, 3)))
    for side in (1, -1):
        x = int((side * 0.07 % 1) * SIZE)
        cv2.ellipse(canvas, (x, 116), (7, 5), 0, 0, 360, (250.0, 250.0, 250.0), -1)
        cv2.circle(canvas, (x, 116), 4, (34.0, 28.0, 26.0), -1)
        rect(canvas, x - 8, 102, 16, 3, (70, 50, 44))
        rect(canvas, x - 4 if side < 0 else 0, 166, 12, 5, (170, 74, 74))
    return canvas


PAINTERS: dict[str, Callable[[Rng], Pixels]] = {
    painter.__name__: painter
    for painter in (
        cardboard,
        books,
        cover,
        poster,
        screen,
        keys,
        window,
        whiteboard,
        door,
        leaf,
        ball,
        label,
        robot,
        face,
    )
}
