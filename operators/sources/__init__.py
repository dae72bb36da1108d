"""Sources: datasets, devices and made-up sequences."""

from operators.sources.rgbd_folder import RgbdFolder
from operators.sources.synthetic_rgbd import SyntheticRgbd

__all__ = ["RgbdFolder", "SyntheticRgbd"]
