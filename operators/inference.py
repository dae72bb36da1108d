"""ONNX models in a mode that repeats: equal inputs give equal outputs on any load and core count."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import onnxruntime


class ModelError(ValueError):
    """A model file that does not fit its use: names the file, what it has and what would be right."""


def open_session(file: Path) -> onnxruntime.InferenceSession:
    """Opens an ONNX model for one CPU thread. Raises FileNotFoundError, or ModelError for a file that is no model."""
    import onnxruntime  # heavy, and needed only where a network runs

    if not file.is_file():
        raise FileNotFoundError(f"no ONNX model {str(file)!r} (looked for {file.absolute()})")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    options.use_deterministic_compute = True
    options.log_severity_level = 3
    try:
        return onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's exception classes share no public base
        raise ModelError(f"{file} cannot be loaded as an ONNX model: {error}") from error
