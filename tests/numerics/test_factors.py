"""A function in a factor is one entry: what the whole package makes of one it never heard of."""

import math
import shutil

import numpy as np
import pytest
from consumers import read_back

import multipos as mp
from multipos.designs.criteria import _mean_product
from multipos.numerics.factors import (
    FUNCTIONS,
    Code,
    Factor,
    Function,
    factor_from_list,
    factor_to_list,
)
from multipos.numerics.terms import Term, formula_columns, largest_value, parse_terms

SGN = Function(
    form="sgn({})",
    json="sgn",
    degree=0,
    is_odd=True,
    value=np.sign,
    slope=lambda v: 0.0 * v,
    code=Code("s", "({v} > {zero} ? {one} : {zero}) - ({v} < {zero} ? {one} : {zero})"),
)
FORMULA = "1 + x + y + z + own*sgn(own) + own*sgn(temperature)"


@pytest.fixture
def sgn(monkeypatch):
    monkeypatch.setitem(FUNCTIONS, "sgn", SGN)


def terms(text):
    return tuple(map(str, parse_terms(text)))


def test_formulas_read_and_write_it(sgn):
    assert terms("x^2*sgn(x) + sgn( y )*|x| + sgn(t)") == ("x^2*sgn(x)", "|x|*sgn(y)", "sgn(t)")
    assert terms("x*sgn(x)^2 + sgn(x)^3 + sgn(x)^2") == ("x", "sgn(x)", "1")  # its square is 1
    assert formula_columns("x*sgn(t) + |u| + sgn(own)*w^2") == ("t", "u", "w")
    with pytest.raises(mp.UsageError, match=r"1, x, y, z, own, \|own\|, sgn\(own\) and column"):
        parse_terms("sgn[x]")
    with pytest.raises(mp.UsageError, match=r"\|x\| and sgn\(x\) stand in one term"):
        parse_terms("|x|*sgn(x)")


@pytest.mark.parametrize("text", ["sgn(x)", "x*sgn(x)", "x^3*sgn(x)*|y|", "|x|", "x^2*|x|"])
def test_derivative_is_that_of_the_value(sgn, text):
    (term,) = parse_terms(text)
    for x in (-0.7, 0.4):  # away from zero, where a step of 1e-6 leaves 1e-9 of roundoff
        ahead, behind = (term.evaluate({"x": x + h, "y": 0.6}) for h in (1e-6, -1e-6))
        assert term.derivative({"x": x, "y": 0.6}, "x") == pytest.approx(
            (ahead - behind) / 2e-6, rel=0, abs=1e-8
        )


def test_its_mean_over_the_sphere(sgn):
    # Over z uniform in -1 … 1: the mean of z sgn(z) is 1/2, that of z^2 sgn(z) |z| is 0.
    (odd, even, bare) = parse_terms("sgn(z) + |z| + z")
    assert _mean_product(odd, bare) == pytest.approx(0.5, rel=1e-14)
    assert _mean_product(odd, odd) == pytest.approx(1.0, rel=1e-14)
    assert _mean_product(odd, even) == 0.0
    assert _mean_product(even, even) == pytest.approx(1.0 / 3.0, rel=1e-14)


def chamber():
    up = np.concatenate([mp.read_scheme("all-26").up] * 2)
    t = np.repeat([-5.0, 8.0], 26)
    own = 1.0 + 1e-3 * np.sign(t)[:, None]
    values = 0.02 + own * up + 2e-3 * up * np.sign(up)
    values += 1e-5 * np.random.default_rng(1).normal(size=up.shape)
    return mp.Readings(values, up=up, unit="g", environment={"temperature": t})


@pytest.mark.skipif(shutil.which("cc") is None, reason="no cc on this machine")
def test_a_sensor_with_it_is_fitted_saved_and_exported(sgn, tmp_path):
    cal = mp.fit(chamber(), model=FORMULA)
    assert cal["ax", "x*sgn(x)"].value == pytest.approx(2e-3, abs=2e-5)  # 1e-5 of noise, 52 rows
    assert cal["ax", "sgn(temperature)*x"].value == pytest.approx(1e-3, abs=2e-5)
    cal.save(tmp_path / "cal.json")
    assert mp.load(tmp_path / "cal.json").names == cal.names
    mp.export(cal, "c").save(tmp_path / "sgn.c")
    found = read_back(tmp_path / "sgn.c", cal)
    assert found.difference < 1e-12  # [g], the steps are taken to 1e-13


def test_a_writer_without_a_form_for_it_refuses_by_name(sgn, monkeypatch):
    monkeypatch.setitem(FUNCTIONS, "sgn", SGN._replace(code=None))
    cal = mp.fit(chamber(), model=FORMULA)
    with pytest.raises(mp.MultiposError, match=r"the C file has no form for 'sgn\(temperature\)'"):
        mp.export(cal, "c")


def test_regressions_write_and_read_it(sgn, tmp_path):
    t = np.linspace(-3.0, 4.0, 60)
    noise = 1e-3 * np.random.default_rng(2).normal(size=60)
    found = mp.regress(
        {"t": t, "y": 1.0 + 2.0 * np.sign(t) + noise}, response="y", terms="1 + t + sgn(t)"
    )
    found.save(tmp_path / "r.json")
    again = mp.load_regression(tmp_path / "r.json")
    assert again.segments[0].terms == found.segments[0].terms
    assert Term((Factor("t", 0, "sgn"),)) in again.segments[0].terms


@pytest.mark.parametrize(
    ("factor", "listed"),
    [(Factor("t", 2), ["t", 2, False]), (Factor("t", 0, "modulus"), ["t", 0, True])],
)
def test_what_json_holds_of_a_factor(factor, listed):
    assert factor_to_list(factor) == listed
    assert factor_from_list(listed) == factor


def test_an_unknown_function_is_refused_by_name():
    with pytest.raises(ValueError, match="unknown function 'sgn' in a factor; there is modulus"):
        Factor("x", 1, "sgn")
    with pytest.raises(ValueError, match="a factor of 't' has a function that is not known, 'sgn'"):
        factor_from_list(["t", 1, "sgn"])


def test_what_is_odd_and_its_degree():
    # eq. (1) of numerics.factors
    odd = {str(f): (f.is_odd, f.degree) for f in (Factor("x", 3), Factor("x", 1, "modulus"))}
    assert odd == {"x^3": (True, 3), "x*|x|": (True, 2)}
    assert math.isclose(_mean_product(*parse_terms("x^2 + |x|")), 0.25)  # of |x|^3


def test_a_variable_may_be_as_large_as_its_powers_can_be_squared():
    """A term of 1e100: t^4 of 1e25, t^5 of 1e20; of lower powers what is measured, 1e40."""
    terms = parse_terms("1 + t + t^4 + x*t^5 + x^2")
    assert largest_value(terms, "t") == pytest.approx(1e20)
    assert largest_value(terms[:-2], "t") == pytest.approx(1e25)
    assert largest_value(terms, "x") == 1e40
    assert largest_value(terms, "none") == 1e40
