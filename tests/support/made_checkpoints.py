"""Checkpoints of torchvision's networks with random weights."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any


def new_network(name: str, classes: Sequence[str]) -> Any:
    from torchvision import models

    return models.get_model(name, weights=None, weights_backbone=None, num_classes=len(classes))


def write_checkpoint(file: Path, name: str, classes: Sequence[str]) -> Path:
    """The weights of a detector's last layers are large, so that some boxes are sure."""
    import torch

    torch.manual_seed(3)
    model = new_network(name, classes)
    for part, weight in model.named_parameters():
        if "classification_head" in part and part.endswith("bias"):
            torch.nn.init.normal_(weight, 0.0, 1.5)
        if "cls_score" in part:
            torch.nn.init.normal_(weight, 0.0, 0.5)
    torch.save({"model": model.state_dict(), "classes": list(classes)}, file)
    return file
