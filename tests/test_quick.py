"""What `make quick` chooses."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import quick

FILES = {
    "src/imitarm/__init__.py": "",
    "src/imitarm/__init__.pyi": "from .low.arm import Arm\n",
    "src/imitarm/low/__init__.py": "",
    "src/imitarm/low/arm.py": "class Arm: ...\n",
    "src/imitarm/low/models.xml": "<arm/>",
    "src/imitarm/high.py": "from imitarm.low.arm import Arm\n",
    "src/imitarm/registry.py": "MEMBERS = {'high': 'imitarm.high:High'}\n",
    "tests/samples.py": "import imitarm.high\n",
    "tests/test_arm.py": "from imitarm import Arm\n",
    "tests/test_face.py": "import imitarm\nimitarm.Arm\n",
    "tests/test_high.py": "from samples import x\n",
    "tests/test_registry.py": "from imitarm.registry import MEMBERS\n",
    "tests/test_docs.py": "",
    "tests/test_alone.py": "import json\n",
    "docs/page.md": "",
}


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    for name, text in FILES.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return tmp_path


@pytest.mark.parametrize(
    ("changed", "near"),
    [
        ("src/imitarm/low/arm.py", {"test_arm.py": 1, "test_face.py": 1, "test_high.py": 3, "test_registry.py": 3}),
        ("src/imitarm/low/models.xml", {"test_arm.py": 1, "test_face.py": 1, "test_high.py": 3, "test_registry.py": 3}),
        ("src/imitarm/high.py", {"test_high.py": 2, "test_registry.py": 2}),
        ("tests/samples.py", {"test_high.py": 1}),
        ("tests/test_alone.py", {"test_alone.py": 0}),
        ("docs/page.md", {"test_docs.py": 0}),
    ],
)
def test_a_test_is_as_near_as_the_imports_between(tree: Path, changed: str, near: dict[str, int]) -> None:
    found = quick.distances([tree / changed], tree)
    assert {path.name: n for path, n in found.items()} == near


def test_every_module_of_the_package_is_reached_by_a_test() -> None:
    packages = [path for path in (quick.ROOT / "src").rglob("*.py") if path.name != "__init__.py"]
    unreached = [path.name for path in packages if not quick.distances([path])]
    assert unreached == []


def test_a_change_of_c_code_is_compiled_and_reaches_its_tests(monkeypatch, capsys) -> None:
    source, run = quick.ROOT / "src/imitarm/compiled/candidates.c", []
    found = {path.name for path in quick.distances([source])}
    assert {path.name for path in (quick.ROOT / "tests").glob("test_*compiled*.py")} <= found
    monkeypatch.setattr(quick, "changed_files", lambda _: [source])
    monkeypatch.setattr(quick, "build", lambda: run.append("build") or "built it")
    monkeypatch.setattr(pytest, "main", lambda *_, **__: run.append("tests") or 0)
    monkeypatch.setattr(sys, "argv", ["quick.py"])
    assert quick.main() == 0
    assert run == ["build", "tests"] and capsys.readouterr().out == "built it\n"


def test_a_failure_counts_and_time_ends_the_run(tmp_path: Path) -> None:
    (tmp_path / "test_a.py").write_text(
        "def test_a():\n    assert 0\n\ndef test_b():\n    pass\n\ndef test_c():\n    pass\n"
    )
    script = (
        "import sys, pytest; sys.path.insert(0, sys.argv[1]); import quick; from pathlib import Path\n"
        "path = Path(sys.argv[2]); nearest = quick.Nearest({path: 0}, 0.0)\n"
        "pytest.main(['-q', '-p', 'no:cacheprovider', '-k', 'not test_c', str(path)], plugins=[nearest])\n"
        "assert nearest.failed and nearest.stopped and nearest.left == 1\n"
    )
    words = [sys.executable, "-c", script, str(quick.ROOT / "tests"), str(tmp_path / "test_a.py")]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "1 tests that are farther away were not run" in done.stdout
