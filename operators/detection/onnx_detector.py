"""Object detection with a network in an ONNX file, or one of the registry of models by its name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from dataflow.messages import Detections2D, Image
from dataflow.operator import In, Operator, Out, Param, ParameterError
from operators.cameras import Cameras
from operators.detection.coco import names_of
from operators.detection.custom.refiner import GridFinder
from operators.detection.decode import detections_of
from operators.detection.decoders import DecoderName
from operators.detection.exported import ExportedFinder
from operators.image.letterbox import FitMode
from operators.inference import ModelError, Provider
from operators.models.registry import Registry
from operators.models.use import Used, names_a_model, use_model, use_part
from operators.network_input import read_labels, three_channels
from operators.weights import kind_of, trained_in_simulation

_SCORE, _GRID_IOU = 0.3, 0.5


class _OnnxDetection(Operator, abstract=True):
    """Holds what both operators share: the model, its parameters, and boxes of images."""

    stateless = True

    model: str = Param(min_length=1, doc="a name of `dataflow models list`, or an ONNX file")
    decoder: DecoderName | Literal["grid"] | None = Param(
        None,
        doc="family of the network: how its input is made and its output read; `grid` is of `dataflow train detector`; "
        "none takes the registry's",
    )
    classes: str | None = Param(
        None,
        tunable=True,
        doc="text file with one class name a line, or the names with commas between (`mug, fire extinguisher`); none "
        "takes the registry's, those of the model's metadata, or the 80 of COCO. A network with an open vocabulary "
        "finds what is named, and names may be added while it runs",
    )
    score_threshold: float | None = Param(
        None, ge=0, le=1, tunable=True, doc="boxes below are dropped; none takes the registry's for the model, or 0.3"
    )
    nms_iou: float | None = Param(
        None,
        ge=0,
        le=1,
        tunable=True,
        doc="overlap above which the weaker box of a class is dropped; none: the family's",
    )
    max_detections: int = Param(100, ge=1, tunable=True, doc="keep the best so many")
    fit: FitMode | None = Param(
        None, doc="how the image fills the input; none takes the registry's, or that of the decoder's family"
    )
    provider: Provider = Param("cpu", doc="onnxruntime's execution provider; results repeat bit for bit on the CPU")
    input_size: int | None = Param(
        None,
        ge=32,
        doc="side of the input; none takes the registry's, the model's own, or 640 where that is open. A network of "
        "convolutions (YOLOX) takes others than it was exported for: a larger one finds smaller things, in more time",
        unit="px",
    )
    masks: bool = Param(True, doc="give instance masks where the model has them")

    @classmethod
    def trained_in_simulation(cls, params: Mapping[str, Any]) -> bool:
        given = str(params["model"])
        if not names_a_model(given):
            return trained_in_simulation(given)
        registry = Registry.load()
        return given in registry and trained_in_simulation(registry[given].file)

    def setup(self) -> None:
        """Loads the model. Raises FileNotFoundError or ModelError."""
        used = use_model(self, self.model, "OnnxDetector")
        grid = "grid" if kind_of(used.file) == "detector" else None
        decoder = used.setting(self, "decoder", grid)
        if decoder is None:
            raise ModelError(
                f"{used.file} is no file of a model that `dataflow models list` prints, so OnnxDetector.decoder must "
                f"name its family"
            )
        self._finder: GridFinder | ExportedFinder
        self._finder = self._grid(used.file) if decoder == "grid" else self._exported(used, decoder)
        family = _GRID_IOU if isinstance(self._finder, GridFinder) else self._finder.nms_iou
        self._score = float(used.default("score_threshold", _SCORE))
        self._iou = float(used.default("nms_iou", family))
        self.log.info("%s", self._described(used, decoder))

    def on_parameter(self, name: str) -> None:
        """Adds names to those that are found. Raises ParameterError where the network cannot, or the first change."""
        if name != "classes":
            return
        known, finder = self._finder.names, self._finder
        if not (isinstance(finder, ExportedFinder) and finder.is_open):
            raise ParameterError(f"{self.model} finds the {len(known)} classes that it was trained for, and no others")
        try:
            names = known if self.classes is None else self._names(self.classes)
        except ModelError as error:
            raise ParameterError(str(error)) from None
        if names[: len(known)] != known:
            raise ParameterError(f"names may be added, after those before: {', '.join(known)}")
        finder.find_also(names[len(known) :])

    def _found_in(self, images: Sequence[Image]) -> list[Detections2D]:
        """Returns the detections of images, which go in at once where the model takes so.

        Raises ModelError where the model's output is not what the decoder reads, or has other classes than names.
        """
        score = self._score if self.score_threshold is None else self.score_threshold
        iou = self._iou if self.nms_iou is None else self.nms_iou
        pixels = [three_channels(image.data) for image in images]
        finder, most = self._finder, self.max_detections
        if isinstance(finder, GridFinder):
            found = [finder.find(each, score, iou, most) for each in pixels]
        else:
            found = finder.find_each(pixels, score, iou, most)
        return [detections_of(image, finder.names, each) for image, each in zip(images, found, strict=True)]

    def _grid(self, file: Path) -> GridFinder:
        given = {name: getattr(self, name) for name in ("classes", "fit", "input_size", "provider")}
        if unused := [name for name, value in given.items() if value not in (None, "cpu")]:
            raise ModelError(
                f"{file} was written by `dataflow train detector`: it holds its classes and its input, and runs on the "
                f"CPU, so leave {', '.join(unused)} of OnnxDetector out"
            )
        return GridFinder(file)

    def _exported(self, used: Used, decoder: DecoderName) -> ExportedFinder:
        return ExportedFinder(
            used.file,
            decoder,
            names_of(used.model) if self.classes is None else self._names(self.classes),
            provider=self.provider,
            fit=used.setting(self, "fit", None),
            side=used.setting(self, "input_size", None),
            masks=self.masks,
            tokenizer=None if used.model is None or not used.model.parts else use_part(self, used.model, "tokenizer"),
        )

    def _names(self, classes: str) -> tuple[str, ...]:
        names = tuple(name.strip() for name in classes.split(","))
        if Path(classes).is_file() or (len(names) == 1 and bool(Path(classes).suffix)):
            return read_labels(self.use_file(classes)).names
        if "" in names or len(set(names)) < len(names):
            raise ModelError(f"OnnxDetector.classes={classes!r} names a class twice or has an empty name")
        return names

    def _described(self, used: Used, decoder: str) -> str:
        count = len(self._finder.names)
        if used.model is None:
            return f"{Path(self.model).name}, decoder {decoder}, {count} classes, on {self.provider}"
        return f"{used.model.name} ({used.model.about}; {used.model.licence}), {count} classes, on {self.provider}"


class OnnxDetector(_OnnxDetection):
    """Finds objects in an image with an ONNX model; on the CPU with one thread, so equal images give equal boxes.

    The model is one of `dataflow models` by name, or a file. The decoder defines the colours, range and fit of its
    input and the meaning of its output; it comes from the registry for a file that has a row there, whatever its name.
    Inputs are (1, 3, H, W) or (1, H, W, 3) of float32, float16 or uint8. Models of instance segmentation give masks.
    """

    image: In[Image] = In(doc="RGB, or grey, which is repeated in the three channels")
    detections: Out[Detections2D] = Out(doc="boxes in the image's own pixels, by falling score; masks where it has any")

    def process(self, image: Image) -> Detections2D:
        """Raises ModelError where the model's output is not what the decoder reads, or has other classes than names."""
        return self._found_in([image])[0]


class OnnxRigDetector(_OnnxDetection, merge=True):
    """Finds objects in the images of several cameras at once, as OnnxDetector does: one call for all of one stamp.

    That is where the model's batch is of open size; one for a single image is called for each. A camera without an
    image at a stamp is left out of that call. For more than six cameras derive a class with more outputs.
    """

    images: In[Image] = In(many=True, doc="RGB or grey images of all cameras, told apart by their frames")
    detections_1: Out[Detections2D] = Out(doc="boxes in the first camera's pixels, by falling score")
    detections_2: Out[Detections2D] = Out(doc="in the second's")
    detections_3: Out[Detections2D] = Out(doc="in the third's")
    detections_4: Out[Detections2D] = Out(doc="in the fourth's")
    detections_5: Out[Detections2D] = Out(doc="in the fifth's")
    detections_6: Out[Detections2D] = Out(doc="in the sixth's")

    cameras: tuple[str, ...] = Param(min_length=1, doc="frames of the cameras' images, in the order of the outputs")

    def setup(self) -> None:
        """Loads the model. Raises ValueError for frames named twice, or more of them than there are outputs, too."""
        self._cameras = Cameras(self.cameras, list(self.spec.outputs), f"{type(self).__name__}.cameras")
        super().setup()

    def process(self, images: Mapping[str, Image]) -> dict[str, Detections2D]:
        """Raises ValueError for an image in a frame that is no camera's, or two in one frame."""
        given = self._cameras.by_port(images.values())
        return dict(zip(given, self._found_in(list(given.values())), strict=True))
