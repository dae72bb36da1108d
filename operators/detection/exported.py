"""An exported detector network in use, by the table of decoders."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from operators.detection.coco import COCO_CLASSES
from operators.detection.decode import Candidates, Layout, Outputs
from operators.detection.decoders import LAYOUTS, DecoderName
from operators.detection.nms import class_wise_nms
from operators.detection.open_input import opened
from operators.image.letterbox import FitMode, ImageFit
from operators.inference import ModelError, Provider, open_content, open_session
from operators.language.bpe import Tokenizer
from operators.model_metadata import told
from operators.network_input import NUMBERS, ImageInput, image_input

_PROMPT = "a photo of a {}"
_SIDE = 640  # pixels, where the model leaves it open


class ExportedFinder:
    """Raises FileNotFoundError, or ModelError for a model whose inputs the decoder does not know.

    `names`: of the classes; None takes those of the model's metadata (`names`), else COCO's. A network with an open
    vocabulary finds whatever is named, by its `tokenizer`.
    """

    def __init__(
        self,
        file: Path,
        decoder: DecoderName,
        names: tuple[str, ...] | None,
        *,
        provider: Provider = "cpu",
        fit: FitMode | None = None,
        side: int | None = None,
        masks: bool = True,
        tokenizer: Path | None = None,
    ) -> None:
        self._file, self._decoder = file, decoder
        self._layout: Layout = LAYOUTS[decoder]
        self._session = open_session(file, provider)
        self._input = self._image_input(side)
        self._apart = self._answers_by_image()
        self._opened = side is not None and self._input.size != (side, side)
        if self._opened and side is not None:
            self._open_input(side, provider)
        self._feed = self._size_input() if self._layout.sized else {}
        self._names = self._ordered()
        self._fit: FitMode = self._layout.fit if fit is None else fit
        self._masks = masks and self._layout.draw is not None
        labels = told(file, self._session.get_modelmeta().custom_metadata_map).labels if names is None else None
        self._given = names is not None or labels is not None
        self.names: tuple[str, ...] = names or (COCO_CLASSES if labels is None else labels.names)
        self._tokenizer = None
        if self._layout.words:
            if names is None or tokenizer is None:
                raise ModelError(
                    f"{file} finds what is named to it: give names in OnnxDetector.classes (`mug, fire extinguisher`), "
                    f"and take it by its name in `dataflow models list`, which has its tokenizer"
                )
            self._tokenizer = Tokenizer(tokenizer)
            self.find_also(())

    def _image_input(self, side: int | None) -> ImageInput:
        return image_input(
            self._file,
            self._session,
            (side or _SIDE, side or _SIDE),
            bgr=self._layout.bgr,
            mean=self._layout.mean,
            scale=self._layout.scale,
            others=2 if self._layout.words else int(self._layout.sized),
        )

    def _open_input(self, side: int, provider: Provider) -> None:
        """Lets the network take images of another side than its file names. Raises ModelError where it cannot."""
        exported = self._input
        extents = (2, 3) if exported.layout == "nchw" else (1, 2)
        self._session = open_content(opened(self._file.read_bytes(), exported.name, extents), str(self._file), provider)
        self._input = self._image_input(side)
        try:
            feed = self._size_input() if self._layout.sized else {}
            nothing = self._input.tensor(np.zeros((side, side, 3), np.uint8))
            outputs = self._session.run(self._ordered(), {exported.name: nothing, **feed})
            self._layout.decode(outputs, self._input.size, 1.0)
        except Exception as error:  # onnxruntime's exception classes share no public base
            raise ModelError(
                f"{self._file} was exported for images of {exported.size[0]}x{exported.size[1]} and takes none of "
                f"{side}x{side}, which only a network of convolutions does: leave out OnnxDetector.input_size ({error})"
            ) from error

    @property
    def is_open(self) -> bool:
        """True for a network that finds all that is named to it."""
        return self._tokenizer is not None

    def find_also(self, names: Sequence[str]) -> None:
        """Adds names to those that a network with an open vocabulary finds. Raises ModelError for other networks."""
        beside = [each for each in self._session.get_inputs() if each.name != self._input.name]
        beside.sort(key=lambda each: "mask" in each.name)  # stable: the tokens first
        if self._tokenizer is None or not beside or any(each.type != "tensor(int64)" for each in beside):
            described = ", ".join(f"{i.name} {i.type} {i.shape}" for i in beside)
            raise ModelError(f"{self._file} must take tokens of names and a mask, int64 [C, L]; it takes {described}")
        self.names = (*self.names, *names)
        length = beside[0].shape[1] if isinstance(beside[0].shape[1], int) else self._layout.words
        tokens = self._tokenizer([_PROMPT.format(name) for name in self.names], length)
        shown = np.arange(tokens.shape[1]) <= tokens.argmax(axis=1)[:, None]
        values = (tokens, shown.astype(np.int64))
        self._feed = {each.name: value for each, value in zip(beside, values, strict=False)}

    @property
    def nms_iou(self) -> float:
        """Overlap above which the family's authors drop the weaker box of a class."""
        return self._layout.nms_iou

    def find_each(
        self, images: Sequence[NDArray[np.uint8]], threshold: float, nms_iou: float, most: int
    ) -> list[Candidates]:
        """Finds the best `most` objects in each image (H, W, 3), RGB, in its pixels, by falling score.

        All images go in at once where the model takes so. Raises ModelError where the model's output is not what the
        decoder reads, or has other classes than names.
        """
        fits = [self._fitted(each) for each in images]
        tensors = [self._input.tensor(fit.apply(each)) for fit, each in zip(fits, images, strict=True)]
        answers = self._answers(tensors)
        return [self._read(each, fit, threshold, nms_iou, most) for each, fit in zip(answers, fits, strict=True)]

    def _fitted(self, image: NDArray[np.uint8]) -> ImageFit:
        """Returns how an image (H, W, 3) goes in: an input that was opened holds one row of cells of padding, no more.

        Without any, networks that learned with padding find other things at its border.
        """
        fit = ImageFit.plan(self._fit, (image.shape[1], image.shape[0]), self._input.size)
        if not self._opened or self._feed or fit.offset != (0, 0):
            return fit
        grid = self._layout.grid
        width, height = (-(-(extent + grid) // grid) * grid for extent in fit.inner)
        return replace(fit, target=(min(width, fit.target[0]), min(height, fit.target[1])))

    def _answers(self, tensors: Sequence[NDArray[Any]]) -> list[Outputs]:
        """Returns the outputs for each image, with a batch axis of 1."""
        count = len(tensors)
        alike = len({each.shape for each in tensors}) == 1
        at_once = count > 1 and alike and not self._feed and self._apart
        batches = [np.concatenate(tensors)] if at_once else tensors
        runs = [self._session.run(self._names, {self._input.name: batch, **self._feed}) for batch in batches]
        answers = [[a.astype(np.float32) if a.dtype == np.float16 else a for a in map(np.asarray, r)] for r in runs]
        if not at_once:
            return list(answers)
        if any(a.ndim == 0 or len(a) != count for a in answers[0]):
            shapes = ", ".join(str(a.shape) for a in answers[0])
            raise ModelError(
                f"{self._file} was given {count} images and answered {shapes}, which cannot be divided by image; "
                f"export it for one image at a time"
            )
        return [[a[k : k + 1] for a in answers[0]] for k in range(count)]

    def _answers_by_image(self) -> bool:
        """Returns whether a batch goes in and each output has the batch's own extent first.

        Rows of all images in one list (N, 7) do not, whatever their export calls N.
        """
        outputs = [each.shape for each in self._session.get_outputs()]
        batch = next(each.shape[0] for each in self._session.get_inputs() if each.name == self._input.name)
        listed = len(outputs) == 1 and len(outputs[0]) == 2
        return isinstance(batch, str) and not listed and all(shape and shape[0] == batch for shape in outputs)

    def _ordered(self) -> list[str] | None:
        """Returns the names of the outputs in the decoder's order; None for the export's own."""
        found = {each.name.split(":")[0]: each.name for each in self._session.get_outputs()}
        known = [found[name] for name in self._layout.names if name in found]
        return known if known and len(known) == len(self._layout.names) else None

    def _read(self, outputs: Outputs, fit: ImageFit, threshold: float, nms_iou: float, most: int) -> Candidates:
        try:
            found = self._layout.decode(outputs, fit.target, threshold)
        except ValueError as error:
            raise ModelError(f"OnnxDetector.decoder={self._decoder!r} does not fit {self._file}: {error}") from None
        self._check_classes(outputs, found)
        found = found.select(class_wise_nms(found.boxes, found.scores, found.classes, nms_iou)[:most])
        drawn = None
        if self._masks and found.masks is not None and self._layout.draw is not None:
            drawn = self._layout.draw(found, outputs, fit)
        return replace(found, boxes=fit.restore(found.boxes), masks=drawn)

    def _size_input(self) -> dict[str, NDArray[Any]]:
        """Returns what the second input of a `sized` network is given: (width, height) of the first."""
        beside = [each for each in self._session.get_inputs() if each.name != self._input.name]
        if not beside:
            return {}
        if beside[0].type not in NUMBERS:
            raise ModelError(
                f"{self._file}: its second input must be the size of the image, {' or '.join(NUMBERS)} [1, 2], is "
                f"{beside[0].name} {beside[0].type} {beside[0].shape}"
            )
        return {beside[0].name: np.array([self._input.size], NUMBERS[beside[0].type])}

    def _check_classes(self, outputs: Outputs, found: Candidates) -> None:
        known = self._layout.classes
        count = int(found.classes.max(initial=-1)) + 1 if known is None else known(outputs)
        if count > len(self.names) or (known is not None and count != len(self.names)):
            raise ModelError(
                f"{self._file} separates {count} {'classes' if known is not None else 'or more classes'}, but there "
                f"are {len(self.names)} class names{'' if self._given else ' (those of COCO)'}; give the "
                f"model's own in OnnxDetector.classes, one a line"
            )
