"""Rows in time that are too few to know their noise are said, and no others."""

import numpy as np
import pytest
from scipy.signal import lfilter

import multipos as mp


def table(n, slow):
    rng = np.random.default_rng(4)
    noise = rng.standard_normal(n + 200)
    column = lfilter([1.0], [1.0, -0.97], noise)[200:] if slow else noise[200:]
    return {"time": np.arange(float(n)), "T": column, "error": column + rng.standard_normal(n)}


@pytest.mark.parametrize(
    ("n", "slow", "said"), [(100, True, True), (100, False, False), (250, True, False)]
)
def test_short_and_slow_is_said(n, slow, said):
    found = mp.regress(table(n, slow), response="error", variables="T")
    assert any("rows in time are too few" in text for text in found.warnings) == said


def test_not_without_a_time_nor_by_clusters():
    columns = table(100, slow=True)
    alone = {name: columns[name] for name in ("T", "error")}
    assert not any(
        "too few to tell" in text
        for text in mp.regress(alone, response="error", variables="T").warnings
    )
    columns["day"] = np.repeat(np.arange(5.0), 20)
    found = mp.regress(columns, response="error", variables="T", cluster="day")
    assert not any("too few to tell" in text for text in found.warnings)
