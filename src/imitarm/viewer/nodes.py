"""What drawing in viser's scene needs everywhere: names, colours under its lights, and things that move."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

STEP: Final = 2.0**-13  # [m], [-] poses are rounded to this (0.12 mm): a file of round numbers is a third as large
_EXPOSURE: Final = 0.7


class Mover:
    """Something drawn that changes from frame to frame.

    Args:
        handle: of viser.
        poses: what changes, by viser's names, frame by frame: ``position``, ``wxyz``, ..., or ``visible`` (n_frames,).
    """

    def __init__(self, handle: Any, poses: Mapping[str, NDArray[Any]]) -> None:
        self._handle, self._poses = handle, poses
        self._changed = {
            name: np.any(values[1:] != values[:-1], axis=tuple(range(1, values.ndim))).tolist()
            for name, values in poses.items()
        }

    def show(self, frame: int) -> None:
        """Send the poses of a frame, not the first, where they differ from the frame before."""
        for name, values in self._poses.items():
            if self._changed[name][frame - 1]:
                setattr(self._handle, name, bool(values[frame]) if values.ndim == 1 else values[frame])


def node_name(kind: str, *names: object) -> str:
    """Return a name for viser's tree, where a slash means a child and would split a body's name."""
    return f"/{kind}/" + " ".join(str(name).replace("/", "|") for name in names)


def lit(rgba: Sequence[float], *, linear: bool = False) -> tuple[float, float, float]:
    """Return the colour that looks like ``rgba`` under viser's lights, which are brighter than MuJoCo's.

    Batches take ``linear`` light where meshes take sRGB.
    """
    srgb = np.asarray(rgba[:3], dtype=float)
    light = _EXPOSURE * np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    shown = light if linear else np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return float(shown[0]), float(shown[1]), float(shown[2])
