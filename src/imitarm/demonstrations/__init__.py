"""Demonstrations: read them, check them, align them.

``read`` converts files to :class:`~imitarm.trajectory.Demonstration` objects, ``lint`` lists their faults,
and ``align`` trims and re-times them so that a skill can be learned. File formats are in the registry ``READERS``.
"""

from imitarm.demonstrations.align import Alignment, align, compute_alignment
from imitarm.demonstrations.groups import group_by_path
from imitarm.demonstrations.lint import lint
from imitarm.demonstrations.raw import Finding, RawDemonstration
from imitarm.demonstrations.reading import READERS, Reader, ReadOptions, files_of, read, read_raw

__all__ = [
    "READERS",
    "Alignment",
    "Finding",
    "RawDemonstration",
    "ReadOptions",
    "Reader",
    "align",
    "compute_alignment",
    "files_of",
    "group_by_path",
    "lint",
    "read",
    "read_raw",
]
