"""Localisation in a known map."""

from operators.localization.localizer import ParticleFilterLocalizer

__all__ = ["ParticleFilterLocalizer"]
