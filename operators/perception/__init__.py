"""The whole of perception as one object."""

from operators.perception.result import PerceptionResult
from operators.perception.sensors import HandedSensors
from operators.perception.system import PerceptionSystem

__all__ = ["HandedSensors", "PerceptionResult", "PerceptionSystem"]
