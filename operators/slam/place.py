"""The place of a sensor in a map, by its odometry and the map's loops."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from operators.geometry.se3 import Matrix
from operators.odometry.tracking import Status
from operators.slam.place_graph import PlaceGraph
from operators.slam.sensor_model import KeyframeResult


class Place(StrEnum):
    """Basis of the sensor's place in the map."""

    MAPPED = "mapped"  # by a chain of odometry from places that are in the map
    CORRECTED = "corrected"  # by a loop at this very measurement
    SEARCHING = "searching"  # not since the start, or since the odometry began anew: no view was recognised yet
    ADRIFT = "adrift"  # the odometry measures nothing


@dataclass(frozen=True, eq=False)
class MappingResult:
    """Holds what a frame or scan gave to the map. `T_map_odom` is None while the place in the map is not known."""

    place: Place
    reason: str
    T_map_odom: Matrix | None
    covariance: Matrix  # (6, 6) of the sensor's pose in the map, right perturbation
    added: KeyframeResult


def mapped(
    graph: PlaceGraph[Any],
    added: KeyframeResult,
    odometry: Status,
    reason: str,
    T: Matrix,
    covariance: Matrix,
    known: bool,
) -> MappingResult:
    """Returns what an odometry's pose (4, 4) and its covariance (6, 6) mean in the map, if that is `known`."""
    place, why = _place_of(graph, added, odometry, reason)
    T_map_odom = graph.T_map_odom.copy() if known else None
    return MappingResult(place, why, T_map_odom, graph.covariance_at(T, covariance), added)


def _place_of(graph: PlaceGraph[Any], added: KeyframeResult, odometry: Status, reason: str) -> tuple[Place, str]:
    refused = f"; refused: {', '.join(added.refused)}" if added.refused else ""
    if added.found:
        return Place.CORRECTED, "the map is found"
    if added.loops:
        return Place.CORRECTED, f"{added.loops} views of before seen again"
    if not graph.located:
        return Place.SEARCHING, f"no view of the map is recognised yet{refused}"
    if odometry in (Status.PREDICTED, Status.LOST):
        return Place.ADRIFT, f"odometry {odometry}: {reason}"
    return Place.MAPPED, f"{reason or 'by odometry'}{refused}"
