import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import BSpline

from imitarm.errors import InputError
from imitarm.retarget.baselines.nurbs import NURBS, basis_functions

CIRCLE = NURBS([0, 0, 0, 1, 1, 1], [[1, 0], [1, 1], [0, 1]], [1, np.sqrt(0.5), 1], 2)  # a quarter of one


def random_curve(seed: int, *, rational: bool = False) -> NURBS:
    rng = np.random.default_rng(seed)
    degree, n = int(rng.integers(1, 5)), int(rng.integers(6, 12))
    inner = np.sort(rng.uniform(0.0, 2.0, n - degree - 1))
    knots = np.concatenate([np.zeros(degree + 1), inner, np.full(degree + 1, 2.0)])
    weights = rng.uniform(0.2, 5.0, n) if rational else np.ones(n)
    return NURBS(knots, rng.normal(size=(n, 3)), weights, degree)


@given(st.integers(0, 2**32 - 1))
def test_without_weights_it_is_the_spline_of_scipy(seed):
    curve = random_curve(seed)
    spline = BSpline(curve.knots, curve.control_points, curve.degree)
    u = np.linspace(0.0, 2.0, 57)
    np.testing.assert_allclose(curve.evaluate(u), spline(u), atol=1e-12)
    np.testing.assert_allclose(curve.derivative(u), spline.derivative()(u), rtol=1e-9, atol=1e-9)


@given(st.integers(0, 2**32 - 1))
def test_basis_functions_sum_to_one_are_not_negative_and_few(seed):
    curve = random_curve(seed)
    first, values = basis_functions(curve.knots, curve.degree, np.linspace(0.0, 2.0, 40))
    np.testing.assert_allclose(values.sum(axis=1), 1.0)
    assert values.min() >= 0.0
    assert first.min() >= 0
    assert first.max() + curve.degree < len(curve.control_points)


def recursive(knots, i, p, u, last=lambda i: i + 1):
    """Thesis Eq 3.7 word by word, with 0/0 = 0; ``last`` is the index of the knot that ends function i of order 0."""
    if p == 0:
        end = min(last(i), len(knots) - 1)
        return 1.0 if knots[i] <= u < knots[end] else 0.0

    def share(top, bottom):
        return top / bottom if bottom > 0.0 else 0.0

    return share(u - knots[i], knots[i + p] - knots[i]) * recursive(knots, i, p - 1, u, last) + share(
        knots[i + p + 1] - u, knots[i + p + 1] - knots[i + 1]
    ) * recursive(knots, i + 1, p - 1, u, last)


def test_equation_3_7_corrected_is_what_is_computed_and_as_printed_is_no_basis():
    knots, degree, n = np.array([0, 0, 0, 0, 0.3, 0.5, 0.8, 1, 1, 1, 1.0]), 3, 7
    worst = 0.0
    for u in np.linspace(0.0, 0.999, 41):
        first, values = basis_functions(knots, degree, [u])
        dense = np.zeros(n)
        dense[first[0] : first[0] + degree + 1] = values[0]
        np.testing.assert_allclose([recursive(knots, i, degree, u) for i in range(n)], dense, atol=1e-12)
        printed = [recursive(knots, i, degree, u, last=lambda i: i + i) for i in range(n)]
        worst = max(worst, abs(sum(printed) - 1.0))
    assert worst > 0.5  # zeta_{i+i}: the functions no longer sum to one


def test_the_sentence_after_equation_3_7_is_reversed():
    """It says that the value is 1 when zeta is less than zeta_i and greater than zeta_{i+i}: never."""
    knots = np.sort(np.random.default_rng(0).uniform(size=12))
    u = np.linspace(-0.5, 1.5, 500)
    assert not any(((u < knots[i]) & (u > knots[2 * i])).any() for i in range(6))


def test_both_ends_are_the_first_and_the_last_control_point():
    for curve in (random_curve(1, rational=True), CIRCLE):
        a, b = curve.domain
        np.testing.assert_allclose(curve.evaluate(a), curve.control_points[0])
        np.testing.assert_allclose(curve.evaluate(b), curve.control_points[-1])  # N_n(b) = 1
        np.testing.assert_allclose(curve.evaluate([b + 1.0, a - 1.0]), curve.control_points[[-1, 0]])


def test_weights_make_an_exact_arc():
    points = CIRCLE.evaluate(np.linspace(0.0, 1.0, 101))
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 1.0, atol=1e-14)
    plain = NURBS(CIRCLE.knots, CIRCLE.control_points, np.ones(3), 2).evaluate(0.5)
    assert abs(np.linalg.norm(plain) - 1.0) > 0.05


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1))
def test_derivatives_of_rational_curves_equal_finite_differences(seed):
    curve, h = random_curve(seed, rational=True), 1e-6
    u = np.random.default_rng(seed).uniform(0.01, 1.99, 9)
    u = u[np.abs(u[:, None] - curve.knots).min(axis=1) > 1e-4]  # a derivative may jump at a knot
    for order in range(1, curve.degree + 1):
        below, above = curve.derivative(u - h, order - 1), curve.derivative(u + h, order - 1)
        slope = (above - below) / (2 * h)
        size = 1.0 + np.abs(slope).max(initial=0.0) + np.abs(above).max(initial=0.0)
        np.testing.assert_allclose(curve.derivative(u, order), slope, atol=2e-4 * size)


def test_a_number_gives_one_point_and_what_is_given_does_not_change():
    assert CIRCLE.evaluate(0.5).shape == (2,)
    assert CIRCLE.derivative(0.5, 2).shape == (2,)
    with pytest.raises(ValueError, match="read-only"):
        CIRCLE.knots[0] = 3.0


@pytest.mark.parametrize(
    ("knots", "weights", "degree", "match"),
    [
        ([0, 0, 0, 1, 1], [1, 1, 1], 2, "knots"),
        ([0, 0, 0, 1, 1, 1], [1, 1], 2, "weights"),
        ([0, 0, 0.1, 1, 1, 1], [1, 1, 1], 2, "repeated 3 times"),
        ([0, 0, 0, 1, 1, 0.5], [1, 1, 1], 2, "must not decrease"),
        ([0, 0, 0, 1, 1, 1], [1, 0, 1], 2, "positive"),
        ([0, 0, 0, 1, 1, np.nan], [1, 1, 1], 2, "finite"),
        ([0, 0, 0, 0, 0, 0], [1, 1, 1], 2, "would be discontinuous"),
        ([0, 0, 0, 1, 1, 1], [1, 1, 1], 0, "degree 0"),
    ],
)
def test_what_is_no_curve_is_refused(knots, weights, degree, match):
    with pytest.raises(InputError, match=match):
        NURBS(knots, np.zeros((3, 2)), weights, degree)


def test_there_is_no_derivative_beyond_the_degree():
    with pytest.raises(InputError, match="order must be 0 to 2"):
        CIRCLE.derivative(0.5, 3)
