"""The second networks, trained on what a first one answers and put into its file: a detector's refiner, and a
segmenter's second look at borders."""

from __future__ import annotations

import json as jsonlib
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import typer

from operators.training.console import Data, friendly
from operators.training.options import ImageTraining, takes
from operators.training.running import tell_data, tell_scores, told_of

if TYPE_CHECKING:
    from operators.detection.custom.dataset import DetectionData
    from operators.learning.augmentation import Variation
    from operators.learning.loop import Outcome, Task
    from operators.segmentation.dataset import SegmentationData
    from operators.weights import Network

First = Annotated[Path, typer.Argument(help="The first network's file (.onnx).", show_default=False)]
Out = Annotated[Path | None, typer.Option(help="The file to write. Default: WEIGHTS itself.")]
RefinerEpochs = Annotated[
    int, typer.Option(min=0, help="Passes of the refiner, which looks at each found box once more; 0 leaves it away.")
]
BorderEpochs = Annotated[
    int, typer.Option(min=0, help="Passes of the second look at the borders of classes; 0 leaves it away.")
]


class SecondStage(ABC):
    """A kind of second network, with the passes, chunks of a step and largest learning rate that suit it."""

    kind: ClassVar[str]
    first: ClassVar[str]
    epochs: ClassVar[int]
    batch: ClassVar[int]
    learning_rate: ClassVar[float]
    about: ClassVar[str]

    @abstractmethod
    def read(self, folder: Path, seed: int, network: Network) -> Any:
        """Reads the data to learn from, for a first network."""

    @abstractmethod
    def task(self, data: Any, first: Path, seed: int, variation: Variation) -> Task:
        """Prepares the training for the first network in a file."""

    def suits(self, data: Any) -> bool:
        """Returns whether a first network that is trained on these data can have such a second one."""
        return True


class Refiner(SecondStage):
    """Moves the sides of a detector's boxes."""

    kind, first = "refiner", "detector"
    epochs, batch, learning_rate = 8, 8, 1.5e-3
    about = """Train the refiner of a detector anew, on boxes that the detector finds in images of a folder.

    Best on images that the detector was not trained on. `dataflow train detector` and `pair` do this at their end; the
    detector itself stays as it is.

    Examples:

      dataflow train refiner out/mine.onnx DATA --out out/better.onnx
    """

    def read(self, folder: Path, seed: int, network: Network) -> DetectionData:
        from operators.detection.custom.folder import read_detection_data

        return read_detection_data(folder, seed).only(network.classes)

    def task(self, data: Any, first: Path, seed: int, variation: Variation) -> Task:
        from operators.detection.custom.refiner_training import RefinerTask

        return RefinerTask(data, first, seed=seed, variation=variation)


class Borders(SecondStage):
    """Decides again where classes meet."""

    kind, first = "borders", "segmenter"
    epochs, batch, learning_rate = 10, 16, 2e-3
    about = """Train a segmenter's second look at borders anew, on what the segmenter answers to images of a folder.

    Best on images that the segmenter was not trained on. `dataflow train segmenter` and `pair` do this at their end;
    the segmenter itself stays as it is.

    Examples:

      dataflow train borders out/segmenter.onnx DATA --out out/finer.onnx
    """

    def read(self, folder: Path, seed: int, network: Network) -> SegmentationData:
        from operators.segmentation.dataset import read_segmentation_data

        return read_segmentation_data(folder, seed)

    def task(self, data: Any, first: Path, seed: int, variation: Variation) -> Task:
        from operators.segmentation.border_training import BorderTask

        return BorderTask(data, first, seed=seed, variation=variation)

    def suits(self, data: Any) -> bool:
        from operators.segmentation.scores import MOST_CLASSES

        return len(data.classes) <= MOST_CLASSES


REFINER, BORDERS = Refiner(), Borders()


def train_second(second: SecondStage, data: Any, first: Path, options: ImageTraining, epochs: int) -> Outcome | None:
    """The last step of a first network's training: its second one, by so many passes; None without any."""
    if epochs == 0 or not second.suits(data):
        return None
    own = replace(options, epochs=epochs, batch=second.batch, learning_rate=second.learning_rate, bfloat16=False)
    return add_second(second.task(data, first, own.seed, own.changes), first, first, own)


def add_second(task: Task, first: Path, out: Path, options: ImageTraining) -> Outcome:
    """Trains a second network, and writes the file of the first with it to `out`, which may be the same.

    Beside `out` stays its checkpoint, `.refiner.pt` or `.borders.pt`, from which `resume` goes on where it is there;
    one of a training that had ended leaves `out` as it is.
    """
    from operators.learning.export import attach_second
    from operators.learning.files import TrainingFileError

    alone = out.with_suffix(f".{task.kind}.onnx")
    checkpoint = alone.with_suffix(".pt")
    outcome = replace(options, resume=options.resume and checkpoint.exists()).run(task, alone)
    if alone.exists():
        attach_second(first, alone, out)
        alone.unlink()
    elif not out.exists():
        raise TrainingFileError(f"the training of {checkpoint} has ended, and there is no {out}: give --overwrite")
    return outcome


def command_of(second: SecondStage) -> Callable[..., None]:
    """Makes the command that trains second networks of a kind alone."""

    @takes(ImageTraining, epochs=second.epochs, batch=second.batch, learning_rate=second.learning_rate)
    def train_alone(weights: First, data: Data, options: ImageTraining, out: Out = None) -> None:
        with friendly():
            out = weights if out is None else out
            written = (out, out.with_suffix(f".{second.kind}.pt"))
            options.keep_files([file for file in written if file != weights])
            from operators.weights import open_network

            network = open_network(weights, second.first)
            read = second.read(data, options.seed, network)
            tell_data(read, network.size, options.json)
            outcome = add_second(second.task(read, weights, options.seed, options.changes), weights, out, options)
        if options.json:
            typer.echo(jsonlib.dumps({"weights": str(out), second.kind: told_of(outcome)}))
        else:
            tell_scores(out, outcome)

    train_alone.__doc__ = second.about
    return train_alone
