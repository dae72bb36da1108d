"""A class, and perhaps an instance, for every pixel."""

from __future__ import annotations

from dataflow.messages.arrays import F32, I32, U8, U16
from dataflow.messages.base import ANCHOR, Message, MessageError, array, scalar
from dataflow.messages.checks import not_empty, within
from dataflow.messages.detection import CLASS_NAMES
from dataflow.messages.display import pictures
from dataflow.messages.display.pictures import Picture


class SegmentationMap(Message):
    """Class of every pixel of an image (semantic), and its instance where known (panoptic)."""

    frame: str = scalar("str", "optical frame of the camera", default=ANCHOR)
    class_names: tuple[str, ...] = scalar("strs", CLASS_NAMES, default=())
    void: int | None = scalar("int", "class id of pixels without a class (255 in many data sets)", default=None)
    classes: U8 | U16 = array("uint8|uint16", "H W", "class id of each pixel, an index into `class_names` or `void`")
    instances: U16 | I32 | None = array(
        "uint16|int32", "H W", "instance of each pixel, unique over all classes, 0 for none", default=None
    )
    confidence: F32 | None = array(
        "float32", "H W", "confidence in the class, [0, 1]; NaN where not known", default=None
    )

    def validate(self) -> None:
        not_empty(self, "classes")
        count = len(self.class_names)
        if count and self.classes.size and self.classes.max() >= count:
            wrong = self.classes[(self.classes >= count)]
            wrong = wrong if self.void is None else wrong[wrong != self.void]
            if wrong.size:
                raise MessageError(
                    f"SegmentationMap.classes must index class_names, which has {count} entries, or be void "
                    f"({self.void}), got {wrong[0]} in {wrong.size} pixels"
                )
        within(self, 0.0, 1.0, "confidence", nan=True)

    def _picture(self) -> Picture | None:
        return pictures.of_classes(self.classes)
