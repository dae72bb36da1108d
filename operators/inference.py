"""ONNX models in a mode that repeats: equal inputs give equal outputs on any load and core count."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field

from operators.protobuf import field

if TYPE_CHECKING:
    import onnxruntime


class ModelError(ValueError):
    """A model file that does not fit its use: names the file, what it has and what would be right."""


_PROVIDERS = {
    "cpu": "CPUExecutionProvider",
    "cuda": "CUDAExecutionProvider",
    "tensorrt": "TensorrtExecutionProvider",
    "openvino": "OpenVINOExecutionProvider",
    "rocm": "ROCMExecutionProvider",
    "qnn": "QNNExecutionProvider",
    "coreml": "CoreMLExecutionProvider",
}
"""onnxruntime's names. All but the first come with builds of it for those devices."""

Provider = Annotated[str, Field(pattern=rf"^({'|'.join(_PROVIDERS)}|(cuda|tensorrt|rocm):\d+)$")]
"""One of these; of several cards one by its number: `cuda:1`."""


def open_session(file: Path, provider: Provider = "cpu", reveal: Sequence[str] = ()) -> onnxruntime.InferenceSession:
    """Opens an ONNX model, for one thread on the CPU. Inner values that `reveal` names follow its own outputs.

    Raises FileNotFoundError, or ModelError for a file that is no model, or a provider that is not there or finds no
    device: what is asked for is not silently done by the CPU.
    """
    import onnxruntime  # heavy, and needed only where a network runs

    available, wanted = onnxruntime.get_available_providers(), provider.partition(":")[0]
    if _PROVIDERS[wanted] not in available:
        names = [name for name, full in _PROVIDERS.items() if full in available]
        raise ModelError(
            f"this onnxruntime has no provider {wanted!r}; it has {', '.join(names)} (other builds: onnxruntime-gpu, "
            f"onnxruntime-openvino, onnxruntime-qnn)"
        )

    if not file.is_file():
        raise FileNotFoundError(f"no ONNX model {str(file)!r} (looked for {file.absolute()})")
    return _opened(file.read_bytes() + _outputs(reveal) if reveal else str(file), str(file), provider)


def open_content(content: bytes, told: str, provider: Provider = "cpu") -> onnxruntime.InferenceSession:
    """Opens an ONNX model that is a part of a file, or was changed, for one thread on the CPU.

    Raises ModelError with its place (`told`) for one that is no model.
    """
    return _opened(content, told, provider)


def _opened(model: bytes | str, told: str, provider: Provider) -> onnxruntime.InferenceSession:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    options.use_deterministic_compute = True
    options.log_severity_level = 3
    try:
        chosen = _chosen(provider, onnxruntime.get_available_providers())
        session = onnxruntime.InferenceSession(model, options, providers=chosen)
    except Exception as error:  # onnxruntime's exception classes share no public base
        raise ModelError(f"{told} cannot be loaded as an ONNX model: {error}") from error
    if _PROVIDERS[provider.partition(":")[0]] not in session.get_providers():  # it only logs this, and takes another
        raise ModelError(
            f"onnxruntime's provider {provider!r} could not start: is there such a device, and are its driver and "
            f"libraries installed? On this machine provider: cpu runs {told}"
        )
    return session


def _chosen(provider: Provider, available: Sequence[str]) -> list[str | tuple[str, dict[str, Any]]]:
    """The provider, and others for the layers that it does not know: for TensorRT CUDA first, then the CPU.

    Those of cards get the number of the card where one is given.
    """
    name, _, number = provider.partition(":")
    cuda = ("cuda",) if name == "tensorrt" and _PROVIDERS["cuda"] in available else ()
    card: dict[str, Any] = {"device_id": int(number)} if number else {}
    cards: list[str | tuple[str, dict[str, Any]]] = [
        (_PROVIDERS[each], card) if card else _PROVIDERS[each] for each in (name, *cuda) if each != "cpu"
    ]
    return [*cards, _PROVIDERS["cpu"]]


def _outputs(names: Sequence[str]) -> bytes:
    """Returns what gives a serialized model more outputs when it is appended: protobuf merges messages that follow.

    That is a ModelProto whose field 7, the graph, has a field 12, an output, with field 1, its name, for each.
    """
    return b"".join(field(7, field(12, field(1, name.encode()))) for name in names)
