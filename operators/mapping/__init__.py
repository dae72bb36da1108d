"""Maps of what stands still: occupancy grids for navigation, rooms, surfaces."""

from operators.mapping.occupancy_mapper import OccupancyMapper
from operators.mapping.room_segmenter import RoomSegmenter
from operators.mapping.tsdf_map import TsdfMap

__all__ = ["OccupancyMapper", "RoomSegmenter", "TsdfMap"]
