"""Registrations by other libraries, as operators: `benchmarks/causes.py --wild` asks why they do not repeat."""

from __future__ import annotations

import numpy as np
import reproducibility
import xxhash

from dataflow.messages import FeatureVector
from dataflow.operator import In, Operator, Out, Param


class Registration(Operator, abstract=True):
    """Registers two scans of a room in each call; emits 16 bits of the digest of the result."""

    x: In[FeatureVector]
    out: Out[FeatureVector]
    threads: int = Param(1, ge=1, doc="threads that the library is asked to use")

    def process(self, x: FeatureVector) -> FeatureVector:
        digest = xxhash.xxh3_64_intdigest(self.register()) & 0xFFFF
        return FeatureVector(stamp=x.stamp, vectors=np.array([[digest]], np.float32), model="registration")

    def register(self) -> bytes:
        raise NotImplementedError


class KissIcp(Registration):
    """kiss-icp on four scans."""

    def register(self) -> bytes:
        return reproducibility.kiss_icp(self.threads)


class SmallGicp(Registration):
    """small_gicp on two scans."""

    def register(self) -> bytes:
        return reproducibility.small_gicp(self.threads)


class Open3dIcp(Registration):
    """Open3D's point-to-plane ICP on two scans."""

    def register(self) -> bytes:
        return reproducibility.open3d_icp(self.threads)
