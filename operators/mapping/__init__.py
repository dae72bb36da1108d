"""Maps of what stands still: occupancy grids for navigation, surfaces."""

from operators.mapping.occupancy_mapper import OccupancyMapper
from operators.mapping.tsdf_map import TsdfMap

__all__ = ["OccupancyMapper", "TsdfMap"]
