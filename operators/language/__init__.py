"""Images and text in one space: the tokenizer and the two towers of networks such as CLIP."""
