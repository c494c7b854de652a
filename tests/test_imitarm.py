"""The public names."""

from __future__ import annotations

import subprocess
import sys

import imitarm
import imitarm.__main__


def test_every_public_name_exists():
    for name in imitarm.__all__:
        assert getattr(imitarm, name) is not None
    assert sorted(imitarm.__all__) == sorted(set(imitarm.__all__))
    assert set(imitarm.__all__) <= set(dir(imitarm))


def test_importing_imitarm_imports_no_heavy_package():
    code = "import sys, imitarm; print([m for m in ('numpy', 'scipy', 'mujoco', 'viser') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True, text=True)
    assert done.stdout.strip() == "[]"


def test_the_package_can_be_run_as_a_module():
    done = subprocess.run([sys.executable, "-m", "imitarm", "--version"], capture_output=True, check=True, text=True)
    assert done.stdout.strip() == f"imitarm {imitarm.__version__}"
