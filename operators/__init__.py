"""Operators for robot perception."""

MOVED_OPERATORS = {
    "operators.sources:SimulatedRobot": "operators.simulator:SimulatedRobot",
}
"""Former path → present path: graphs and recordings that name the former find the operator."""
