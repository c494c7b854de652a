"""The benchmark of avoidance among moving obstacles: an experiment tests one method in one scene with one sensor.

``MovingExperiment("M1", 3, 2000, "rcamo").run()`` makes a scene of family M1 and runs the method ``rcamo`` in this
scene. The method knows the obstacles only from a tracker. The benchmark measures the motion with the true obstacles.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from imitarm.benchmark.arm_oracle import ORACLES, ArmOracle
from imitarm.benchmark.moving_arm import OBSERVERS, ROBOTS, arm_case, prepared, required, run_arm
from imitarm.benchmark.moving_controls import CONTROLS, control
from imitarm.benchmark.moving_measures import OUTCOMES, SUCCESSES, measured
from imitarm.benchmark.moving_scenes import FAMILIES, MovingCase, moving_case
from imitarm.benchmark.moving_world import ToolRun, run_tool
from imitarm.benchmark.provenance import code_version
from imitarm.control_loop.observer import SensorModel, TrackedScene
from imitarm.errors import ImitarmError, InputError, UnknownNameError
from imitarm.perception import ObstacleTracker
from imitarm.policies import POLICIES, Policy

Options = tuple[tuple[str, float | str], ...]

OURS = ("rcamo", "rcamo-certified")
"""Our methods."""
WORLDS = ("tool", *ROBOTS)
"""The worlds in which a method can be tested: a tool that moves without an arm, and two simulated arms."""
_PLAN_JOINTS = ("rrt-connect", "rrt-connect-tilt", "rcamo-certified")  # these need an arm
_PLAN_ONCE = ("elastic-band", "tp-gmm")  # the first plans once; the second differs from gmm-dmp at other ends only


def method_names(world: str = "tool") -> tuple[str, ...]:
    """Return the names of all methods that can run in a world; first come the methods that check the benchmark."""
    if world == "tool":
        return (*CONTROLS, *(name for name in POLICIES if name not in _PLAN_JOINTS))
    return (CONTROLS[0], *ORACLES, *POLICIES)


def default_methods(world: str = "tool") -> tuple[str, ...]:
    """Return the names of the methods that the command compares by default."""
    if world != "tool":
        return (CONTROLS[0], *OURS, "acfra", "dmp-potential", "barrier", "modulation")
    return tuple(name for name in method_names() if name not in _PLAN_ONCE)


def build(method: str, case: MovingCase, options: Options = (), world: str = "tool") -> Policy:
    """Return the policy of a method for a scene.

    Raises:
        UnknownNameError: when there is no such method.
        InputError: when the method does not take an option.
    """
    if method not in method_names(world):
        raise UnknownNameError.among("method", method, method_names(world))
    known: dict[str, Any] = {
        "tool_spheres": case.tool_spheres,
        "clearance": case.clearance,
        "forbidden": case.forbidden,
        **dict(options),
    }
    if world != "tool":
        arm = prepared(world)[1]
        known.update(arm=arm, tool_spheres=arm.tool_spheres)
        if method in ORACLES:
            return ArmOracle(case.skill, case.truth, prepared(world)[2], tracked=method == ORACLES[1], **known)
    if method in CONTROLS:
        return control(method, case, **known)
    return POLICIES[method].build(case.skill, **known)


@dataclass(frozen=True)
class MovingExperiment:
    """The definition of one run: one method in one scene with one sensor.

    Another process or machine can run it, because it contains only text and numbers.

    Attributes:
        family: one of :data:`~imitarm.benchmark.moving_scenes.FAMILIES`.
        dimension: 2 if the method may displace the path only horizontally; 3 if every direction is allowed.
        seed: seed of the scene and of the sensor's errors.
        method: one of :func:`method_names`.
        options: names and values of options that replace the defaults of the method.
        world: one of :data:`WORLDS`. A world with an arm needs ``dimension`` 3.
        noise: standard deviation of a measured position (:class:`~imitarm.control_loop.SensorModel`) [m].
        rate: rate of the sensor [Hz].
        latency: time from a measurement until the tracker receives it [s].
        dropout: probability that the sensor misses an obstacle in a frame.
        occlusions: mean number of occlusions of an obstacle per second [1/s].
        observer: one of :data:`~imitarm.benchmark.moving_arm.OBSERVERS`. A camera needs a world with an arm; the five
            numbers of the sensor must then have their default values, because the camera has its own noise and rate.

    Raises:
        UnknownNameError: when family or method is not known.
        InputError: when a number is out of range.
    """

    family: str
    dimension: int
    seed: int
    method: str = "rcamo"
    options: Options = ()
    world: str = "tool"
    noise: float = 0.005
    rate: float = 30.0
    latency: float = 0.033
    dropout: float = 0.0
    occlusions: float = 0.0
    observer: str = OBSERVERS[0]

    def __post_init__(self) -> None:
        if self.family not in FAMILIES:
            raise UnknownNameError.among("family", self.family, FAMILIES)
        if self.dimension not in (2, 3) or self.seed < 0:
            raise InputError(
                f"MovingExperiment: dimension must be 2 or 3 and seed at least 0, got {self.dimension} and {self.seed}"
            )
        if self.world not in WORLDS:
            raise UnknownNameError.among("world", self.world, WORLDS)
        if self.world != "tool" and self.dimension != 3:
            raise InputError(f"MovingExperiment: the world {self.world!r} needs dimension 3, got {self.dimension}")
        if self.method not in method_names(self.world):
            raise UnknownNameError.among(f"method in the world {self.world!r}", self.method, method_names(self.world))
        sensor = self.sensor  # its checks
        if self.observer not in OBSERVERS:
            raise UnknownNameError.among("observer", self.observer, OBSERVERS)
        if self.observer == "camera" and self.world == "tool":
            raise InputError(f"MovingExperiment: a camera needs one of the worlds {', '.join(ROBOTS)}, got 'tool'")
        if self.observer == "camera" and sensor != SensorModel(latency=0.033, seed=self.seed):
            raise InputError("MovingExperiment: noise, rate, latency, dropout and occlusions don't apply to a camera")
        object.__setattr__(self, "options", tuple(sorted((str(k), v) for k, v in self.options)))

    @property
    def sensor(self) -> SensorModel:
        """The simulated sensor."""
        return SensorModel(self.noise, self.rate, self.latency, self.dropout, self.occlusions, seed=self.seed)

    @property
    def scene(self) -> tuple[str, int, int]:
        """The key of the scene; experiments of different methods in the same scene have the same key."""
        return self.family, self.dimension, self.seed

    @property
    def setting(self) -> str:
        """The world, and the camera if there is one; results of one setting are compared with each other."""
        return self.world if self.observer == OBSERVERS[0] else f"{self.world} with a {self.observer}"

    def case(self) -> MovingCase:
        """Return the scene."""
        if self.world != "tool":
            return arm_case(self.world, self.family, self.seed)
        return moving_case(self.family, self.dimension, self.seed)

    def moved(self) -> tuple[MovingCase, ToolRun]:
        """Run the method with a tool without an arm; return the scene and the motion."""
        case = self.case()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of numerical methods in hard scenes: the motion is measured anyway
            observe = TrackedScene(case.truth, self.sensor, ObstacleTracker("imm", rotations=True))
            return case, run_tool(build(self.method, case, self.options), case, observe)

    def run(self) -> MovingResult:
        """Run the method in its scene, and measure the motion.

        Returns:
            The result. If the method raises an error, the outcome is "failed", and the reason contains the error.
        """
        values: dict[str, Any] = {}
        try:
            if self.world == "tool":
                case, run = self.moved()
                found, reason, values = measured(case, run)
            else:
                case = self.case()
                known = replace(case, clearance=required(case, self.observer))
                policy = build(self.method, known, self.options, self.world)
                found, reason, values = run_arm(policy, case, self.world, self.sensor, self.observer)
            values["n_obstacles"] = len(case.truth.scene.obstacles)
            values["touched"] = case.touched
        except (ImitarmError, ArithmeticError, ValueError, TypeError, LookupError, np.linalg.LinAlgError) as error:
            found, reason = "failed", f"{type(error).__name__}: {error}"
        return MovingResult(self, code_version(), found, reason, values)


@dataclass(frozen=True, eq=False)
class MovingResult:
    """The result of an experiment, as plain values.

    Attributes:
        experiment: the experiment that was run.
        code: version of the code that ran, see :func:`~imitarm.benchmark.provenance.code_version`.
        outcome: one of :data:`~imitarm.benchmark.moving_measures.OUTCOMES`.
        reason: explanation of the outcome; empty after a success.
        values: measures by name, see :func:`~imitarm.benchmark.moving_measures.measured`. Two further values are
            ``n_obstacles``, and ``touched``, the time at which the learned motion without avoidance touches an obstacle
            [s].
    """

    experiment: MovingExperiment
    code: str
    outcome: str
    reason: str
    values: Mapping[str, Any]

    def __post_init__(self) -> None:
        if self.outcome not in OUTCOMES:
            raise UnknownNameError.among("outcome", self.outcome, OUTCOMES)

    @property
    def success(self) -> bool:
        """Whether the tool (or arm) touched nothing and reached the goal in time."""
        return self.outcome in SUCCESSES

    def value(self, name: str) -> float:
        """Return the measure with this name; nan when it is unknown."""
        found = self.values.get(name)
        return math.nan if found is None else float(found)


def run_experiment(experiment: MovingExperiment) -> MovingResult:
    """Run an experiment; a function for worker processes."""
    return experiment.run()
