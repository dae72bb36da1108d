"""Shapes that no network was trained on: those that judge how objects are learned, and those that choose parameters."""

from __future__ import annotations

from collections.abc import Callable

from operators.simulator.shapes import Material, Shape, at, box, ellipsoid, lathe


def cone() -> Shape:
    """A traffic cone, 45 cm high: orange with a white band."""
    orange, white = Material("plain", (0.9, 0.35, 0.08), tile=0.3), Material("plain", (0.92, 0.92, 0.9), tile=0.3)
    low = at(lathe([(0.12, 0.0), (0.085, 0.14)], orange), z=0.03)
    band = at(lathe([(0.085, 0.0), (0.055, 0.12)], white), z=0.17)
    tip = at(lathe([(0.055, 0.0), (0.015, 0.16), (0.0, 0.161)], orange), z=0.29)
    return box((0.3, 0.3, 0.03), orange, center=(0, 0, 0.015)) + low + band + tip


def suitcase() -> Shape:
    """A blue suitcase that stands on its long side, with straps and a handle."""
    blue, black = Material("fabric", (0.16, 0.28, 0.6), tile=0.2), Material("plain", (0.1, 0.1, 0.11), tile=0.2)
    shape = box((0.2, 0.55, 0.38), blue, center=(0, 0, 0.21))
    for y in (-0.15, 0.15):
        shape += box((0.21, 0.04, 0.39), black, center=(0, y, 0.21))
        shape += box((0.03, 0.02, 0.06), black, center=(0, y / 2, 0.42))
    return shape + box((0.03, 0.17, 0.03), black, center=(0, 0, 0.45))


def teapot() -> Shape:
    """A green teapot, 30 cm wide, with spout, handle and a golden lid."""
    green, gold = Material("plain", (0.16, 0.47, 0.28), tile=0.2), Material("plain", (0.75, 0.6, 0.24), tile=0.2)
    shape = at(ellipsoid(0.1, 0.1, 0.085, green), z=0.085)
    shape += at(lathe([(0.06, 0.0), (0.02, 0.03), (0.0, 0.031)], gold), z=0.16)
    shape += at(ellipsoid(0.018, 0.018, 0.018, gold), z=0.2) + at(ellipsoid(0.07, 0.022, 0.022, green), x=0.13, z=0.12)
    return (
        shape
        + box((0.02, 0.02, 0.1), gold, center=(-0.14, 0, 0.1))
        + box((0.06, 0.02, 0.02), gold, center=(-0.11, 0, 0.15))
    )


def helmet() -> Shape:
    """A yellow safety helmet with a brim and a black stripe."""
    yellow, black = Material("plain", (0.94, 0.8, 0.12), tile=0.3), Material("plain", (0.08, 0.08, 0.08), tile=0.3)
    brim = at(lathe([(0.16, 0.0), (0.16, 0.015), (0.11, 0.03)], yellow), x=0.03)
    return (
        brim + at(ellipsoid(0.135, 0.115, 0.13, yellow), z=0.03) + box((0.22, 0.025, 0.02), black, center=(0, 0, 0.155))
    )


def bucket() -> Shape:
    """A red bucket, 30 cm high, with a white rim and a handle."""
    red, white = Material("plain", (0.75, 0.1, 0.12), tile=0.3), Material("plain", (0.9, 0.9, 0.9), tile=0.3)
    shape = at(lathe([(0.1, 0.0), (0.14, 0.28)], red), z=0.005)
    shape += at(lathe([(0.14, 0.0), (0.15, 0.015), (0.14, 0.03)], white), z=0.27)
    return (
        shape
        + box((0.02, 0.24, 0.015), white, center=(0, 0, 0.36))
        + box((0.02, 0.015, 0.08), white, center=(0, 0.12, 0.32))
    )


def vase() -> Shape:
    """A blue and white vase with a narrow neck, 34 cm high."""
    blue, white = Material("plain", (0.12, 0.2, 0.6), tile=0.2), Material("plain", (0.93, 0.93, 0.95), tile=0.2)
    foot = lathe([(0.05, 0.0), (0.1, 0.1)], white)
    belly = at(lathe([(0.1, 0.0), (0.09, 0.06), (0.04, 0.12)], blue), z=0.1)
    return foot + belly + at(lathe([(0.04, 0.0), (0.035, 0.08), (0.06, 0.12)], white), z=0.22)


def drum() -> Shape:
    """A toy drum, 26 cm wide: blue with golden hoops and a white skin."""
    blue, gold = Material("plain", (0.15, 0.35, 0.7), tile=0.3), Material("plain", (0.8, 0.65, 0.2), tile=0.3)
    skin = Material("plain", (0.95, 0.93, 0.88), tile=0.3)
    hoop = lathe([(0.135, 0.0), (0.135, 0.025)], gold)
    top = at(lathe([(0.13, 0.0), (0.0, 0.002)], skin), z=0.2)
    return hoop + at(lathe([(0.125, 0.0), (0.125, 0.16)], blue), z=0.02) + at(hoop, z=0.175) + top


def extinguisher() -> Shape:
    """A red fire extinguisher, 48 cm high, with a white label, a black valve and a hose."""
    red, black = Material("plain", (0.78, 0.08, 0.08), tile=0.3), Material("plain", (0.07, 0.07, 0.08), tile=0.3)
    white = Material("plain", (0.9, 0.9, 0.86), tile=0.3)
    body = lathe([(0.075, 0.0), (0.08, 0.02), (0.08, 0.34), (0.03, 0.4), (0.0, 0.401)], red)
    shape = body + at(lathe([(0.0815, 0.0), (0.0815, 0.1)], white), z=0.15)
    shape += box((0.03, 0.12, 0.03), black, center=(0, 0.02, 0.46)) + box(
        (0.03, 0.03, 0.06), black, center=(0, 0, 0.42)
    )
    return shape + box((0.022, 0.022, 0.3), black, center=(0, 0.1, 0.31))


def crate() -> Shape:
    """A green crate of slats, 50 cm long."""
    green, dark = Material("plain", (0.2, 0.55, 0.25), tile=0.3), Material("plain", (0.08, 0.2, 0.1), tile=0.3)
    shape = box((0.34, 0.48, 0.26), dark, center=(0, 0, 0.14))
    for z in (0.04, 0.13, 0.22):
        shape += box((0.36, 0.5, 0.06), green, center=(0, 0, z))
    return shape


def toaster() -> Shape:
    """A silver toaster, 28 cm long, with black slots, feet and a lever."""
    silver, black = Material("plain", (0.72, 0.73, 0.76), tile=0.2), Material("plain", (0.08, 0.08, 0.08), tile=0.2)
    shape = box((0.16, 0.28, 0.17), silver, center=(0, 0, 0.105)) + box((0.17, 0.29, 0.02), black, center=(0, 0, 0.01))
    for x in (-0.035, 0.035):
        shape += box((0.025, 0.2, 0.012), black, center=(x, 0, 0.192))
    return shape + box((0.04, 0.03, 0.02), black, center=(0, 0.15, 0.13))


def globe() -> Shape:
    """A blue globe with brown continents on a wooden foot, 34 cm high."""
    blue, brown = Material("plain", (0.18, 0.42, 0.75), tile=0.2), Material("plain", (0.5, 0.33, 0.16), tile=0.2)
    shape = lathe([(0.08, 0.0), (0.07, 0.02), (0.015, 0.03), (0.015, 0.08)], brown)
    shape += at(ellipsoid(0.12, 0.12, 0.12, blue), z=0.2) + at(
        ellipsoid(0.07, 0.05, 0.06, brown), x=0.06, y=0.02, z=0.22
    )
    return shape + at(ellipsoid(0.05, 0.07, 0.05, brown), x=-0.04, y=-0.06, z=0.17)


def duck() -> Shape:
    """A yellow toy duck with an orange bill, 24 cm long."""
    yellow, orange = Material("plain", (0.95, 0.82, 0.2), tile=0.2), Material("plain", (0.92, 0.45, 0.1), tile=0.2)
    shape = at(ellipsoid(0.12, 0.085, 0.07, yellow), z=0.07) + at(ellipsoid(0.06, 0.055, 0.055, yellow), x=0.07, z=0.17)
    return shape + box((0.05, 0.04, 0.02), orange, center=(0.14, 0, 0.165))


JUDGED: dict[str, Callable[[], Shape]] = {
    "cone": cone,
    "teapot": teapot,
    "helmet": helmet,
    "suitcase": suitcase,
    "bucket": bucket,
    "vase": vase,
    "drum": drum,
}
CHOOSING: dict[str, Callable[[], Shape]] = {
    "extinguisher": extinguisher,
    "crate": crate,
    "toaster": toaster,
    "globe": globe,
    "duck": duck,
}
ON_FLOOR = ("cone", "suitcase", "bucket", "drum", "extinguisher", "crate")
