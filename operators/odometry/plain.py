"""Dataclasses as plain values that an operator's snapshot may hold."""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


def fields_of(value: DataclassInstance) -> dict[str, Any]:
    """Returns the fields by name, whose values stay what they are."""
    return {field.name: getattr(value, field.name) for field in fields(value)}
