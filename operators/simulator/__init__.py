"""A simulated robot: worlds, sensors, people and the truth about them."""

from typing import TYPE_CHECKING

from dataflow.lazy import lazily

if TYPE_CHECKING:
    from operators.simulator.robot import SimulatedRobot
else:  # its modules are imported without it
    __getattr__, __dir__ = lazily(__name__, {"robot": ("SimulatedRobot",)})

__all__ = ["SimulatedRobot"]
