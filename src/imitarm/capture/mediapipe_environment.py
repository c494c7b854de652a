"""Where MediaPipe is: an environment of its own, found or made.

MediaPipe 0.10.21, the last version that brings its models along, needs numpy below 2; imitarm needs numpy 2. So it
lives in another environment, which need not know imitarm::

    python -m imitarm.capture.mediapipe_environment            # makes it where imitarm looks for it
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

from imitarm.errors import ImitarmError, InputError, TaskFailedError

VARIABLE = "IMITARM_MEDIAPIPE_PYTHON"
"""Environment variable that names the Python that has MediaPipe; it goes before every folder."""

VERSION = "0.10.21"
VERSIONS = ((3, 9), (3, 12))  # of Python, for which that version exists
REQUIREMENTS = (
    "numpy<2",
    "opencv-python-headless>=4.9,<4.12",  # headless: no libGL; the next one needs numpy 2
    "protobuf>=4.25.3,<5",
    "absl-py",
    "attrs>=19.1",
    "flatbuffers>=2.0",
    "matplotlib",
)
"""What tracking a pose needs. MediaPipe also names jax, sentencepiece and sounddevice, which are for other tasks, and
an OpenCV with windows; it is installed without its own list."""

_STAMP = "imitarm-mediapipe.txt"  # is written last: without it the environment is half made
_COMMAND = "-m imitarm.capture.mediapipe_environment"
_TRIAL = "import cv2, mediapipe; mediapipe.solutions.pose.Pose(model_complexity=1).close()"


def find_python() -> Path:
    """Return the Python that has MediaPipe: the one that ``IMITARM_MEDIAPIPE_PYTHON`` names, else of a folder.

    Raises:
        InputError: when there is none; the message says how to make it.
    """
    named = os.environ.get(VARIABLE)
    if named:
        if not Path(named).is_file():
            raise InputError(f"{VARIABLE} names {named}, which is no file; name a Python that has mediapipe {VERSION}")
        return Path(named)
    for folder in folders():
        if (folder / _STAMP).is_file():
            return python_of(folder)
    raise InputError(
        f"video and webcam need MediaPipe in an environment of its own; make it, once: '{sys.executable} {_COMMAND}' "
        f"(130 MB to fetch, 410 MB on disk), or let {VARIABLE} name a Python that has mediapipe {VERSION}"
    )


def folders() -> list[Path]:
    """Return where it is looked for, and made in the first: beside a checkout, then where a user's own data are."""
    checkout = Path(__file__).resolve().parents[3]
    beside = [checkout / ".venv-mediapipe"] if (checkout / "pyproject.toml").is_file() else []
    if sys.platform == "win32":
        data = Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    elif sys.platform == "darwin":
        data = Path.home() / "Library" / "Application Support"
    else:
        data = Path(os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share")
    return [*beside, data / "imitarm" / "mediapipe"]


def python_of(folder: Path) -> Path:
    """Return the Python of a virtual environment."""
    return folder / "Scripts" / "python.exe" if sys.platform == "win32" else folder / "bin" / "python"


def make(folder: Path) -> Path:
    """Make the environment, anew if it is there; return its Python.

    Args:
        folder: to make; nothing else may be in it.

    Raises:
        InputError: when the folder holds something else, or this machine has no Python that fits.
        TaskFailedError: when a step of it fails; the message ends with what that step said.
    """
    if folder.exists() and any(folder.iterdir()) and not (folder / "pyvenv.cfg").is_file():
        raise InputError(f"{folder}: is there and is no environment of Python; name a new folder")
    python = python_of(folder)
    (folder / _STAMP).unlink(missing_ok=True)
    _run("make an environment", [fitting_python(), "-m", "venv", "--clear", str(folder)])
    install = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    _run("fetch mediapipe", [*install, "--no-deps", f"mediapipe=={VERSION}"])
    _run("fetch what mediapipe needs", [*install, *REQUIREMENTS])
    _run("start mediapipe", [str(python), "-I", "-c", _TRIAL])
    (folder / _STAMP).write_text(f"mediapipe {VERSION}, made by imitarm\n", encoding="utf-8")
    return python


def fitting_python() -> str:
    """Return a Python for which MediaPipe exists: this one, else one on the path.

    Raises:
        InputError: when there is none.
    """
    (major, oldest), (_, newest) = VERSIONS
    if VERSIONS[0] <= sys.version_info[:2] <= VERSIONS[1]:
        return sys.executable
    for minor in range(newest, oldest - 1, -1):
        found = shutil.which(f"python{major}.{minor}")
        if found:
            return found
    raise InputError(
        f"mediapipe {VERSION} exists for Python {major}.{oldest} to {major}.{newest}; this is "
        f"{sys.version_info[0]}.{sys.version_info[1]} and none of these is on the path; install one, or let {VARIABLE} "
        "name a Python that has mediapipe"
    )


def _run(what: str, command: list[str]) -> None:
    done = subprocess.run(command, check=False, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    if done.returncode:
        said = " ".join(done.stdout.split())[-600:]
        raise TaskFailedError(f"mediapipe: could not {what} (exit status {done.returncode}): {said}")


def main(arguments: list[str]) -> int:
    """Make the environment in the folder that is named, else where imitarm looks for it; return the exit status."""
    folder = Path(arguments[0]) if arguments else folders()[0]
    try:
        sys.stdout.write(f"made {make(folder)}\n")
    except ImitarmError as error:
        sys.stderr.write(f"error: {error}\n")
        return error.exit_status
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
