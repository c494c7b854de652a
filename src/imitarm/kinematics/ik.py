r"""Inverse kinematics, one control step at a time: from tasks and limits to the velocity of the joints.

:func:`solve_ik` combines :mod:`tasks <imitarm.kinematics.tasks>` (what the joints should do) with :mod:`limits
<imitarm.kinematics.limits>` (what they must not exceed). For a control loop, use :class:`IKSolver`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import daqp
import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.compiled import library
from imitarm.compiled.kernels import address
from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.damped_ik import damped_least_squares, damped_with_small_angle, filtered_svd
from imitarm.kinematics.ik_problem import Box, IKProblem, Rows, TaskRows
from imitarm.kinematics.least_violation import least_violation
from imitarm.kinematics.limits import JointLimits, Limit
from imitarm.kinematics.tasks import PostureTask, Task, TwistTask
from imitarm.validation import choice, finite_number, finite_vector, instance, sequence

Array = NDArray[np.float64]

_MAX_SPEED = {"dls": 0.6, "dls_small_angle": 0.6, "qp": 2.0, "svd": 0.6}  # [m/s] clamp of a weighted twist
_NULL = 1e-12  # squared singular values below this belong to directions in which the arm can't move
_EFFORT, _CHANGE = 1e-5, 1e-6  # "qp": weights of the joint velocity and of its change beside a task of weight 1
_TINY_ROW = 1e-6
_ROUNDING = 1e-8  # [rad/s]
_VIOLATED = 1e-9
_KEPT = 1e-10  # [rad/s] a limit that is violated by less is kept
_FLOAT64 = np.dtype(np.float64)


@dataclass(frozen=True, eq=False)
class IKStep:
    """The result of one step of inverse kinematics and its remaining errors.

    Attributes:
        velocity: velocity of the joints, shape (n_joints,) [rad/s].
        missing: target velocity minus achieved velocity of each task, in the weighted units of the task.
        limited: whether each joint velocity is at a bound of the box, boolean array, shape (n_joints,).
        slack: violation of each row (inequality on the joint velocity), shape (m,); 0 where the row is satisfied.
    """

    velocity: Array
    missing: tuple[Array, ...]
    limited: NDArray[np.bool_]
    slack: Array


class IKSolver:
    r"""Inverse kinematics of one arm for a control loop; arguments that stay the same are checked only once.

    The method ``"qp"`` minimises the following cost over the joint velocity v inside every
    :class:`~imitarm.kinematics.limits.Box`:

    .. math:: \sum_i \tfrac12 |J_i v - t_i|^2 + \tfrac{\mu}2 |v|^2 + \tfrac{w_a}2 |v - v_p|^2
              + \sum_j \tfrac{c_j}2 \max(0, b_j - A_j v)^2 / |A_j|^2

    Here, each task has a Jacobian :math:`J_i` and a target :math:`t_i`, and :math:`v_p` is the joint velocity of the
    previous step. The rows :math:`A_j v \ge b_j` have the prices (penalty weights) :math:`c_j`. A row with an infinite
    price is a hard constraint. The solver keeps this constraint whenever the boxes allow it. If the boxes contradict
    the hard constraints, the solver first minimises the sum of the squared violations. The violation of row j is
    :math:`(b_j - A_j v) / |A_j|` [rad/s]. The tasks then have second priority. The methods ``"dls"``,
    ``"dls_small_angle"`` and ``"svd"`` accept one :class:`~imitarm.kinematics.tasks.TwistTask` and optionally one
    :class:`~imitarm.kinematics.tasks.PostureTask`. These methods accept no limits except boxes:

    * ``"dls"``, damped least squares (thesis Eq 3.8 and 3.9), computes :math:`v = J^T (J J^T+\lambda^2)^{-1} t` with
      each joint's velocity measured in units of its limit. Let :math:`s_{min}` be the smallest singular value of J, and
      :math:`d=|t|`. There is no damping (:math:`\lambda=0`) if :math:`s_{min}\ge d`. The damping is
      :math:`\lambda^2=s_{min}(d-s_{min})` if :math:`d/2\le s_{min}<d`, and :math:`\lambda=d/2` if :math:`s_{min}` is
      smaller. This damping keeps the norm of the scaled velocity at most 1.
    * ``"dls_small_angle"`` is like ``"dls"``, but d is reduced by half of the smallest singular value, as the thesis
      prints after Eq 3.9. The smaller d weakens the damping; the method is kept for comparison.
    * ``"svd"``, numerical filtering (Maciejewski and Klein 1988), damps only the directions whose singular value
      :math:`s_i` is below 0.06. With the singular vectors :math:`u_i` and :math:`v_i`, the velocity is :math:`v=\sum_i
      s_i/(s_i^2+\lambda_i^2)\, v_i u_i^T t`. The damping is :math:`\lambda_i^2=0.06^2(1-(s_i/0.06)^2)` if
      :math:`s_i<0.06`, and 0 otherwise.

    These three methods scale the whole velocity down when a joint would be too fast, then clip it to the box. A solver
    keeps no state between steps and can be used by several threads.

    Args:
        arm: the arm.
        limits: limits to keep in every step; None: only the arm's :class:`~imitarm.kinematics.limits.JointLimits`.
        dt: length of the control step [s].
        method: ``"qp"``, ``"dls"``, ``"dls_small_angle"`` or ``"svd"``.

    Raises:
        UnknownNameError: when the method is not known.
        InputError: when ``dt`` is not a positive time, or a method other than ``"qp"`` is given soft limits.
    """

    def __init__(
        self, arm: ArmModel, limits: Sequence[Limit] | None = None, *, dt: float = 0.01, method: str = "qp"
    ) -> None:
        choice(method, METHODS, "IK method")
        self.arm, self.method = instance(arm, ArmModel, "IKSolver: arm"), method
        self.dt = finite_number(dt, "IKSolver: dt", "s", above=0.0)
        self.limits: tuple[Limit, ...] = (
            (JointLimits(arm),) if limits is None else sequence(limits, Limit, "IKSolver: limits")  # type: ignore[type-abstract]
        )
        if method != "qp" and any(limit.soft for limit in self.limits):
            soft = ", ".join(type(limit).__name__ for limit in self.limits if limit.soft)
            raise InputError(f"IKSolver: method {method!r} can't keep {soft}; use method='qp', or leave this limit out")
        self._solve = METHODS[method]
        self._max_speed = _MAX_SPEED[method]
        self._scaled = method.startswith("dls")
        self._free = Box(-arm.max_velocity, arm.max_velocity)

    def solve(
        self,
        q: ArrayLike,
        tasks: Task | Sequence[Task],
        *,
        velocity: ArrayLike | None = None,
        rows: Rows | Sequence[Rows] | None = None,
    ) -> Array:
        """Return the joint velocity, shape (n_joints,) [rad/s].

        Args:
            q: joint positions, shape (n_joints,) [rad].
            tasks: one or more tasks; the first task must be for the tool.
            velocity: joint velocity of the previous step, shape (n_joints,) [rad/s]; needed for the acceleration
                limits.
            rows: additional inequalities in this step, only for ``"qp"``.

        Raises:
            InputError: when a shape is wrong, a number is not finite, or the method does not accept these tasks or
                rows.
        """
        return self._solve(self.problem(q, tasks, velocity, rows))

    def step(
        self,
        q: ArrayLike,
        tasks: Task | Sequence[Task],
        *,
        velocity: ArrayLike | None = None,
        rows: Rows | Sequence[Rows] | None = None,
    ) -> IKStep:
        """Solve like :meth:`solve`, with the same arguments and errors, and also return the remaining errors."""
        problem = self.problem(q, tasks, velocity=velocity, rows=rows)
        result = self._solve(problem)
        counted = result / self.arm.max_velocity if self._scaled else result
        missing = tuple(part.target - part.jacobian @ counted for part in problem.tasks)
        near = 1e-6 * self.arm.max_velocity
        limited = (result >= problem.box.upper - near) | (result <= problem.box.lower + near)
        slack = [np.maximum(0.0, part.lower - part.matrix @ result) for part in problem.rows]
        return IKStep(result, missing, limited, np.concatenate(slack) if slack else np.zeros(0))

    def problem(
        self,
        q: ArrayLike,
        tasks: Task | Sequence[Task],
        velocity: ArrayLike | None = None,
        rows: Rows | Sequence[Rows] | None = None,
    ) -> IKProblem:
        """Return the problem that the methods solve; arguments and errors are those of :meth:`solve`."""
        arm = self.arm
        memory = arm.at(q)
        position = q if type(q) is np.ndarray and q.dtype is _FLOAT64 else np.asarray(q, dtype=float)
        previous = None if velocity is None else finite_vector(velocity, arm.n_joints, "solve_ik: velocity", "rad/s")
        free = self._free
        problem = IKProblem(arm, memory, position, previous, self.dt, free, [], [], self._max_speed, self._scaled)
        first: Task
        others: Sequence[Task]
        if isinstance(tasks, list) or type(tasks) is tuple:  # a NamedTuple is one task
            if not tasks:
                raise InputError("solve_ik: needs at least one task, for example TwistTask(twist)")
            first, others = tasks[0], tasks[1:]
        else:
            first, others = tasks, ()  # type: ignore[assignment]
        if type(first) is TwistTask:  # it needs no box, and tells the limits whether anything is to move
            problem.tasks.append(first.rows(problem))
        else:
            others = (first, *others)
        for limit in self.limits:
            part = limit.restrict(problem)
            if part is None:
                continue
            if isinstance(part, Rows):
                problem.rows.append(part)
            elif problem.box is free:
                problem.box = part
            else:
                lower, upper = problem.box
                problem.box = Box(np.maximum(lower, part.lower), np.minimum(upper, part.upper))
        if others:
            self._add_tasks(problem, others)
        if rows is not None:
            problem.rows += self._checked_rows(rows)
        return problem

    def _add_tasks(self, problem: IKProblem, tasks: Sequence[Task]) -> None:
        """Add the rows of further tasks."""
        for task in tasks:
            if not hasattr(task, "rows"):
                raise InputError(f"solve_ik: each task must be an object such as TwistTask(twist), got {task!r}")
            if self.method != "qp":
                if not (isinstance(task, PostureTask) and problem.tasks) or problem.posture is not None:
                    raise InputError(
                        f"solve_ik: method {self.method!r} takes one TwistTask and optionally a PostureTask after it, "
                        f"got {type(task).__name__}; use method='qp'"
                    )
                problem.posture = task.drift(problem)
                continue
            wanted = task.rows(problem)
            if wanted is not None:
                problem.tasks.append(wanted)
        if not problem.tasks:
            raise InputError("solve_ik: none of the tasks sets a velocity; put a TwistTask first")

    def _checked_rows(self, rows: Rows | Sequence[Rows]) -> list[Rows]:
        given: Sequence[Rows] = (rows,) if isinstance(rows, Rows) else rows
        checked = []
        n = self.arm.n_joints
        if not isinstance(given, list | tuple):
            raise InputError(f"solve_ik: rows must be Rows(matrix, lower) or several of them, got {rows!r}")
        if self.method != "qp" and len(given):
            raise InputError(f"solve_ik: method {self.method!r} can't keep rows; use method='qp'")
        for part in given:
            if not isinstance(part, Rows):
                raise InputError(f"solve_ik: rows must be Rows(matrix, lower) or several of them, got {rows!r}")
            try:
                matrix, lower = np.asarray(part.matrix, dtype=float), np.asarray(part.lower, dtype=float)
                fits = lower.ndim == 1 and matrix.shape == (len(lower), n) and part.price > 0.0
            except (TypeError, ValueError) as error:
                raise InputError(f"solve_ik: rows must be arrays of numbers, with a price above 0: {error}") from error
            if not fits:
                raise InputError(
                    f"solve_ik: rows need shapes (m, {n}) and (m,) and a price above 0, "
                    f"got {matrix.shape}, {lower.shape} and {part.price}"
                )
            flat = matrix.ravel()
            if not math.isfinite(flat.dot(flat) + lower.dot(lower)):  # sums of squares: finite only if every number is
                raise InputError("solve_ik: rows must be finite numbers")
            if len(lower):
                usual = matrix is part.matrix and lower is part.lower
                checked.append(part if usual else Rows(matrix, lower, part.price))
        return checked


def solve_ik(
    arm: ArmModel,
    q: ArrayLike,
    tasks: Task | Sequence[Task],
    *,
    limits: Sequence[Limit] | None = None,
    dt: float = 0.01,
    method: str = "qp",
    velocity: ArrayLike | None = None,
    rows: Rows | Sequence[Rows] | None = None,
) -> Array:
    """Return the joint velocity that fulfils the tasks as far as the limits allow.

    ``solve_ik(arm, q, TwistTask([0.1, 0, 0, 0, 0, 0]))`` moves the tool at 0.1 m/s along x. :class:`IKSolver` explains
    the methods. Use :class:`IKSolver` itself in a control loop.

    Args:
        arm: the arm.
        q: joint positions, shape (n_joints,) [rad].
        tasks: one or more tasks; the first task must be for the tool.
        limits: limits to keep; None: position, velocity and acceleration limits of the joints.
        dt: length of the control step [s].
        method: ``"qp"``, ``"dls"``, ``"dls_small_angle"`` or ``"svd"``.
        velocity: joint velocity of the previous step, shape (n_joints,) [rad/s]; needed for the acceleration limits.
        rows: additional inequalities in this step, only for ``"qp"``.

    Returns:
        Joint velocity, shape (n_joints,) [rad/s].

    Raises:
        UnknownNameError: when the method is not known.
        InputError: when a shape is wrong, a number is not finite, or the method does not accept these tasks, limits or
            rows.
    """
    try:
        solver = _solver(arm, dt, method) if limits is None else IKSolver(arm, limits, dt=dt, method=method)
    except TypeError:  # not hashable: let the constructor say what is wrong
        solver = IKSolver(arm, limits, dt=dt, method=method)
    return solver.solve(q, tasks, velocity=velocity, rows=rows)


@lru_cache(maxsize=32)
def _solver(arm: ArmModel, dt: float, method: str) -> IKSolver:
    return IKSolver(arm, dt=dt, method=method)


def quadratic_program(problem: IKProblem) -> Array:
    """Minimise the weighted error of the tasks subject to the box and the rows."""
    jacobian, target, thrift = problem.tasks[0]
    if len(problem.tasks) > 1:
        jacobian, target = _stacked(problem.tasks)
    matrix, least, light = _sorted_rows(problem.rows) if problem.rows else (None, None, ())
    if not light:
        found = _compiled(problem, jacobian, target, thrift, matrix, least)
        if found is not None:
            return found
    hessian = jacobian.T.dot(jacobian)
    linear = target.dot(jacobian)
    effort = _EFFORT
    if problem.velocity is not None:
        effort += _CHANGE
        linear += (thrift * _CHANGE) * problem.velocity
    hessian += _scaled_eye(len(linear), thrift * effort)
    velocity = _least_cost(problem.box, matrix, least, hessian, linear)
    for rows in light:  # a price is convex: where it is paid at all it stands in full
        active = rows.matrix.dot(velocity) < rows.lower - _VIOLATED
        if True in active.tolist():  # for a few rows in a tenth of the time that any() takes
            part = rows.matrix[active]
            weighted = rows.price / np.einsum("ij,ij->i", part, part)[:, None] * part
            hessian += weighted.T.dot(part)
            linear += rows.lower[active].dot(weighted)
            velocity = _least_cost(problem.box, matrix, least, hessian, linear)
    return velocity


def _compiled(
    problem: IKProblem, jacobian: Array, target: Array, thrift: float, matrix: Array | None, least: Array | None
) -> Array | None:
    """Return the minimum that compiled code finds; None if it finds none, or without this code."""
    kernel = library()
    if kernel is None:
        return None
    velocity, n = np.empty(problem.arm.n_joints), problem.arm.n_joints
    before = None if problem.velocity is None else problem.velocity.tobytes()
    rows = (0, None, None) if matrix is None or least is None else (len(least), matrix.tobytes(), least.tobytes())
    places = jacobian.tobytes(), target.tobytes(), thrift * _EFFORT, thrift * _CHANGE, before
    box = problem.box.lower.tobytes(), problem.box.upper.tobytes()
    failed = kernel.least_cost_velocity(n, len(target), *places, *box, *rows, address(velocity))
    return None if failed else velocity


def _stacked(tasks: list[TaskRows]) -> tuple[Array, Array]:
    """Return the stacked Jacobians and targets of all tasks; filling an array is twice as fast as concatenating."""
    end, (m, n) = 0, tasks[0].jacobian.shape
    for part in tasks[1:]:
        m += len(part.target)
    jacobian, target = np.empty((m, n)), np.empty(m)
    for part in tasks:
        start, end = end, end + len(part.target)
        jacobian[start:end], target[start:end] = part.jacobian, part.target
    return jacobian, target


def _sorted_rows(rows: list[Rows]) -> tuple[Array | None, Array | None, Sequence[Rows]]:
    """Return the matrix and the bounds of all hard rows (infinite price), and the list of rows with a finite price."""
    if len(rows) == 1 and rows[0].price == math.inf:
        return rows[0].matrix, rows[0].lower, ()
    stiff = [part for part in rows if part.price == math.inf]
    light = [part for part in rows if part.price < math.inf]
    if not stiff:
        return None, None, light
    if len(stiff) == 1:
        return stiff[0].matrix, stiff[0].lower, light
    matrix = np.concatenate([part.matrix for part in stiff])
    return matrix, np.concatenate([part.lower for part in stiff]), light


def _least_cost(box: Box, matrix: Array | None, least: Array | None, hessian: Array, linear: Array) -> Array:
    """Minimise v^T H v / 2 - f^T v exactly, subject to the box and the rows."""
    free = _unconstrained(box, matrix, least, hessian, linear)
    if free is not None:
        return free
    n = len(linear)
    if matrix is None or least is None:
        matrix, least = np.empty((0, n)), box.lower[:0]
        lower, upper = box.lower.copy(), box.upper.copy()  # daqp takes none that is read-only
    else:
        lower, upper = np.empty(n + len(least)), np.empty(n + len(least))
        lower[:n], lower[n:], upper[:n], upper[n:] = box.lower, least, box.upper, 1e30
    velocity, _, status, _ = daqp.solve(hessian, -linear, matrix, upper, lower, _plain(len(lower)), primal_tol=_KEPT)
    if status <= 0 and len(least):
        lengths = np.sqrt(np.einsum("ij,ij->i", matrix, matrix))
        moved = lengths > _TINY_ROW  # no velocity changes the other rows
        matrix, least, lengths = matrix[moved], least[moved], lengths[moved]
        nearest = least_violation(box, matrix / lengths[:, None], least / lengths)
        reached = np.minimum(least, matrix @ nearest - _ROUNDING * lengths)
        lower, upper = np.append(box.lower, reached), np.append(box.upper, np.full(len(reached), 1e30))
        velocity, _, status, _ = daqp.solve(
            hessian, -linear, matrix, upper, lower, _plain(len(lower)), primal_tol=_KEPT
        )
        if status <= 0:
            velocity, status = nearest, 1
    if status <= 0:  # only lost digits can bring us here, since the box is never empty, and standing is safe
        velocity = np.zeros(n)
    velocity = np.maximum(velocity, box.lower)
    return np.minimum(velocity, box.upper, out=velocity)


def _unconstrained(box: Box, matrix: Array | None, least: Array | None, hessian: Array, linear: Array) -> Array | None:
    """Return the unconstrained minimum if it keeps all limits, as it does in most steps; None otherwise."""
    factor, velocity = hessian.copy(), np.empty(len(linear))
    if mujoco.mju_cholFactor(factor, _NULL) < len(linear):
        return None
    mujoco.mju_cholSolve(velocity, factor, linear)
    for low, value, high in zip(box.lower.tolist(), velocity.tolist(), box.upper.tolist(), strict=True):
        if not low <= value <= high:
            return None
    if matrix is not None and True in (matrix.dot(velocity) < least).tolist():
        return None
    return velocity


@lru_cache(maxsize=64)
def _scaled_eye(n: int, factor: float) -> Array:
    return factor * np.eye(n)


def _plain(n: int) -> NDArray[np.intc]:
    """Return flags for n plain inequalities, for the solver daqp; daqp writes into this array."""
    return np.zeros(n, dtype=np.intc)


METHODS: Mapping[str, Callable[[IKProblem], Array]] = {
    "dls": damped_least_squares,
    "dls_small_angle": damped_with_small_angle,
    "qp": quadratic_program,
    "svd": filtered_svd,
}
"""All methods of :func:`solve_ik`."""
