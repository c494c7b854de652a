"""What the tests of MediaPipe share: a person as landmarks, a Python that plays the worker, the real videos."""

from __future__ import annotations

import math
import os
import stat
import sys
from functools import cache
from pathlib import Path

import numpy as np

from imitarm.capture.mediapipe import FIELD_OF_VIEW, N_LANDMARKS, PoseLandmarks
from imitarm.capture.recording import SkeletonRecording
from imitarm.capture.sources import open_source

VIDEOS = Path(__file__).resolve().parents[1] / ".cache" / "pose2sim"
SIZE = (1280, 720)


def standing() -> np.ndarray:
    """A person who faces the camera, arms a little bent and away from the body: MediaPipe's axes, (33, 3) [m]."""
    points = np.zeros((N_LANDMARKS, 3))
    sided = {
        11: (0.18, -0.50, 0.0),
        13: (0.30, -0.25, 0.05),
        15: (0.35, -0.10, -0.15),
        17: (0.38, -0.05, -0.22),
        19: (0.35, -0.05, -0.24),
        21: (0.32, -0.08, -0.20),
        23: (0.10, 0.0, 0.0),
        25: (0.11, 0.42, 0.0),
        27: (0.11, 0.82, 0.05),
        29: (0.11, 0.86, 0.08),
        31: (0.13, 0.88, -0.10),
        7: (0.08, -0.72, 0.0),
        1: (0.02, -0.76, -0.1),
        2: (0.03, -0.76, -0.1),
        3: (0.04, -0.76, -0.1),
        9: (0.03, -0.66, -0.1),
    }
    for left, (x, y, z) in sided.items():
        right = {1: 4, 2: 5, 3: 6}.get(left, left + 1)
        points[left], points[right] = (x, y, z), (-x, y, z)  # a person's left is on the picture's right
    points[0] = (0.0, -0.70, -0.12)
    return points


def seen(points, place, *, time=0.0, size=SIZE, field_of_view=FIELD_OF_VIEW, visibility=1.0):
    """PoseLandmarks of points about the hips (33, 3), standing at a place (3,), as a true camera would show them."""
    at = np.asarray(points) + place
    focal = 0.5 * max(size) / math.tan(math.radians(0.5 * field_of_view))
    image = at[:, :2] / at[:, 2:] * focal / np.array(size) + 0.5
    axis = np.array(place) / np.linalg.norm(place)
    side = np.cross([0.0, 0.0, 1.0], axis)
    cos, sin = axis[2], np.linalg.norm(side)
    if sin > 0.0:
        x, y, z = side / sin
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        turn = np.eye(3) + sin * cross + (1.0 - cos) * cross @ cross
    else:
        turn = np.eye(3)
    return PoseLandmarks(time, np.asarray(points) @ turn, image, np.full(N_LANDMARKS, visibility))


def line(landmarks: PoseLandmarks) -> str:
    """A line of the worker."""
    each = np.column_stack([landmarks.world, landmarks.image, landmarks.visibility])
    return f"frame {landmarks.time:.6f} " + " ".join(f"{number:.6f}" for number in each.ravel())


def player(folder: Path, program: str) -> Path:
    """A program that stands in for MediaPipe's Python: gets the worker's arguments, does what the test says."""
    path = folder / "python"
    path.write_text(f"#!{sys.executable}\nimport os, signal, sys, time\n{program}\n", encoding="utf-8")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return path


def alive(pid: int) -> bool:
    """Whether a process is there, zombies included."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


@cache
def video_recording(view):
    """The recording that MediaPipe makes of one of the videos; the tests that share it are in the group "video"."""
    with open_source(f"video:{VIDEOS / f'cam0{view}.mp4'}") as source:
        return SkeletonRecording(list(source), name=source.name)
