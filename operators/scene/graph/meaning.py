"""Nodes of a scene graph ranked by what a text means, in the space of an image-text network."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import FeatureVector, SceneGraph
from operators.inference import ModelError
from operators.language.text_tower import TextTower
from operators.models.registry import Model, Registry
from operators.models.use import missing
from operators.scene.graph.query import Match


def by_meaning(graph: SceneGraph, means: Iterable[FeatureVector], text: str) -> list[Match]:
    """Returns the nodes that have a vector, most alike first; their score is the cosine with the text's vector.

    `means` are vectors with ids of nodes, in the order of their stamps: the last of each node counts. Raises ModelError
    where their model has no tower of text or its files are not here, or where there is no vector.

    Source: zero-shot retrieval as in Radford et al. (CLIP), 2021; of nodes as in Gu et al., "ConceptGraphs", 2024.
    """
    model, known = "", dict[int, NDArray[np.float32]]()
    for message in means:
        if message.model != model:
            model, known = message.model, {}
        ids = () if message.ids is None else message.ids.tolist()
        known |= dict(zip(ids, message.vectors, strict=False))
    rows = [k for k, id in enumerate(graph.ids.tolist()) if id in known]
    if not rows:
        raise ModelError("no node of this graph has an embedding up to this time")
    vectors = np.stack([known[int(graph.ids[k])] for k in rows])
    (asked,) = _tower(model)([text])
    if vectors.shape[1] != len(asked):
        raise ModelError(f"vectors of {model} have {vectors.shape[1]} numbers, its texts {len(asked)}")
    matches = [Match(k, float(cosine), ()) for k, cosine in zip(rows, vectors @ asked, strict=True)]
    return sorted(matches, key=lambda m: (-m.score, int(graph.ids[m.node])))


def how_to_embed() -> str:
    """Returns how nodes get embeddings, with the name of a model."""
    named = next(iter(_embedding_models()), None)
    if named is None:
        return "no row of `dataflow models list` embeds images and text"
    return f"dataflow models get {named.name}, then run the graph with --set embed=true"


def _tower(model: str) -> TextTower:
    """Returns the tower of text that belongs to vectors of a model, `NAME-DIGEST`."""
    name = model.rpartition("-")[0]
    row = next((each for each in _embedding_models() if each.name == name), None)
    if row is None:
        raise ModelError(
            f"the nodes' vectors are of {model!r}, and no row of `dataflow models list` has text in that space; "
            f"{how_to_embed()}"
        )
    text, tokenizer = row.part("text"), row.part("tokenizer")
    for part in (text, tokenizer):
        if not part.file.is_file():
            raise ModelError(missing(part))
    return TextTower(text.file, tokenizer.file)


def _embedding_models() -> list[Model]:
    return [row for row in Registry.load() if row.task == "embedding" and row.parts.keys() >= {"text", "tokenizer"}]
