import numpy as np
import pytest
from scipy.interpolate import make_lsq_spline

from imitarm.errors import InputError
from imitarm.retarget.baselines.nurbs import NURBS, averaged_knots, bends, fit_nurbs

SIGMA = 0.01


def motion(n: int = 200) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A hand at 30 Hz with jitter: times, truth, and what a camera made of it."""
    rng = np.random.default_rng(4)
    t = 5.0 + np.cumsum(rng.uniform(0.028, 0.038, n))
    truth = 0.3 * np.column_stack([np.sin(1.1 * t), np.cos(1.7 * t), 0.3 * np.sin(2.3 * t)])
    return t, truth, truth + rng.normal(0.0, SIGMA, truth.shape)


def rms(difference: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(difference))))


def test_without_smoothing_it_is_the_weighted_spline_of_scipy():
    t, _, seen = motion()
    confidence = np.random.default_rng(1).uniform(0.1, 1.0, len(t))
    curve = fit_nurbs(t, seen, confidence, n_control=20, smoothing=0.0, robust=False)
    other = make_lsq_spline(t, seen, curve.knots, k=3, w=np.sqrt(confidence))
    np.testing.assert_allclose(curve.control_points, other.c, atol=1e-8)


def test_the_fit_is_the_minimum_of_its_cost():
    t, _, seen = motion(60)
    confidence = np.linspace(0.2, 1.0, 60)

    def cost(points: np.ndarray) -> float:
        away = NURBS(curve.knots, points, curve.weights).evaluate(t) - seen
        bent = np.einsum("ja,jad->jd", rows, np.stack([points[:-2], points[1:-1], points[2:]], axis=1))
        return float(confidence @ np.sum(away**2, axis=1) + 0.7 * np.sum(bent**2))

    curve = fit_nurbs(t, seen, confidence, smoothing=0.7, robust=False)
    rows = bends(curve.knots, curve.degree)
    best, rng = cost(curve.control_points), np.random.default_rng(2)
    for _ in range(20):
        assert cost(curve.control_points + rng.normal(0.0, 1e-4, curve.control_points.shape)) > best


def test_a_steady_motion_is_not_slowed_down_by_any_smoothing():
    t = np.cumsum(np.random.default_rng(0).uniform(0.02, 0.06, 18))
    line = np.outer(t, [0.5, -0.2, 0.1]) + [1.0, 2.0, 3.0]
    np.testing.assert_allclose(fit_nurbs(t, line, smoothing=100.0).evaluate(t), line, atol=1e-8)
    even = bends(np.arange(20.0), 3)
    np.testing.assert_allclose(even, np.tile([1.0, -2.0, 1.0], (len(even), 1)))  # where knots are uniform


def test_every_span_of_averaged_knots_holds_samples():
    t = np.sort(np.random.default_rng(0).uniform(0.0, 1.0, 40) ** 3)
    knots = averaged_knots(t, 13, 3)
    assert len(knots) == 13 + 3 + 1
    inside = np.histogram(t, bins=knots[3:-3])[0]
    assert inside.min() >= 1


@pytest.mark.parametrize("smoothing", ["gcv", "morozov"])
def test_noise_goes_and_the_motion_stays(smoothing):
    t, truth, seen = motion()
    curve = fit_nurbs(t, seen, smoothing=smoothing, sigma=SIGMA)
    assert rms(curve.evaluate(t) - truth) < 0.5 * SIGMA
    speed = np.gradient(truth, t, axis=0)
    assert rms((curve.derivative(t) - speed)[5:-5]) < 0.2 * rms(speed)
    if smoothing == "morozov":
        assert rms(curve.evaluate(t) - seen) == pytest.approx(SIGMA, rel=0.1)


def test_cross_validation_is_near_the_best_strength_there_is():
    t, truth, seen = motion()
    errors = [rms(fit_nurbs(t, seen, smoothing=10.0**k, robust=False).evaluate(t) - truth) for k in range(-4, 4)]
    assert rms(fit_nurbs(t, seen, smoothing="gcv", robust=False).evaluate(t) - truth) < 1.15 * min(errors)


def test_outliers_are_not_heard():
    t, truth, seen = motion()
    wild = np.arange(10, 200, 17)
    seen[wild] += 0.25
    error = {robust: rms(fit_nurbs(t, seen, smoothing=1.0, robust=robust).evaluate(t) - truth) for robust in (0, 1)}
    assert error[1] < 0.5 * error[0]
    assert error[1] < SIGMA


def test_what_is_lost_does_not_count_and_is_bridged():
    t, truth, seen = motion()
    confidence = np.ones(len(t))
    confidence[80:88] = 0.0
    seen[80:88] = np.nan
    curve = fit_nurbs(t, seen, confidence)
    assert rms((curve.evaluate(t) - truth)[80:88]) < 3.0 * SIGMA


def test_a_sample_that_is_hardly_believed_hardly_pulls():
    t, truth, seen = motion(40)
    seen = truth.copy()
    seen[20] += 0.1
    pull = []
    for c in (1.0, 0.2):
        confidence = np.ones(40)
        confidence[20] = c
        pull.append(rms(fit_nurbs(t, seen, confidence, smoothing=0.01, robust=False).evaluate(t) - truth))
    assert pull[1] < 0.5 * pull[0]


def test_rational_weights_find_an_arc_that_no_plain_curve_holds():
    arc = NURBS([0, 0, 0, 1, 1, 1], [[1, 0], [1, 1], [0, 1]], [1, np.sqrt(0.5), 1], 2)
    t = np.linspace(0.0, 1.0, 60)
    options = {"degree": 2, "n_control": 3, "smoothing": 0.0, "robust": False}
    points = arc.evaluate(t) + [0.4, -2.0]
    off = {
        rational: np.abs(
            np.linalg.norm(fit_nurbs(t, points, rational=rational, **options).evaluate(t) - [0.4, -2.0], axis=1) - 1.0
        ).max()
        for rational in (False, True)
    }
    assert off[True] < 1e-8
    assert off[False] > 0.01
    weights = fit_nurbs(t, points, rational=True, **options).weights
    assert weights[1] / weights[0] == pytest.approx(np.sqrt(0.5), rel=1e-6)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"times": [0.0, 0.1, 0.1, 0.2, 0.3]}, "strictly increasing"),
        ({"points": np.zeros((4, 3))}, "points"),
        ({"points": np.full((5, 3), np.nan)}, "finite where"),
        ({"confidence": [1, 1, 1, 0, 0]}, "needs 4 samples"),
        ({"confidence": [1, 1, 1, 1, 2]}, "between 0 and 1"),
        ({"smoothing": "strong"}, "one of"),
        ({"smoothing": -1.0}, "negative"),
        ({"smoothing": "morozov"}, "needs sigma"),
        ({"sigma": 0.0}, "sigma must be positive"),
        ({"n_control": 9}, "n_control must be 4 to 5"),
        ({"degree": 1}, "at least 2"),
    ],
)
def test_what_can_not_be_fitted_is_refused(change, match):
    given = {"times": np.linspace(0.0, 0.4, 5), "points": np.zeros((5, 3))} | change
    with pytest.raises(InputError, match=match):
        fit_nurbs(given.pop("times"), given.pop("points"), **given)
