"""The contract of a Retargeter: one abstract method; engagement, stop and run are the same for all."""

import numpy as np
import pytest

from imitarm import ArmModel
from imitarm.errors import InputError
from imitarm.retarget import RETARGETERS, Correspondence, LimbLengths, ModernRetargeter, Retargeter
from imitarm.retarget.engagement import EngagementState
from shown_arm import LENGTHS, shown, swing

ARM = ArmModel.load("sawyer", tool="gripper")
FIXED = Correspondence(lengths=LENGTHS, orientation="fixed")
FRAMES = shown(swing(0, 0.5, start=1.0, over=3.0), 5.0)


class Damped(Retargeter):
    """The whole of a method."""

    def _advance(self, goal, measured):
        q = self.latest.q
        if goal is None:
            return q
        jacobian = self.arm.tool_jacobian(q)
        error = self.arm.tool_pose(q).error_to(goal.target)
        return q + 0.2 * jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + 1e-3 * np.eye(6), error)


class Recorded(Damped):
    name, title, caption = "recorded", "Recorded", "Notes what it is asked for."

    def __init__(self, *args, **options):
        self.calls = []
        super().__init__(*args, **options)

    def _begin(self):
        self.calls.append("begin")

    def _rest_at(self, q):
        self.calls.append(("rest", tuple(q)))

    def _advance(self, goal, measured):
        self.calls.append(goal)
        return super()._advance(goal, measured)


def test_one_method_makes_a_retargeter_that_follows_the_hand():
    run = Damped(ARM, FIXED).run(FRAMES)
    engaged = int(np.argmax(run.engaged))
    assert 0.5 <= run.times[engaged] <= 0.55
    assert np.ptp(run.joints[:engaged], axis=0).max() == 0.0
    away = np.linalg.norm(ARM.tool_path(run.joints)[0] - run.targets[0], axis=1)[engaged:]
    assert np.ptp(run.targets[0][engaged:], axis=0).max() > 0.1
    assert away.max() < 0.05
    np.testing.assert_allclose(run.velocities[1:], np.diff(run.joints, axis=0) / 0.01, atol=1e-12)


def test_without_that_method_there_is_no_retargeter():
    with pytest.raises(TypeError, match="_advance"):
        Retargeter(ARM)


def test_the_constructor_calls_nothing_of_the_subclass():
    retargeter = Recorded(ARM, FIXED)
    assert retargeter.calls == []
    np.testing.assert_array_equal(retargeter.latest.q, ARM.home)
    retargeter.step(None, ARM.home)  # starts at home by itself
    assert retargeter.calls == ["begin", ("rest", tuple(ARM.home)), None]


def test_a_subclass_is_another_method_and_has_its_own_name():
    assert (Damped.name, Damped.title, Damped.caption) == ("Damped", "Damped", "")
    assert (Recorded.name, Recorded.title) == ("recorded", "Recorded")
    assert type("Mine", (ModernRetargeter,), {}).name == "Mine"


@pytest.mark.parametrize("name", ["modern", "thesis", "m1", "m2", "m3"])
def test_every_built_in_method_has_a_title_and_a_caption_and_uses_the_shared_step(name):
    method = RETARGETERS[name]
    assert method.name == name
    assert method.title and method.caption.endswith(".")
    assert method.step is Retargeter.step


def test_a_goal_says_whether_its_frame_is_fresh_and_how_old_it_is():
    retargeter = Recorded(ARM, FIXED)
    retargeter.run(FRAMES)
    goals = [goal for goal in retargeter.calls[2:] if goal is not None]
    assert goals[0].fresh and goals[0].age == 0.0
    assert all(goal.fresh == (goal.age == 0.0) for goal in goals)
    assert 0.2 < np.mean([goal.fresh for goal in goals]) < 0.45  # 30 frames in 100 steps
    assert {goal.state for goal in goals} == {EngagementState.FOLLOWING}


@pytest.mark.parametrize("name", ["modern", "thesis", "m1", "m2", "m3"])
def test_an_arm_that_is_moved_by_hand_while_nobody_leads_stays_where_it_is_put(name):
    retargeter, q = RETARGETERS[name](ARM, FIXED), ARM.home + 0.2
    for _ in range(20):
        np.testing.assert_allclose(retargeter.step(None, q), q, atol=1e-12)
    assert not retargeter.latest.velocity.any()


@pytest.mark.parametrize("name", ["modern", "m1", "m2", "m3"])
def test_a_stopped_arm_that_is_moved_by_hand_stays_where_it_is_put_too(name):
    retargeter, q = RETARGETERS[name](ARM, FIXED), ARM.home
    for k in range(100):
        q = retargeter.step(FRAMES[k // 3] if k % 3 == 0 else None, q)
    for _ in range(200):
        q = retargeter.step(None, q)
    assert retargeter.latest.state is EngagementState.STOPPED
    moved = np.clip(q + 0.2, ARM.lower, ARM.upper)
    for _ in range(20):
        np.testing.assert_allclose(retargeter.step(None, moved), moved, atol=1e-12)


def test_a_control_period_out_of_range_is_refused():
    with pytest.raises(InputError, match="Damped: dt must be a finite number"):
        Damped(ARM, dt=0.1)


WRONG = [np.nan, np.inf, -1.0, "x", [1, 2], np.zeros(3), np.full(7, np.nan), object()]


@pytest.mark.parametrize("value", WRONG, ids=lambda value: repr(value).split(" at 0x")[0])
@pytest.mark.parametrize(
    "call",
    [
        *(lambda v, name=name: Correspondence(**{name: v}) for name in ("side", "scale", "orientation", "lengths")),
        lambda v: Correspondence(sensor_to_base=v),
        *(lambda v, name=name: LimbLengths(0.3, 0.3, **{name: v}) for name in ("spread", "n_frames")),
        *(
            lambda v, name=name: ModernRetargeter(ARM, **{name: v})
            for name in ("correspondence", "dt", "scene", "gain", "lead", "rotation_length", "elbow", "max_speed")
        ),
        ModernRetargeter,
        *(
            lambda v, name=name: RETARGETERS["thesis"](ARM, **{name: v})
            for name in ("gain", "max_speed", "iterations", "lag", "as_printed", "smoothing", "small_angle")
        ),
        *(
            lambda v, name=name: RETARGETERS["m1"](ARM, **{name: v})
            for name in ("annotation_time", "seed", "constraints", "velocity_scaling", "relative")
        ),
        lambda v: RETARGETERS["m3"](ARM, gain=v),
        lambda v: Damped(ARM).start(v),
        lambda v: Damped(ARM).step(v, ARM.home),
        lambda v: Damped(ARM).step(None, v),
        lambda v: Damped(ARM).run(v),
    ],
)
def test_what_is_not_usable_is_refused(call, value):
    if isinstance(value, list) and getattr(call, "__defaults__", None) == ("spread",):
        call(value)  # two numbers are a spread
        return
    with pytest.raises(InputError):
        call(value)
