"""From an image to the target's position in the camera frame, with its covariance."""

from vision.camera import Camera
from vision.detector import TargetDetector
from vision.fix import NoFix, VisionFix
from vision.target import RingTarget

__all__ = ["Camera", "NoFix", "RingTarget", "TargetDetector", "VisionFix"]
