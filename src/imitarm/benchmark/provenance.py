"""Determine the version of the running code: the Git commit of a checkout, or the version of the installed package."""

from __future__ import annotations

import hashlib
import subprocess
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path

import imitarm

_PACKAGE = Path(imitarm.__file__).parent


@lru_cache(maxsize=1)
def code_version() -> str:
    """Return the version of the running code as text. The version is determined only once per process.

    In a Git checkout, the version is the last commit that changed the package. Commits that change only documentation
    or tests do not matter. If the package has uncommitted changes, the version also contains a hash of these changes.
    Therefore two different states of the code never have the same version.

    Returns:
        ``"commit 0123456789"`` or ``"commit 0123456789 with uncommitted changes 01234567"`` in a Git checkout;
        otherwise ``"version 0.1.0"``.
    """
    return version_of(_PACKAGE, f"version {imitarm.__version__}")


def version_of(package: Path, installed: str) -> str:
    """Return the version of the code in a folder, see :func:`code_version`.

    Args:
        package: folder of the package, which contains ``__init__.py``.
        installed: text to return when the folder is not in a Git repository.
    """
    if _git(package, "ls-files", "--error-unmatch", "__init__.py") is None:
        return installed  # also for an environment that lies inside somebody's repository
    commit = (_git(package, "log", "-1", "--format=%h", "--abbrev=10", "--", ".") or b"").decode().strip()
    if not commit:
        return installed
    changes = _git(package, "diff", "HEAD", "--no-ext-diff", "--no-color", "--binary", "--", ".") or b""
    new = (_git(package, "ls-files", "--others", "--exclude-standard", "-z", "--", ".") or b"").split(b"\0")
    for name in sorted(filter(None, new)):
        changes += name + b"\0" + (package / name.decode()).read_bytes()
    mark = hashlib.sha256(changes).hexdigest()[:8]
    return f"commit {commit} with uncommitted changes {mark}" if changes else f"commit {commit}"


def origin(versions: Iterable[str]) -> str:
    """Return a text that names the versions of the code that made the results.

    It says whether the running code differs.

    Args:
        versions: version of the code for each result, see :func:`code_version`.
    """
    found, now = sorted(set(versions)), code_version()
    if found == [now]:
        return f"Results of {now}."
    text = f"Results of {' and '.join(found) or 'no run'}"
    changed = f"Another version of the code made these tables ({now})"
    return f"{text}. {changed}. Run the command again to update the results."


def _git(folder: Path, *words: str) -> bytes | None:
    """Return what a Git command prints; None if the command fails or Git is not installed."""
    try:
        done = subprocess.run(["git", "-C", folder, *words], capture_output=True, check=False, timeout=60)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout if done.returncode == 0 else None
