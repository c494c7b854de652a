"""Tasks: complete simulated scenes, each with a test of success."""

from __future__ import annotations

from imitarm.tasks.open_box import OpenBoxTask
from imitarm.tasks.packing import PackingTask
from imitarm.tasks.packing_run import run_packing
from imitarm.tasks.pushed_cube import run_pushed_cube
from imitarm.tasks.stack import StackTask
from imitarm.tasks.sweep import DEMONSTRATIONS, MOVING_SCENES, NUMBERED_SCENES, SCENES, SweepTask

TASKS: dict[str, type[SweepTask] | type[StackTask] | type[OpenBoxTask] | type[PackingTask]] = {
    "open_box": OpenBoxTask,
    "packing": PackingTask,
    "stack": StackTask,
    "sweep": SweepTask,
}

__all__ = [
    "DEMONSTRATIONS",
    "MOVING_SCENES",
    "NUMBERED_SCENES",
    "SCENES",
    "TASKS",
    "OpenBoxTask",
    "PackingTask",
    "StackTask",
    "SweepTask",
    "run_packing",
    "run_pushed_cube",
]
