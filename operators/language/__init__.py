"""Images and text in one space: the tokenizer and the two towers of networks such as CLIP."""

from typing import TYPE_CHECKING

from dataflow.lazy import lazily

if TYPE_CHECKING:
    from operators.language.bpe import Tokenizer
    from operators.language.image_tower import ImageTower
    from operators.language.text_tower import TextTower
else:
    __getattr__, __dir__ = lazily(
        __name__, {"bpe": ("Tokenizer",), "image_tower": ("ImageTower",), "text_tower": ("TextTower",)}
    )

__all__ = ["ImageTower", "TextTower", "Tokenizer"]
