"""LiDAR scans that show nothing new are held back, as an operator."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from dataflow.messages import Diagnostics, Message, PointCloud
from dataflow.operator import In, Operator, Out, Param
from operators.monitoring.watching import MeasurementGate


class ScanWatch(MeasurementGate, Operator):
    """Passes LiDAR scans on unless they have too few points or repeat the last one, which the status reports.

    A LiDAR that hangs looks like a robot that stands: odometry of its scans would hold the pose against all others.
    """

    named = ("scan_watch", "scan")

    cloud: In[PointCloud] = In(doc="one turn of the LiDAR")
    checked: Out[PointCloud] = Out(doc="the same scan, if it shows something new")
    status: Out[Diagnostics] = Out(doc="with every scan; a warning for one that is held back")

    least: int = Param(20, ge=0, tunable=True, doc="fewest points that are finite")

    def process(self, cloud: PointCloud) -> Mapping[str, Message]:
        few = int(np.isfinite(cloud.points).all(axis=1).sum()) < self.least
        return self.passed(cloud, cloud.points, "has too few points" if few else None)
