"""Classes of images and objects, embeddings."""

from __future__ import annotations

import rerun as rr

from dataflow.messages import Classification, FeatureVector
from dataflow.view.canvas import Canvas, visualizer


@visualizer(Classification, "status", "log")
def classification(canvas: Canvas, message: Classification) -> None:
    """A lane of classes over time for the image or for each object, and a line of text whenever a class changes."""
    ids = [None] * len(message.class_ids) if message.ids is None else message.ids.tolist()
    for identity, name, score in zip(ids, message.labels(), message.scores.tolist(), strict=True):
        subject = "image" if identity is None else f"object {identity}"
        if canvas.scene.changed(canvas.entity, f"class {subject}", name):
            canvas.log(f"status/{rr.escape_entity_path_part(subject)}", rr.StateChange(state=name))
            canvas.text(f"{subject}: {name} {score:.2f}")


@visualizer(FeatureVector, "tensor")
def feature_vector(canvas: Canvas, message: FeatureVector) -> None:
    """The vectors as rows of an image."""
    if message.vectors.size == 0:
        canvas.clear("tensor")
        return
    canvas.log("tensor", rr.Tensor(message.vectors, dim_names=["vector", "dimension"]))
