"""Operators that say what an image or an object is, describe it by a vector, or say what an agent does."""

from operators.recognition.activity.recognizer import ActivityRecognizer
from operators.recognition.feature_extractor import FeatureExtractor
from operators.recognition.feature_memory import FeatureMemory
from operators.recognition.image_classifier import ImageClassifier
from operators.recognition.objects.learned_detector import LearnedDetector
from operators.recognition.posture.recognizer import PostureRecognizer
from operators.recognition.posture.skeleton_posture import SkeletonPosture

__all__ = [
    "ActivityRecognizer",
    "FeatureExtractor",
    "FeatureMemory",
    "ImageClassifier",
    "LearnedDetector",
    "PostureRecognizer",
    "SkeletonPosture",
]
