from __future__ import annotations

import numpy as np
import pytest

from demonstration_samples import path, turn
from imitarm.demonstrations import read
from imitarm.errors import FileFormatError

PHASE = np.linspace(0.0, 1.0, 30)
TABLE = np.column_stack([path(PHASE), turn(PHASE)])


@pytest.mark.parametrize("separator", [",", ";", "\t", " "])
@pytest.mark.parametrize("heading", ["", "x y z qw qx qy qz"])
def test_positions_and_quaternions_however_they_are_set_apart(tmp_path, separator, heading):
    file = tmp_path / "a.txt"
    np.savetxt(file, TABLE, delimiter=separator, header=heading.replace(" ", separator), comments="", fmt="%.17g")
    text = file.read_text()
    file.write_text(text.removeprefix("\n"))
    (one,) = read(file, duration=3.0)
    assert np.allclose(one.trajectory.positions, TABLE[:, :3], rtol=0, atol=1e-15)
    assert np.allclose(one.trajectory.quaternions, TABLE[:, 3:])
    assert one.trajectory.duration == 3.0


def test_remarks_give_unit_and_task(tmp_path):
    file = tmp_path / "a.csv"
    file.write_text("# units: cm\n# task: pour\nt,x,y,z\n0,10,20,30\n1,20,20,30\n2,30,20,30\n")
    (one,) = read(file, task="something else")
    assert np.allclose(one.trajectory.positions[0], [0.1, 0.2, 0.3])
    assert one.task == "pour"


def test_quaternions_of_few_digits_are_scaled_and_others_refused(tmp_path):
    file = tmp_path / "a.csv"
    np.savetxt(file, np.round(TABLE, 2), delimiter=",")
    (one,) = read(file, rate=10.0)
    assert np.allclose(np.linalg.norm(one.trajectory.quaternions, axis=1), 1.0)
    broken = TABLE.copy()
    broken[12, 3:] = 0.0
    np.savetxt(file, broken, delimiter=",")
    with pytest.raises(FileFormatError, match=r"a\.csv, line 13: quaternion of length 0, must be 1"):
        read(file, rate=10.0)
