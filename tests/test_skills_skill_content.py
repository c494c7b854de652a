from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from imitarm.errors import FileFormatError, InputError
from imitarm.skills import DMP, GMR
from imitarm.skills.skill_content import dmp_content, gmr_content, read_dmp, read_gmr
from imitarm.skills.skill_file import Fields
from skill_samples import shown


def written(content: dict[str, Any]) -> dict[str, Any]:
    """As it comes out of a file."""
    plain = json.dumps(content, default=lambda a: a.tolist() if isinstance(a, np.ndarray | np.generic) else list(a))
    return json.loads(plain)


@pytest.mark.parametrize("turn", [None, 1.0, 6.0])
def test_a_regression_comes_back_to_the_last_bit(turn: float | None) -> None:
    gmr = GMR(candidates=[3, 4]).fit(shown(n=3, turn=turn))
    again = read_gmr(Fields(written(gmr_content(gmr)), "gmr"))
    t = np.linspace(0.0, 2.0, 17)
    np.testing.assert_array_equal(again.predict(t)[0], gmr.predict(t)[0])
    np.testing.assert_array_equal(again.predict(t)[1], gmr.predict(t)[1])
    if turn is not None:
        np.testing.assert_array_equal(again.predict_orientation(t)[0], gmr.predict_orientation(t)[0])
    assert again.selection_ == gmr.selection_
    assert (again.n_demonstrations_, again.degenerate_axes_, again.converged_, again.lower_bound_) == (
        gmr.n_demonstrations_,
        gmr.degenerate_axes_,
        gmr.converged_,
        gmr.lower_bound_,
    )


@pytest.mark.parametrize("turn", [None, 6.0])
def test_a_primitive_comes_back_to_the_last_bit(turn: float | None) -> None:
    dmp = DMP("thesis", n_basis=15).fit(shown(n=1, turn=turn)[0].trajectory)
    again = read_dmp(Fields(written(dmp_content(dmp)), "dmp"))
    a, b = dmp.generate(goal=[0.1, 0.2, 0.3]), again.generate(goal=[0.1, 0.2, 0.3])
    np.testing.assert_array_equal(a.positions, b.positions)
    if turn is not None:
        assert a.quaternions is not None
        assert b.quaternions is not None
        np.testing.assert_array_equal(a.quaternions, b.quaternions)


def test_a_missing_field_is_named() -> None:
    content = written(dmp_content(DMP().fit(shown(n=1, turn=None)[0].trajectory)))
    for name in content:
        rest = {k: v for k, v in content.items() if k != name}
        with pytest.raises(FileFormatError, match=f"'{name}' is missing"):
            read_dmp(Fields(rest, "dmp"))


def test_numbers_out_of_range_are_refused() -> None:
    content = written(dmp_content(DMP().fit(shown(n=1, turn=None)[0].trajectory)))
    for change in ({"damping": 0.0}, {"duration": -1.0}, {"start_velocity": [0.0]}):
        with pytest.raises(InputError):
            read_dmp(Fields({**content, **change}, "dmp"))
