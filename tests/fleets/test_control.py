"""Control charts against the examples that NIST prints, and drawn for every station."""

import numpy as np
import pytest
from fleet_bench import line

import multipos as mp
from multipos.fleets.control_charts import ewma, ewma_limits, individual_limits, judge_control

# NIST/SEMATECH e-Handbook, 6.3.2.2: flow rates of ten batches, and what is printed of them
FLOW = [49.6, 47.6, 49.9, 51.3, 47.8, 51.2, 52.6, 52.4, 53.6, 52.1]
# 6.3.2.4: twenty values, target 50, λ = .3, s = 2.0539, and the EWMA as printed
VALUES = [52.0, 47.0, 53.0, 49.3, 50.1, 47.0, 51.0, 50.1, 51.2, 50.5, *FLOW]
PRINTED = [
    *(50.60, 49.52, 50.56, 50.18, 50.16, 49.21, 49.75, 49.85, 50.26, 50.33),
    *(50.11, 49.36, 49.52, 50.05, 49.38, 49.92, 50.73, 51.23, 51.94, 51.99),
]


def test_individual_limits_are_those_of_the_handbook():
    # eq. (1) of fleets.control_charts
    found = individual_limits(np.array(FLOW))
    assert found.centre == pytest.approx(50.81, abs=1e-10)
    # printed with d2 rounded to 1.128: 55.8041 and 45.8159
    assert found.ucl == pytest.approx(55.8041, abs=2e-3)
    assert found.lcl == pytest.approx(45.8159, abs=2e-3)


def test_the_ewma_is_that_of_the_handbook():
    # eq. (2) of fleets.control_charts
    found = ewma(np.array(VALUES), 50.0, 0.3)
    # two decimals are printed, carried on from rounded values
    np.testing.assert_allclose(found, PRINTED, atol=0.0101)
    limits = ewma_limits(50.0, 2.0539, 0.3)
    assert limits.ucl == pytest.approx(52.5884, abs=5e-4)
    assert limits.lcl == pytest.approx(47.4115, abs=5e-4)


def test_values_beyond_are_counted():
    rng = np.random.default_rng(1)
    values = rng.normal(size=2000)
    # of normal values 0.27 % are beyond three sd: 5.4 of 2000, four Poisson sd are 9
    assert judge_control(values)["beyond"] < 5.4 + 9.3
    values[500:520] += 10.0
    for sign in (1.0, -1.0):
        found = judge_control(sign * values)
        assert 20 <= found["beyond"] < 20 + 5.4 + 9.3
        # from 10 the EWMA falls by .7 a value to its limit, 1.26: five more; and as many by chance
        assert 20 <= found["ewma_beyond"] < 25 + 5.4 + 9.3


def test_every_station_has_its_chart():
    table = line(60, stations=2)
    found = mp.fleet(table, unit_column="unit", station_column="station")
    for parameter in found["parameters"]:
        assert {each["station"] for each in parameter["chart"]} == {"S0", "S1"}
        for each in parameter["chart"]:
            assert each["control"]["lcl"] < each["control"]["centre"] < each["control"]["ucl"]
            assert len(each["median"]) == len(each["place"]) >= 2
