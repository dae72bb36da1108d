"""Networks that segment what is in given boxes: EfficientSAM in one file, SAM and MobileSAM in two."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from operators.inference import ModelError, Provider, open_session
from operators.network_input import NORMALIZATIONS, image_input

Logits = NDArray[np.float32]
Pixels = NDArray[np.uint8]

_CORNERS = (2.0, 3.0)  # labels of a box's upper left and lower right corner among a prompt's points
_SIDE = 1024  # pixels of an image's longer side in an encoder that leaves it open
_DECODER = {"image_embeddings", "point_coords", "point_labels", "mask_input", "has_mask_input", "orig_im_size"}
_MULTIPLE = 4  # masks of a decoder that gives all: of ambiguous prompts the first, which no box is


class ImageAndBoxes:
    """Gives the masks of boxes with a network that takes an image (1, 3, H, W), points (1, Q, 2, 2) in its pixels and
    their labels (1, Q, 2), and answers with logits (1, Q, M, h, w) and how well each of the M fits (1, Q, M).
    """

    def __init__(self, file: Path, provider: Provider, free: tuple[int, int]) -> None:
        """`free` is the (width, height) of an input that leaves it open. Raises ModelError for other inputs."""
        self._file, self._session = file, open_session(file, provider)
        mean, scale = NORMALIZATIONS["unit"]
        self._input = image_input(
            file, self._session, free, bgr=False, mean=mean, scale=scale, layouts=("nchw",), others=2
        )
        beside = self._session.get_inputs()[1:]
        shapes = [list(each.shape[2:]) for each in beside]
        if len(beside) != 2 or len(shapes[0]) != 2 or len(shapes[1]) != 1 or len(self._session.get_outputs()) < 2:
            described = ", ".join(f"{i.name} {i.type} {i.shape}" for i in beside)
            raise ModelError(
                f"{file} must take points [1, Q, P, 2] and labels [1, Q, P] besides the image and give masks and how "
                f"well they fit; it takes {described}"
            )
        self._points, self._labels = (each.name for each in beside)
        self._kind = np.float16 if beside[0].type == "tensor(float16)" else np.float32
        self._at_once = not isinstance(beside[0].shape[1], int)

    def logits(self, pixels: Pixels, boxes: NDArray[np.float32]) -> list[Logits]:
        """Returns the best mask of each box (N, 4) in an image (H, W, 3), as logits (h, w) that cover it."""
        scale = np.array(self._input.size, np.float32) / np.array(pixels.shape[1::-1], np.float32)
        prompts = (boxes.reshape(-1, 2, 2) * scale).astype(np.float32)
        fitted = cv2.resize(pixels, self._input.size, interpolation=cv2.INTER_LINEAR)
        tensor = self._input.tensor(np.asarray(fitted, np.uint8))
        groups = [prompts] if self._at_once else list(prompts[:, None])
        return [plane for group in groups for plane in self._best(tensor, group)]

    def _best(self, tensor: NDArray[Any], prompts: NDArray[np.float32]) -> NDArray[np.float32]:
        """Returns the logits (Q, h, w) of the best mask of each prompt (Q, 2, 2)."""
        labels = np.tile(np.array(_CORNERS, np.float32), (1, len(prompts), 1))
        beside = {self._points: prompts[None].astype(self._kind), self._labels: labels.astype(self._kind)}
        given = {self._input.name: tensor, **beside}
        masks, fits = (np.asarray(answer, np.float32) for answer in self._session.run(None, given)[:2])
        if masks.ndim != 5 or masks.shape[:3] != (1, len(prompts), *fits.shape[2:]) or fits.ndim != 3:
            raise ModelError(
                f"{self._file} gave {masks.shape} and {fits.shape} for {len(prompts)} boxes; masks (1, Q, M, h, w) and "
                f"fits (1, Q, M) are needed"
            )
        best: NDArray[np.float32] = masks[0][np.arange(len(prompts)), fits[0].argmax(axis=1)]
        return best


class EncoderAndDecoder:
    """Gives the masks of boxes with SAM's encoder of an image and its decoder of prompts, in two files.

    The decoder is as SAM's and MobileSAM's `export_onnx_model.py` write it. The encoder takes a normalised and padded
    image (1, 3, S, S), or pixels (h, w, 3) that it normalises and pads by itself.

    Source: `SamPredictor` and `SamOnnxModel` of Kirillov et al., "Segment Anything", 2023.
    """

    def __init__(self, encoder: Path, decoder: Path, provider: Provider) -> None:
        """Raises ModelError for other inputs."""
        self._encoder, self._decoder = open_session(encoder, provider), open_session(decoder, provider)
        inputs = {each.name: each for each in self._decoder.get_inputs()}
        if inputs.keys() != _DECODER:
            raise ModelError(f"{decoder} must take {', '.join(sorted(_DECODER))}; it takes {', '.join(sorted(inputs))}")
        self._mask = np.zeros(inputs["mask_input"].shape, np.float32)
        self._pixels, self._side = self._encoder.get_inputs()[0].name, _SIDE
        self._input = None
        if len(self._encoder.get_inputs()[0].shape) != 3:
            mean, scale = NORMALIZATIONS["imagenet"]
            self._input = image_input(
                encoder, self._encoder, (_SIDE, _SIDE), bgr=False, mean=mean, scale=scale, layouts=("nchw",)
            )
            self._side = max(self._input.size)

    def logits(self, pixels: Pixels, boxes: NDArray[np.float32]) -> list[Logits]:
        """Returns the best mask of each box (N, 4) in an image (H, W, 3), as logits (H, W)."""
        height, width = pixels.shape[:2]
        inner = np.floor(np.array([width, height]) * self._side / max(width, height) + 0.5).astype(int)
        resized = np.asarray(cv2.resize(pixels, inner.tolist(), interpolation=cv2.INTER_LINEAR), np.uint8)
        embeddings = self._encoder.run(None, self._given(resized))[0]
        corners = boxes.reshape(-1, 1, 2, 2) * (inner / [width, height])
        beside = {
            "image_embeddings": embeddings,
            "point_labels": np.array([_CORNERS], np.float32),
            "mask_input": self._mask,
            "has_mask_input": np.zeros(1, np.float32),
            "orig_im_size": np.array([height, width], np.float32),
        }
        found = []
        for points in corners.astype(np.float32):
            masks, fits = self._decoder.run(["masks", "iou_predictions"], {**beside, "point_coords": points})
            first = int(fits.shape[1] == _MULTIPLE)
            found.append(masks[0, first + int(fits[0, first:].argmax())])
        return found

    def _given(self, resized: Pixels) -> dict[str, NDArray[Any]]:
        if self._input is None:
            return {self._pixels: resized.astype(np.float32)}
        padded = np.zeros((1, 3, self._side, self._side), self._input.type)
        padded[..., : resized.shape[0], : resized.shape[1]] = self._input.tensor(resized)
        return {self._input.name: padded}
