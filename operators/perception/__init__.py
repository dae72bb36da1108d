"""The whole of perception as one object."""

from typing import TYPE_CHECKING

from dataflow.lazy import lazily

if TYPE_CHECKING:
    from operators.perception.result import PerceptionResult
    from operators.perception.sensors import HandedSensors
    from operators.perception.system import PerceptionSystem
else:
    __getattr__, __dir__ = lazily(
        __name__, {"result": ("PerceptionResult",), "sensors": ("HandedSensors",), "system": ("PerceptionSystem",)}
    )

__all__ = ["HandedSensors", "PerceptionResult", "PerceptionSystem"]
