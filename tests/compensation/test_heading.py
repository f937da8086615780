"""The heading of a case that leans, by a second route."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from multipos.compensation.added_columns import _heading
from multipos.files.tables import Table


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("heading", [17.0, 141.0, 283.0, 359.9])
def test_the_heading_of_a_case_that_leans(heading, sign):
    """A field of north .3 and down .9; x is headed, then pitched and rolled, in north-east-down."""
    turn = Rotation.from_euler("ZYX", [heading, 23.0, -34.0], degrees=True)
    into_case = turn.inv()
    field = into_case.apply([[0.3, 0.0, 0.9]]) * 48.0
    up = into_case.apply([[0.0, 0.0, -1.0]]) * 1.02
    beside = SimpleNamespace(
        outputs=("ax", "ay", "az"), model=SimpleNamespace(environment=()), sign=sign,
        compensate=lambda raw, environment: sign * raw,
    )  # fmt: skip
    table = Table("s", dict(zip(beside.outputs, up.T, strict=True)), rows=1)
    assert _heading(field, beside, table) == pytest.approx(heading, abs=1e-9)


def test_a_heading_of_nothing_is_none_and_one_of_a_full_turn_is_0():
    beside = SimpleNamespace(
        outputs=("ax", "ay", "az"), model=SimpleNamespace(environment=()), sign=1.0,
        compensate=lambda raw, environment: raw,
    )  # fmt: skip
    up = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
    table = Table("s", dict(zip(beside.outputs, up.T, strict=True)), rows=3)
    field = np.array([[0.0, 0.0, -3.0], [1.0, -1e-300, -3.0], [1.0, 0.0, 0.0]])
    found = _heading(field, beside, table)
    assert math.isnan(found[0])
    assert found[1] == 0.0
    assert math.isnan(found[2])
