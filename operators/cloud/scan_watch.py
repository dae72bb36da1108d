"""LiDAR scans that show nothing new are held back, as an operator."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dataflow.messages import Diagnostics, Message, PointCloud
from dataflow.operator import In, Operator, Out, Param
from operators.watching import Watcher


class ScanWatch(Operator):
    """Passes LiDAR scans on unless they have hardly a point or repeat the last one, and says so.

    A LiDAR that hangs looks like a robot that stands: odometry of its scans would hold the pose against all others.
    """

    cloud: In[PointCloud] = In(doc="one turn of the LiDAR")
    checked: Out[PointCloud] = Out(doc="the same scan, if it shows something new")
    status: Out[Diagnostics] = Out(doc="with every scan; a warning for one that is held back")

    least: int = Param(20, ge=0, live=True, doc="fewest points")

    def setup(self) -> None:
        self._watcher = Watcher("scan_watch", "scan")

    def process(self, cloud: PointCloud) -> Mapping[str, Message]:
        few = cloud.count < self.least
        flaw = self._watcher.judge(cloud.points, "has too few points" if few else None)
        status = self._watcher.status(cloud.stamp, flaw)
        return {"status": status} if flaw else {"checked": cloud, "status": status}

    def on_reset(self, input: str) -> None:
        """The clock began anew; the same scan may come again."""
        self._watcher.last = b""

    def snapshot(self) -> Mapping[str, Any]:
        return self._watcher.snapshot()

    def restore(self, state: Mapping[str, Any]) -> None:
        self._watcher.restore(state)

    def summary(self) -> Mapping[str, int]:
        return dict(self._watcher.counts)
