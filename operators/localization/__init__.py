"""Localisation in a known map."""

from typing import TYPE_CHECKING

from dataflow.lazy import lazily

if TYPE_CHECKING:
    from operators.localization.localizer import ParticleFilterLocalizer
else:
    __getattr__, __dir__ = lazily(__name__, {"localizer": ("ParticleFilterLocalizer",)})

__all__ = ["ParticleFilterLocalizer"]
