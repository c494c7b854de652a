"""How a person becomes numbers: skeletons, and the sources they come from."""

from imitarm.capture.skeleton import Arm, HandState, Skeleton, SkeletonSource, Tracking

__all__ = ["Arm", "HandState", "Skeleton", "SkeletonSource", "Tracking"]
