"""Networks by name: a registry of models as data, and the cache that holds their files."""

from typing import TYPE_CHECKING

from dataflow.lazy import lazily

if TYPE_CHECKING:
    from operators.models.registry import Model, Registry
else:
    __getattr__, __dir__ = lazily(__name__, {"registry": ("Model", "Registry")})

__all__ = ["Model", "Registry"]
