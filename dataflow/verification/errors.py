"""The errors of a verification that are due to its input rather than to this program."""

from __future__ import annotations

from dataflow.graph import GraphError
from dataflow.messages import MessageError
from dataflow.operator import ParameterError
from dataflow.recording import RecordingError
from dataflow.records.firing import FiringRecordError
from dataflow.reexecution.recorded_run import ReplayError

WRONG_INPUT = (RecordingError, ReplayError, FiringRecordError, GraphError, MessageError, ParameterError, OSError)
