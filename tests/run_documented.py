"""Run every command in the code blocks of README.md and docs/, and print how each of them ended.

``python tests/run_documented.py [PAGE ...] [--seconds 180] [--data FOLDER]`` copies the committed files to a temporary
folder and runs the commands of each page there, in order. A command that takes longer than ``--seconds`` is stopped and
counts as running. The exit status is 1 if a command failed.
"""

from __future__ import annotations

import argparse
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
BLOCK = re.compile(r"^```(\w*)[^\n]*\n(.*?)^```", re.MULTILINE | re.DOTALL)
SHELLS = ("", "sh", "bash", "console")  # languages of blocks with commands
COMMAND = re.compile(r"(?:\w+=\S+ )*(?:\.venv/bin/)?(?:imitarm|python|make|pip) ")
BEFORE = {
    "perception.md": ["imitarm learn pouring.npy --units cm --duration 10 --task pour --out pour.json"],
    "retargeting.md": [
        "imitarm capture synthetic:7 --seconds 20 --out wave.csv",
        "imitarm calibrate limbs wave.csv",
        "imitarm calibrate sensor pairs.csv",
        "imitarm calibrate clutch --robot panda --anchor shoulder --orientation upright",
        *(
            f"imitarm capture synthetic:7 --seconds 12 --out person_{i}.csv && imitarm retarget person_{i}.csv "
            f"--tool gripper --fit --out wave_{i}.csv"
            for i in (1, 2, 3)
        ),
    ],
}
"""Commands of other pages whose files a page uses."""
TOGETHER = {"transmission.md"}  # pages whose commands run at the same time, each in its own terminal
SKIPPED = re.compile(r"make (demo|test|quick|mediapipe|install)\b|pip install|imitarm teleoperate udp:")
"""Commands that install packages, or that ask a person at a terminal to enable the robot."""

SCENE = """\
format: imitarm-scene
version: 1
obstacles:
  - {type: sphere, name: ball, center: [0.75, 0.5, 0.3], radius: 0.05, velocity: [0, -0.05, 0]}
"""
"""A file that ``docs/chapter_5.md`` and ``docs/retargeting.md`` assume; the readers have their own."""


VIDEOS = ".cache/pose2sim"
START_GAP = 5.0  # [s] between commands that run at the same time
PAIRS = [(0.1, 0.2, 2.0), (0.4, -0.1, 2.1), (-0.2, 0.3, 1.8), (0.0, -0.3, 2.4), (0.3, 0.3, 2.2)]
"""Points in the sensor's frame; the base is 2.5 m away and faces the sensor."""


def commands(page: Path) -> Iterator[str]:
    """Yield the commands in the code blocks of ``page``, without their comments."""
    blocks = BLOCK.findall(page.read_text(encoding="utf-8"))
    for block in (text for language, text in blocks if language in SHELLS):
        for line in block.replace("\\\n", " ").splitlines():
            command = re.sub(r"\s+#.*", "", " ".join(line.split()))
            if COMMAND.match(command):
                yield command


def prepare(folder: Path, data: Path, environment: dict[str, str]) -> None:
    """Copy the committed files to ``folder``, and make the files that the pages assume."""
    archive = subprocess.run(["git", "archive", "HEAD"], cwd=ROOT, check=True, capture_output=True).stdout
    subprocess.run(["tar", "-x", "-C", str(folder)], input=archive, check=True)
    (folder / ".venv" / "bin").mkdir(parents=True)
    for program in ("python", "imitarm"):
        (folder / ".venv" / "bin" / program).symlink_to(Path(sys.executable).with_name(program))
    if (ROOT / ".cache").exists():
        (folder / ".cache").symlink_to(ROOT / ".cache")
    rows = [f"{x},{y},{z},{2.5 - z},{-x},{y + 1.0}" for x, y, z in PAIRS]
    names = "sensor_x,sensor_y,sensor_z,base_x,base_y,base_z"
    (folder / "pairs.csv").write_text("\n".join([names, *rows, ""]), encoding="utf-8")
    if not data.exists():
        return
    (folder / "recordings").symlink_to(data)
    for name in ("pouring", "letter_h", "bottle2shelf", "letter_e"):
        shutil.copy(data / "panda_kinesthetic" / f"{name}.npy", folder)
        if name == "pouring":
            continue  # the pages learn it
        learn = f"imitarm learn {name}.npy --units cm --duration 10 --task {name} --out {name}.json"
        subprocess.run(shlex.split(learn), cwd=folder, env=environment, check=True, capture_output=True)
    sweep = "imitarm learn src/imitarm/tasks/data/sweep --task sweep --out sweep.json"
    subprocess.run(shlex.split(sweep), cwd=folder, env=environment, check=True, capture_output=True)
    for name in ("moving", "cups"):
        (folder / f"{name}.yaml").write_text(SCENE, encoding="utf-8")


def run(together: list[str], folder: Path, environment: dict[str, str], seconds: float) -> Iterator[tuple[str, str]]:
    """Run commands at the same time; yield how each of them ended, and the last line that it printed."""
    outputs = [folder / f"output_{i}.txt" for i in range(len(together))]
    processes: list[subprocess.Popen[bytes] | None] = []
    began = time.monotonic()
    for command, output in zip(together, outputs, strict=True):
        if SKIPPED.match(command) or (VIDEOS in command and not (folder / VIDEOS).exists()):
            processes.append(None)
            continue
        time.sleep(START_GAP * (len(processes) > 0))
        with output.open("wb") as file:
            processes.append(
                subprocess.Popen(
                    command, shell=True, cwd=folder, env=environment, stdout=file, stderr=file, start_new_session=True
                )
            )
    for process, output in zip(processes, outputs, strict=True):
        if process is None:
            yield "skipped", "installs packages, asks a person, or needs the videos of 'make mediapipe'"
            continue
        status = ended(process, began + seconds)
        lines = [line.strip() for line in output.read_text(encoding="utf-8", errors="replace").split("\n")]
        last = next((line for line in reversed(lines) if line), "")
        word = "running" if status is None else "done" if status == 0 else f"FAILED ({status})"
        yield f"{word}, {time.monotonic() - began:.0f} s", last


def ended(process: subprocess.Popen[bytes], until: float) -> int | None:
    """Wait for a process, and stop it at the time ``until``; return its exit status, or None if it was stopped."""
    try:
        return process.wait(timeout=max(0.1, until - time.monotonic()))
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGTERM)
    try:
        process.wait(timeout=10.0)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    return None


def main() -> int:
    """Run the commands; return 1 if one failed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("pages", nargs="*", help="names such as README.md or skills.md; default: all")
    parser.add_argument("--seconds", type=float, default=180.0, help="longest time for one command")
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("IMITARM_DATA", ROOT.parent / "shared/data")))
    arguments = parser.parse_args()
    pages = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
    bad = 0
    for page in pages:
        if arguments.pages and page.name not in arguments.pages:
            continue
        if not list(commands(page)):
            continue
        with tempfile.TemporaryDirectory() as name:
            folder, data = Path(name) / "imitarm", arguments.data.resolve()
            folder.mkdir()
            (Path(name) / "shared").mkdir()
            (Path(name) / "shared" / "data").symlink_to(data)
            environment = os.environ | {"DATA": str(data), "MPLBACKEND": "Agg", "OMP_NUM_THREADS": "1"}
            environment["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{environment['PATH']}"
            prepare(folder, data, environment)
            for command in BEFORE.get(page.name, ()):
                subprocess.run(command, shell=True, cwd=folder, env=environment, check=True, capture_output=True)
            shown = list(commands(page))
            for group in [shown] if page.name in TOGETHER else [[command] for command in shown]:
                for command, (how, last) in zip(group, run(group, folder, environment, arguments.seconds), strict=True):
                    bad += "FAILED" in how
                    print(f"{page.name}\t{how}\t{command}\t{last[:160]}", flush=True)
    return int(bad > 0)


if __name__ == "__main__":
    raise SystemExit(main())
