"""Models of torchvision by name, with weights from its cache or from a file, on a device that is there.

Nothing is downloaded. A custom checkpoint is a file of `torch.save`: a state dict, or a mapping with the state
dict under `model` and the class names under `classes`, as `dataflow train torchvision` writes it.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Image
from operators.inference import ModelError
from operators.network_input import three_channels

if TYPE_CHECKING:
    import torch
    from torch import Tensor, nn

_LOG = logging.getLogger(__name__)

Family = Literal["detection", "segmentation", "classification"]
DEFAULT = "default"
"""Stands for the weights that torchvision itself recommends for a model."""
_NAMELESS = {"__background__", "N/A"}


class WeightsError(ModelError):
    """Weights are missing or do not fit; the message has the places searched, and what would be right."""


@dataclass(frozen=True)
class Loaded:
    """A model in evaluation mode on its device.

    - `classes`: names by the model's own class ids, the background included where it has one.
    - `transforms`: the preset of torchvision's own weights; None for a custom checkpoint.
    """

    model: nn.Module
    classes: tuple[str, ...]
    device: torch.device
    transforms: Any


def model_names(family: Family) -> list[str]:
    """Returns the names of torchvision's models of a family, sorted. Raises ModelError without torchvision."""
    from torchvision.models import list_models

    names: list[str] = list_models(module=_module(family))
    return names


def pick_device(name: str) -> torch.device:
    """Returns a device by name (`cpu`, `cuda`, `cuda:1`, `mps`). Raises ModelError for one that is not there."""
    import torch

    try:
        device = torch.device(name)
    except RuntimeError:
        raise ModelError(f"device {name!r} is unknown; expected cpu, cuda, cuda:N or mps") from None
    there = {
        "cpu": True,
        "cuda": torch.cuda.is_available() and (device.index or 0) < torch.cuda.device_count(),
        "mps": torch.backends.mps.is_available(),
    }
    if not there.get(device.type, False):
        seen = [f"cuda:{i}" for i in range(torch.cuda.device_count())] if torch.cuda.is_available() else []
        raise ModelError(f"device {name!r} is not available here; there is {', '.join(['cpu', *seen])}")
    return device


class Runner:
    """Runs a model on images, in half precision where asked, on the CPU where the GPU's memory does not suffice.

    `spilled` counts those; the first is logged.
    """

    def __init__(self, model: nn.Module, device: torch.device, *, half: bool) -> None:
        if half and device.type == "cpu":
            raise ModelError("half precision needs a GPU: leave half off, or give device: cuda")
        self.model, self.device, self.half = model, device, half
        self.spilled = 0

    def __call__(self, tensor: Tensor, call: Callable[[nn.Module, Tensor], Any]) -> Any:
        """Returns `call(model, tensor)` with both on the device; gradients are off."""
        import torch

        with torch.inference_mode():
            try:
                with torch.autocast(self.device.type, torch.float16, enabled=self.half):
                    return call(self.model, tensor.to(self.device))
            except torch.cuda.OutOfMemoryError:
                if not self.spilled:
                    _LOG.warning("the memory of %s does not suffice: images are worked on by the CPU", self.device)
                self.spilled += tensor.shape[0] if tensor.ndim == 4 else 1
                torch.cuda.empty_cache()
            try:
                return call(self.model.to("cpu"), tensor)
            finally:
                self.model.to(self.device)

    def summary(self) -> dict[str, int]:
        """Counts, for an operator's summary; empty where nothing happened."""
        return {"images_on_cpu_for_lack_of_memory": self.spilled} if self.spilled else {}


def batch_of(images: Sequence[Image]) -> Tensor:
    """Returns (N, 3, H, W) float32 in [0, 1] of N images of one size; grey is repeated in the three channels."""
    import torch

    return torch.stack([torch.from_numpy(np.ascontiguousarray(_channels_first(i))) for i in images]).float() / 255


def _channels_first(image: Image) -> NDArray[np.uint8]:
    return three_channels(image.data).transpose(2, 0, 1)


def wanted_classes(names: Sequence[str], asked: Sequence[str], where: str) -> NDArray[np.bool_]:
    """Returns which class ids (C,) are asked for; none asked for means all that have a name.

    Raises ModelError for a name that the model does not know.
    """
    known = [name for name in names if name not in _NAMELESS]
    for name in asked:
        if name not in known:
            near = get_close_matches(name, known, 1)
            hint = f"did you mean {near[0]!r}? " if near else ""
            raise ModelError(f"{where}: the model has no {name!r}; {hint}it has {', '.join(known)}")
    wanted = set(asked) or set(known)
    return np.array([name in wanted for name in names])


def load(family: Family, name: str, weights: str, file: Path | None, device: str) -> Loaded:
    """Builds a model and loads its weights: torchvision's own by `weights`, or those of `file`.

    `weights` is `default` or a name of torchvision's such as `COCO_V1`. Raises ModelError or WeightsError.
    """
    _known(family, name)
    where = pick_device(device)
    transforms = None
    if file is not None:
        state, classes = _read_checkpoint(file)
        count = len(classes) if classes else _classes_of(family, state, file)
        model = _empty(family, name, count, state)
        classes = classes or tuple(map(str, range(count)))
    else:
        chosen = weights_of(name, weights)
        state = _cached(name, chosen)
        classes = tuple(chosen.meta["categories"])
        model = _empty(family, name, len(classes), state)
        transforms = chosen.transforms()
    try:
        model.load_state_dict(state)
    except RuntimeError as error:
        raise WeightsError(f"{file or 'the weights'} do not fit {name}: {_first_lines(str(error))}") from None
    model.eval().to(where)
    return Loaded(model, classes, where, transforms)


def new_model(family: Family, name: str, classes: int) -> nn.Module:
    """Returns a model for so many classes, the background among them, with random weights.

    Raises ModelError for a name that torchvision lacks.
    """
    _known(family, name)
    return _empty(family, name, classes, {})


def family_of(name: str) -> Family:
    """Returns whether a model is a detector or a segmenter. Raises ModelError for one that is neither."""
    families: tuple[Family, ...] = ("detection", "segmentation")
    names = {family: model_names(family) for family in families}
    for family in families:
        if name in names[family]:
            return family
    every = [each for family in families for each in names[family]]
    near = get_close_matches(name, every, 1)
    hint = f"did you mean {near[0]!r}? " if near else ""
    raise ModelError(f"torchvision has no detector or segmenter {name!r}; {hint}there are {', '.join(every)}")


def cached_weights(name: str, weights: str) -> dict[str, Any]:
    """Returns the state dict of torchvision's weights (`default`, or a name such as `COCO_V1`) from its cache.

    Raises WeightsError with the places searched and how to get them.
    """
    return _cached(name, weights_of(name, weights))


def weights_of(name: str, weights: str) -> Any:
    """Returns torchvision's weights of a model by name (`default`, `COCO_V1`). Raises WeightsError for a wrong name."""
    from torchvision.models import get_model_weights

    choices = get_model_weights(name)
    if weights != DEFAULT and weights not in choices.__members__:
        raise WeightsError(f"{name} has no weights {weights!r}; torchvision has {', '.join(choices.__members__)}")
    return choices.DEFAULT if weights == DEFAULT else choices[weights]


def _module(family: Family) -> Any:
    try:
        from torchvision import models
    except ImportError as error:
        raise ModelError(f"torchvision is needed: pip install 'robot-dataflow[torch]' ({error})") from None
    return {"detection": models.detection, "segmentation": models.segmentation, "classification": models}[family]


def _known(family: Family, name: str) -> None:
    _module(family)
    names = model_names(family)
    if name not in names:
        near = get_close_matches(name, names, 1)
        hint = f"did you mean {near[0]!r}? " if near else ""
        raise ModelError(f"torchvision has no {family} model {name!r}; {hint}there are {', '.join(names)}")


def _cached(name: str, weights: Any) -> dict[str, Any]:
    """The state dict of torchvision's weights from its cache; WeightsError with the place, and how to get them."""
    import torch

    file = Path(torch.hub.get_dir()) / "checkpoints" / weights.url.rsplit("/", 1)[-1]
    if not file.is_file():
        raise WeightsError(
            f"the weights {weights} of {name} are not on this machine (looked for {file}); get them with "
            f"`python -c \"from torchvision.models import get_model; get_model('{name}', weights='{weights.name}')\"` "
            f"where there is a network, or give a custom checkpoint in `checkpoint`"
        )
    state: dict[str, Any] = torch.load(file, map_location="cpu", weights_only=True)
    return state


def _read_checkpoint(file: Path) -> tuple[dict[str, Any], tuple[str, ...]]:
    """(state dict, class names or none) of a file; only tensors and plain values are read, no code is run."""
    import pickle

    import torch

    try:
        read = torch.load(file, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError, ValueError) as error:
        advice = "weights_only" in str(error)  # torch's, to run whatever code the file holds
        why = "it is of another kind, or holds objects, which are not read" if advice else _first_lines(str(error))
        raise WeightsError(f"{file} is no checkpoint of torch.save with tensors, names and numbers: {why}") from None
    if isinstance(read, dict) and isinstance(read.get("model"), dict):
        names = read.get("classes", ())
        if not isinstance(names, Sequence) or isinstance(names, str):
            raise WeightsError(f"{file}: 'classes' must be a list of names, is {type(names).__name__}")
        return read["model"], tuple(map(str, names))
    if isinstance(read, dict) and read and all(isinstance(key, str) for key in read):
        return read, ()
    raise WeightsError(f"{file} must hold a state dict, or a mapping with 'model' and 'classes'")


_LAST = {
    "classification": ("fc", "classifier", "classifier.3", "classifier.1", "heads.head", "head"),
    "segmentation": ("classifier.4", "classifier.low_classifier"),
    "detection": ("roi_heads.box_predictor.cls_score",),
}
"""The last layer, whose weight has a row for each class."""


def _classes_of(family: Family, state: dict[str, Any], file: Path) -> int:
    for layer in _LAST[family]:
        if f"{layer}.weight" in state:
            return int(state[f"{layer}.weight"].shape[0])
    raise WeightsError(
        f"{file} does not say how many classes it has: save {{'model': state_dict, 'classes': [names]}} instead"
    )


def _empty(family: Family, name: str, count: int, state: dict[str, Any]) -> nn.Module:
    """The model for `count` classes without weights; with the auxiliary head that some segmentation weights carry."""
    from torchvision.models import get_model

    options: dict[str, Any] = {} if family == "classification" else {"weights_backbone": None}
    if family == "segmentation" and any(key.startswith("aux_classifier.") for key in state):
        options["aux_loss"] = True
    model: nn.Module = get_model(name, weights=None, num_classes=count, **options)
    return model


def _first_lines(text: str, most: int = 300) -> str:
    """The beginning of a message of torch's, which names every single weight, on one line."""
    line = " ".join(text.split())
    return line if len(line) <= most else f"{line[:most]} ..."
