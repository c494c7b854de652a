import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from imitarm import InputError
from imitarm.capture.person import Person, _hand_along
from imitarm.capture.skeleton import HandState

PEOPLE = [Person.from_seed(seed) for seed in range(10)]
finite = st.floats(-2.0, 2.0)


@settings(max_examples=150, deadline=None)
@given(
    st.sampled_from(PEOPLE),
    st.tuples(finite, finite, finite),
    st.floats(0.0, 100.0),
    st.sampled_from(["left", "right"]),
)
def test_bones_have_their_lengths_wherever_the_hand_goes(person, offset, time, side):
    truth = person.skeleton(time, person.shoulder(side) + np.array(offset), side=side)
    for each in ("left", "right"):
        arm = truth.arm(each)
        assert np.linalg.norm(arm.elbow - arm.shoulder) == pytest.approx(person.upper_arm, abs=1e-9)
        assert np.linalg.norm(arm.wrist - arm.elbow) == pytest.approx(person.forearm, abs=1e-9)


def test_the_wrist_is_where_it_was_wanted_within_reach_and_stops_at_it():
    person = PEOPLE[0]
    near = person.shoulder("right", 2.0) + np.array([0.1, -0.2, -0.3])
    assert np.linalg.norm(person.skeleton(2.0, near).arm().wrist - near) < 4e-3  # the tremor
    far = person.shoulder("right", 2.0) + np.array([0.0, 0.0, -2.0])
    arm = person.skeleton(2.0, far).arm()
    assert np.linalg.norm(arm.wrist - arm.shoulder) == pytest.approx(person.reach, abs=1e-9)


def test_a_person_stands_upright_and_faces_the_sensor():
    for person in PEOPLE:
        truth = person.skeleton(0.0, person.shoulder("right") + np.array([0.1, -0.3, -0.3]))
        assert truth.joint("head")[1] > truth.joint("spine_base")[1] > truth.joint("foot_left")[1]
        assert truth.joint("shoulder_right")[0] > truth.joint("shoulder_left")[0]
        assert truth.joint("spine_base")[2] > 1.9
        assert truth.joint("elbow_right")[1] < truth.joint("shoulder_right")[1]


def test_people_differ_within_bounds_and_one_seed_is_one_person():
    lengths = np.array([[p.upper_arm, p.forearm] for p in map(Person.from_seed, range(200))])
    stature = np.array([Person.from_seed(seed).stature for seed in range(200)])
    share = lengths / stature[:, None] / [0.186, 0.146]
    assert np.abs(share - 1.0).max() <= 0.15 + 1e-12
    assert lengths.std(axis=0).min() > 0.01
    again, person = Person.from_seed(3), PEOPLE[3]
    assert np.array_equal(
        again.skeleton(1.0, [0.3, 0.0, 2.0]).positions, person.skeleton(1.0, [0.3, 0.0, 2.0]).positions
    )


def test_swivel_turns_the_elbow_about_the_line_to_the_wrist():
    person = PEOPLE[1]
    s, w = np.zeros(3), np.array([0.0, 0.0, -0.4])
    down, at = person.elbow(s, w, 0.0)
    out, _ = person.elbow(s, w, np.pi / 2)
    np.testing.assert_allclose(at, w)
    assert down[1] < 0.0
    assert abs(down[0]) < 1e-12
    assert out[0] > 0.0  # outwards is to larger x for the right arm of somebody who faces the sensor
    assert abs(out[1]) < 1e-12


unit = st.floats(-1.0, 1.0)


@given(st.tuples(unit, unit, unit), st.tuples(unit, unit, unit))
def test_elbow_and_hand_never_jump(to, step):
    """A millimetre of the wrist's way moves the elbow, and the thumb, by millimetres: but for an arm straight back."""
    person = PEOPLE[4]
    way = 0.75 * person.reach * np.array(to) / max(np.linalg.norm(to), 1e-3)
    assume(np.linalg.norm(way) > 0.2)
    near = way + 1e-3 * np.array(step)
    one, other = (person.skeleton(0.0, person.shoulder("right") + w).arm().points for w in (way, near))
    back = (one[1:3] - one[:2]) @ [0.0, 0.0, 1.0] / np.linalg.norm(one[1:3] - one[:2], axis=1)
    assume(max(*back, way[2] / np.linalg.norm(way)) < 0.8)
    assert np.linalg.norm(other - one, axis=1).max() < 0.015


def test_the_hand_of_a_raised_forearm_goes_on_as_that_of_one_that_points_forward():
    person, thumbs = PEOPLE[4], []
    for angle in np.linspace(-0.45 * np.pi, 0.6 * np.pi, 60):  # from hanging over forward to behind the vertical
        rotation = _hand_along(np.array([0.0, np.sin(angle), -np.cos(angle)]))
        np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-12)
        thumbs.append(rotation[:, 1])
        np.testing.assert_allclose(thumbs[-1], [0.0, np.cos(angle), np.sin(angle)], atol=1e-12)
    assert person.skeleton(0.0, person.shoulder("right") + [0.0, 0.0, -0.4]).arm().points[5, 1] > 0.0


def test_the_elbow_of_a_hanging_arm_is_behind_it_and_of_a_raised_one_before_it():
    person = PEOPLE[5]
    for up, before in ((-1.0, False), (1.0, True)):
        elbow, _ = person.elbow(np.zeros(3), np.array([0.0, 0.45 * up, 0.0]), 0.0)
        assert (elbow[2] < -0.02) == before
        assert before or elbow[2] > 0.02


def test_a_given_hand_and_fist_are_shown():
    person = PEOPLE[2]
    rotation = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    truth = person.skeleton(0.0, person.shoulder("right") + [0.0, -0.2, -0.3], hand=rotation, closed=True)
    arm = truth.arm("right")
    way = arm.points[4] - arm.wrist
    np.testing.assert_allclose(way / np.linalg.norm(way), rotation[:, 0], atol=1e-12)
    assert arm.hand_state is HandState.CLOSED
    assert truth.hand_states[0] is HandState.OPEN


def test_a_wrist_nowhere_is_refused():
    with pytest.raises(InputError, match="wrist"):
        PEOPLE[0].skeleton(0.0, [np.nan, 0.0, 0.0])


@pytest.mark.parametrize(
    "options",
    [
        {"swivel": np.inf},
        {"hand": np.eye(2)},
        {"hand": 2.0 * np.eye(3)},
        {"hand": np.diag([1.0, 1.0, -1.0])},
        {"hand": np.full((3, 3), np.nan)},
        {"side": "middle"},
    ],
)
def test_impossible_arms_are_refused(options):
    with pytest.raises(InputError, match=f"Person.skeleton: {next(iter(options))}|unknown side"):
        PEOPLE[0].skeleton(0.0, [0.3, 0.0, 2.0], **options)


def test_a_hand_trembles_by_up_to_a_millimetre_and_the_body_sways():
    for person in PEOPLE[:4]:
        shoulder = np.array([person.shoulder("right", t) for t in np.arange(0.0, 30.0, 0.05)])
        assert 0.001 < np.ptp(shoulder[:, [0, 2]], axis=0).max() < 0.010
        wanted = person.shoulder("right") + [0.0, -0.1, -0.35]
        shake = np.array([person.skeleton(t, wanted).arm().wrist - wanted for t in np.arange(0.0, 4.0, 0.01)])
        assert 0.0003 < np.linalg.norm(shake, axis=1).max() < 0.0016
        power = np.square(np.abs(np.fft.rfft(shake - shake.mean(axis=0), axis=0))).sum(axis=1)
        hertz = np.fft.rfftfreq(len(shake), 0.01)
        assert power[(hertz > 3.5) & (hertz < 9.5)].sum() > 0.95 * power.sum()
