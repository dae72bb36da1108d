"""Fine-tuning of torchvision's detectors and segmenters, as tasks for the training loop."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from operators.detection.custom.augmentation import DetectionSample, view
from operators.detection.custom.dataset import DetectionData
from operators.detection.custom.evaluation import ScoredImage, score_detections
from operators.detection.decode import Candidates
from operators.learning.augmentation import Variation, tensor_of
from operators.learning.files import TrainingFileError, load_safely, save_atomically
from operators.segmentation.dataset import VOID, SegmentationData
from operators.segmentation.score import confusion, mean_iou
from operators.torch_models import Family, new_model

BACKGROUND = "__background__"
_MEAN, _DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of the images that torchvision's weights know
_LEAST_SCORE = 0.01  # average precision asks for the whole curve


class _TorchvisionTask:
    """Holds what both have in common: a model by name with as many outputs as the data have classes."""

    def __init__(
        self, family: Family, model: str, classes: Sequence[str], size: tuple[int, int], seed: int, samples: int
    ) -> None:
        torch.manual_seed(seed)
        self.samples = samples
        self.kind = f"torchvision {family}"
        self.model, self.classes, self.size = model, tuple(classes), size
        self.network = new_model(family, model, len(self.classes))

    def begin_with(self, state: Mapping[str, Tensor]) -> tuple[int, int]:
        """Takes over the weights that fit, so all but the last layers where classes differ; how many of how many.

        Raises TrainingFileError where none fits.
        """
        own = self.network.state_dict()
        fit = {name: value for name, value in state.items() if name in own and own[name].shape == value.shape}
        if not fit:
            raise TrainingFileError(f"none of the given weights fits {self.model}: are they of another model?")
        self.network.load_state_dict({**own, **fit})
        return len(fit), len(own)

    def export(self, network: nn.Module, facts: Mapping[str, Any], file: Path) -> None:
        """Writes what the operators take as `checkpoint`: the weights and the class names."""
        state = {name: value.detach().cpu().contiguous() for name, value in network.state_dict().items()}
        described = {"network": self.model, "size": list(self.size), **facts}
        save_atomically({"model": state, "classes": list(self.classes), "facts": described}, file)

    def description(self) -> dict[str, Any]:
        """Returns what must be the same for a checkpoint to be resumed."""
        return {"model": self.model, "classes": list(self.classes), "size": list(self.size), "images": self.samples}


class TorchvisionDetectorTask(_TorchvisionTask):
    """Trains a detector of torchvision on labelled images, shown at `size` (width, height), by the model's own loss.

    Objects that are to be ignored are left out: torchvision's losses know none, so they count as background.
    """

    def __init__(
        self, data: DetectionData, model: str, size: tuple[int, int], *, seed: int = 0, variation: Variation
    ) -> None:
        super().__init__("detection", model, (BACKGROUND, *data.classes), size, seed, len(data.training))
        self.data, self.variation = data, variation

    def batch(
        self, samples: list[int], rngs: list[np.random.Generator]
    ) -> tuple[list[Tensor], list[dict[str, Tensor]], int]:
        views = [
            view(self.data.training[k], self.size, self.variation, rng) for k, rng in zip(samples, rngs, strict=True)
        ]
        images = [torch.from_numpy(tensor_of(each.pixels)) for each in views]
        return images, [_targets(each) for each in views], int(rngs[0].integers(1 << 31))

    def loss(self, batch: tuple[list[Tensor], list[dict[str, Tensor]], int], device: torch.device) -> dict[str, Tensor]:
        images, targets, seed = batch
        torch.manual_seed(seed)  # some models choose among their proposals at random
        there = [{name: value.to(device) for name, value in target.items()} for target in targets]
        losses: dict[str, Tensor] = self.network([image.to(device) for image in images], there)
        return losses

    def evaluate(self, network: nn.Module) -> dict[str, float]:
        device = next(network.parameters()).device
        part = getattr(network, "roi_heads", network)
        part.score_thresh = min(float(part.score_thresh), _LEAST_SCORE)  # type: ignore[arg-type]
        scored = []
        for image in self.data.validation:
            pixels = image.read()
            with torch.inference_mode():
                found = network([torch.from_numpy(tensor_of(pixels)).to(device)])[0]
            extent = np.array([pixels.shape[1], pixels.shape[0]] * 2, np.float32)
            boxes = Candidates(
                found["boxes"].cpu().numpy().astype(np.float32),
                found["scores"].cpu().numpy().astype(np.float32),
                found["labels"].cpu().numpy().astype(np.int32) - 1,
            )
            scored.append(ScoredImage(image.boxes * extent, image.classes, image.ignored, boxes))
        score = score_detections(scored, self.data.classes)
        return {"score": score.ap50, "ap50": score.ap50, "ap": score.ap}


class TorchvisionSegmenterTask(_TorchvisionTask):
    """Trains a segmenter of torchvision on images with masks, shown at `size` (width, height), by cross entropy."""

    def __init__(
        self, data: SegmentationData, model: str, size: tuple[int, int], *, seed: int = 0, variation: Variation
    ) -> None:
        super().__init__("segmentation", model, data.classes, size, seed, len(data.training))
        self.data, self.variation = data, variation

    def batch(self, samples: list[int], rngs: list[np.random.Generator]) -> tuple[Tensor, Tensor, int]:
        views = [
            self.data.training[k].view(len(self.classes), self.size, self.variation, rng)
            for k, rng in zip(samples, rngs, strict=True)
        ]
        masks = torch.from_numpy(np.stack([mask for _, mask in views]).astype(np.int64))
        return torch.stack([_normalised(pixels) for pixels, _ in views]), masks, int(rngs[0].integers(1 << 31))

    def loss(self, batch: tuple[Tensor, Tensor, int], device: torch.device) -> dict[str, Tensor]:
        images, masks, seed = batch
        torch.manual_seed(seed)  # of dropout
        found, masks = self.network(images.to(device)), masks.to(device)
        entropy = {"entropy": functional.cross_entropy(found["out"].float(), masks, ignore_index=VOID)}
        if "aux" in found:
            entropy["auxiliary"] = 0.5 * functional.cross_entropy(found["aux"].float(), masks, ignore_index=VOID)
        return entropy

    def evaluate(self, network: nn.Module) -> dict[str, float]:
        device, count = next(network.parameters()).device, len(self.classes)
        table = np.zeros((count, count + 1), np.int64)
        for image in self.data.validation:
            pixels, mask = image.view(len(self.classes), self.size, self.variation, None)
            with torch.inference_mode():
                scores = network(_normalised(pixels)[None].to(device))["out"]
            table += confusion(mask, scores.argmax(dim=1)[0].cpu().numpy().astype(np.uint8), count)
        score = mean_iou(table)
        return {"score": score, "miou": score}


def weights_in(file: Path) -> dict[str, Tensor]:
    """Returns the state dict in a file of torch.save: as it is, under `model`, or under `ema` of a training.

    Raises FileNotFoundError or TrainingFileError.
    """
    read = load_safely(file)
    found = next((read[key] for key in ("model", "ema") if isinstance(read.get(key), dict)), read)
    if not found or not all(isinstance(value, Tensor) for value in found.values()):
        raise TrainingFileError(f"{file} holds no state dict of a model, alone or under 'model' or 'ema'")
    return dict(found)


def _targets(sample: DetectionSample) -> dict[str, Tensor]:
    wanted = ~sample.ignored
    return {
        "boxes": torch.from_numpy(sample.boxes[wanted].astype(np.float32).reshape(-1, 4)),
        "labels": torch.from_numpy(sample.classes[wanted].astype(np.int64) + 1),
    }


def _normalised(pixels: NDArray[np.uint8]) -> Tensor:
    mean, deviation = (torch.tensor(values)[:, None, None] for values in (_MEAN, _DEVIATION))
    return (torch.from_numpy(tensor_of(pixels)) - mean) / deviation
