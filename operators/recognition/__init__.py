"""Operators that say what an image or an object is, and describe it by a vector."""

from operators.recognition.feature_extractor import FeatureExtractor
from operators.recognition.image_classifier import ImageClassifier

__all__ = ["FeatureExtractor", "ImageClassifier"]
