"""What a fleet's figures are drawn from, where units are alike."""

import numpy as np

from multipos.fleets.pictures import histogram


def test_units_alike_but_for_rounding_have_no_histogram():
    alike = 1.0 + np.arange(8) * np.finfo(float).eps
    assert histogram(alike) is None
    one_off = histogram(np.append(alike, 2.0))
    assert one_off["high"] == 2.0
    assert sum(one_off["counts"]) == 9


def test_a_histogram_counts_what_is_beyond_it():
    drawn = histogram(np.concatenate([np.linspace(-1.0, 1.0, 101), [50.0, -70.0, 80.0]]))
    assert (drawn["below"], drawn["above"]) == (1, 2)
    assert sum(drawn["counts"]) == 101
