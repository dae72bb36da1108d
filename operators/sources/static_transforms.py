"""The places of sensors on a robot, from files, as a source."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from dataflow.messages import Message, Transforms
from dataflow.operator import Out, Param, Source, SourceError
from operators.geometry.calibration_files import CalibrationFileError, read_transforms


class StaticTransforms(Source):
    """Gives the transforms of files, such as `dataflow calibrate stereo` and `dataflow calibrate camera-imu` write, as
    extrinsics, and nothing else.

    A file has a list `transforms` of frame, child_frame, translation [x, y, z] in metres and rotation [x, y, z, w].
    """

    extrinsics: Out[Transforms] = Out(static=True, doc="the transforms of all files")

    paths: tuple[str, ...] = Param(min_length=1, doc="the files; together their frames are a tree, or several")

    def setup(self) -> None:
        """Raises SourceError, FileNotFoundError."""
        try:
            self._transforms = read_transforms([self.use_file(path) for path in self.paths])
        except CalibrationFileError as error:
            raise SourceError(str(error)) from error

    def static_outputs(self) -> Mapping[str, Message]:
        return {"extrinsics": self._transforms}

    def stream(self) -> Iterator[Mapping[str, Message]]:
        yield from ()
