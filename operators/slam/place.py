"""Names what is known of a sensor's place in a map."""

from __future__ import annotations

from enum import StrEnum
from typing import Any

from operators.slam.place_graph import PlaceGraph
from operators.slam.sensor_model import Added


class Place(StrEnum):
    """Basis of the sensor's place in the map."""

    MAPPED = "mapped"  # by a chain of odometry from places that are in the map
    CORRECTED = "corrected"  # by a loop at this very measurement
    SEARCHING = "searching"  # not since the start, or since the odometry began anew: no view was recognised yet
    ADRIFT = "adrift"  # the odometry measures nothing


def place_of(graph: PlaceGraph[Any], added: Added, adrift: str, reason: str) -> tuple[Place, str]:
    """Returns the place and the reason, from the odometry's: `adrift` if it measures nothing, else `reason`."""
    refused = f"; refused: {', '.join(added.refused)}" if added.refused else ""
    if added.found:
        return Place.CORRECTED, "the map is found"
    if added.loops:
        return Place.CORRECTED, f"{added.loops} views of before seen again"
    if not graph.located:
        return Place.SEARCHING, f"no view of the map is recognised yet{refused}"
    if adrift:
        return Place.ADRIFT, adrift
    return Place.MAPPED, f"{reason}{refused}"
