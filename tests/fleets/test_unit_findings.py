"""Every unit of a fleet has the findings of `fit`."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

import multipos as mp
from multipos.diagnostics.score_tests import LEVEL
from multipos.estimation import user_models
from multipos.estimation.batches import Solution
from multipos.finding import serious
from multipos.fleets import solution_findings, solving, unit_findings
from multipos.fleets.fixtures import Fixture

pytestmark = pytest.mark.filterwarnings("ignore::multipos.errors.CalibrationWarning")
UNITS = 10
FEW = 4  # of them, where each is fitted alone as well
LOUD = {"noise": np.array([1e-4, 1e-4, 1e-3]), "off_deg": 0.02}  # one of the outputs
IGNORED = "missing-term;orientation-ignored"  # which a column lists
KNOWN = {"orientation_sd": 0, "exclude": "none"}  # least squares of the listed orientations
OWN = "each = b + p*x + q*y + r*z + k*(p*x + q*y + r*z)^2"


def fleet(
    scheme,
    *,
    off_deg=0.0,
    cubic=0.0,
    out=0.0,
    drift=0.0,
    warm=0.0,
    noise=1e-4,
    u=0.0,
    repeats=1,
    seed=5,
):
    """Units with one flaw each, of a size that the noise of one position does not hide."""
    rng = np.random.default_rng(seed)
    up = np.repeat(mp.read_scheme(scheme).up, repeats, axis=0)
    n = len(up)
    stood = np.broadcast_to(up, (UNITS, n, 3))
    stood = stood + np.cross(np.radians(off_deg) * rng.standard_normal((UNITS, n, 3)), stood)
    stood = stood / np.linalg.norm(stood, axis=2)[:, :, None]
    values = stood * (1.0 + 0.01 * rng.standard_normal((UNITS, 1, 3)))
    values = values + 0.02 * rng.standard_normal((UNITS, 1, 3)) + cubic * stood**3
    values = values + drift * np.linspace(-1.0, 1.0, n)[:, None]
    values = values + noise * rng.standard_normal(values.shape)
    values[np.arange(UNITS), rng.integers(0, n, UNITS), rng.integers(0, 3, UNITS)] += out
    table = {"unit": np.repeat(np.arange(UNITS), n)}
    if warm:
        warmth = rng.uniform(0.0, 0.9, (UNITS, n))
        values += warm * warmth[:, :, None]
        table["temperature"] = 20.0 + warmth.ravel()
    for i, axis in enumerate("xyz"):
        table |= {f"up_{axis}": np.tile(up[:, i], UNITS), f"a{axis}": values[:, :, i].ravel()}
        table |= {f"u_a{axis}": u * rng.uniform(0.5, 2.0, UNITS * n)} if u else {}
    return table


WHOLE = "1+x+y+z+own^2+own*|own|+own^3+x*y+x*z+y*z"  # lacks no kind of term


@pytest.mark.parametrize(
    ("scheme", "flaw", "options", "code"),
    [
        ("fibonacci-24", {}, {}, ""),
        ("faces-corners-14", {}, {"outputs": "az", "axes": "z"}, ""),
        ("fibonacci-24", {"cubic": 2e-3}, {}, "missing-term"),
        ("fibonacci-24", {"out": 5e-3}, {}, "outlier"),
        ("fibonacci-24", {"off_deg": 0.1}, {}, "placement"),
        ("fibonacci-24", {"drift": 2e-3}, {}, ""),
        ("fibonacci-24", {"drift": 2e-3}, {"outputs": "ax,ay", "model": "1 + own"}, ""),
        ("fibonacci-24", {"cubic": 2e-3}, {"reading_sd": 1e-4}, "missing-term"),
        ("fibonacci-24", {"out": 5e-3}, {"reading_sd": [1e-4, 1e-4, 2e-4]}, "outlier"),
        ("fibonacci-24", {"cubic": 1e-3, "u": 1e-4}, {}, "missing-term"),
        ("fibonacci-24", {"out": 5e-3, "u": 1e-4}, {}, "outlier"),
        ("all-26", {"cubic": 2e-3}, {"model": "own-quadratic"}, "missing-term"),
        ("icosahedron-12", {"cubic": 2e-4, "repeats": 3}, {"model": "linear"}, ""),
        ("fibonacci-24", {"cubic": 2e-3}, {"robust": "huber"}, "missing-term"),
        ("fibonacci-24", {"out": 4e-3}, {"robust": "cauchy"}, "outlier;set-aside"),
        ("faces-corners-14", {"out": 2e-3}, {"robust": "huber", "model": "ieee"}, ""),
        ("faces-corners-14", {"repeats": 2}, {"model": OWN}, ""),
        ("faces-corners-14", {"cubic": 1e-3, "repeats": 2}, {"model": OWN}, "missing-term"),
        ("all-26", {"out": 5e-3}, {"model": OWN}, "outlier"),
        ("fibonacci-24", {"warm": 3e-4, "u": 1e-4}, {}, "missing-term"),
        ("fibonacci-24", {"warm": 3e-4}, {"robust": "huber"}, "missing-term"),
        ("fibonacci-24", {"warm": 5e-3, "off_deg": 0.1}, {"orientation_sd": 0.1}, "missing-term"),
        # outputs that are told apart have each its noise
        ("fibonacci-24", LOUD, {"orientation_sd": 0.02}, ""),
        ("fibonacci-24", LOUD | {"repeats": 9}, {"orientation_sd": 0.02}, ""),  # too many to tell
        ("fibonacci-24", LOUD, {"orientation_sd": "auto"}, ""),
        ("fibonacci-24", LOUD | {"u": 1e-4}, {"orientation_sd": 0.02}, ""),
        ("fibonacci-24", {"warm": 2e-3}, {"unknown_orientation": True}, IGNORED),
        ("fibonacci-24", LOUD | {"seed": 8}, {"unknown_orientation": True}, "orientation-ignored"),
        ("all-26", {"cubic": 2e-3}, {"unknown_orientation": True}, IGNORED),
        ("fibonacci-24", {"out": 5e-3}, {"unknown_orientation": True}, "orientation-ignored"),
        ("fibonacci-24", {"out": 9e-3}, {"orientation_sd": 0.1, "reading_sd": 1e-4}, "outlier"),
        ("fibonacci-24", {"out": 5e-3, "noise": 3e-4}, {"orientation_sd": 0.3}, "outlier"),
        ("all-26", {}, {"orientation_sd": 0.02, "model": WHOLE}, ""),
    ],
)
def test_units_have_the_findings_of_fit(scheme, flaw, options, code):
    if "orientation_sd" not in options and "unknown_orientation" not in options:
        options = KNOWN | options
    options = {"exclude": "none"} | options
    table = fleet(scheme, **flaw)
    n = len(table["unit"]) // UNITS
    table = {name: column[: FEW * n] for name, column in table.items()}
    found = mp.fit_many(table, unit_column="unit", **options)
    singly = [
        mp.fit({k: v[i * n : (i + 1) * n] for k, v in table.items() if k != "unit"}, **options)
        for i in range(FEW)
    ]
    said = [";".join(dict.fromkeys(d.code for d in serious(c.findings))) for c in singly]
    assert found.get("findings", np.array([""] * FEW)).tolist() == said
    # chance makes an outlier of a position that is off in one of a hundred, which explains the rest
    assert not code or sum(set(code.split(";")) <= set(each.split(";")) for each in said) >= FEW - 1


def codes_of_both(values, u=None, **options):
    """Codes of `fit` and of `fit_many`, unit by unit, of values (B, n, 3) and their u, if any."""
    count, n = values.shape[:2]
    tables = [dict(zip(("ax", "ay", "az"), each.T, strict=True)) for each in values]
    for table, each in zip(tables, u if u is not None else (), strict=u is not None):
        table |= dict(zip(("u_ax", "u_ay", "u_az"), each.T, strict=True))
    whole = {name: np.concatenate([table[name] for table in tables]) for name in tables[0]}
    whole["unit"] = np.repeat(np.arange(count), n)
    singly = [mp.fit(table, scheme="fibonacci-24", **options).findings for table in tables]
    said = [";".join(dict.fromkeys(d.code for d in serious(each))) for each in singly]
    found = mp.fit_many(whole, unit_column="unit", scheme="fibonacci-24", **options)
    return said, found["findings"].tolist()


@pytest.mark.parametrize("options", [{}, {"reading_sd": 3e-4}, {"stated": True}])
def test_outliers_that_hide_one_another_are_found_as_by_fit(options):
    """Three positions off by .1°, which studentised residuals take for noise beside one by 5 mg."""
    rng = np.random.default_rng(3)
    up = mp.read_scheme("fibonacci-24").up
    stood = np.broadcast_to(up, (40, 24, 3)).copy()
    for unit in range(40):
        off = rng.choice(24, 3, replace=False)
        stood[unit, off] += np.cross(np.radians(0.1) * rng.standard_normal((3, 3)), up[off])
    values = stood + 3e-5 * rng.standard_normal(stood.shape)
    values[np.arange(40), rng.integers(0, 24, 40), rng.integers(0, 3, 40)] += 5e-3
    u = rng.uniform(2e-5, 4e-5, values.shape) if options.pop("stated", False) else None
    singly, together = codes_of_both(values, u, **KNOWN, **options)
    assert together == singly
    assert sum("outlier" in each for each in singly) > 30


def test_causes_of_time_at_unknown_orientations_are_those_of_fit():
    rng = np.random.default_rng(0)
    up = mp.read_scheme("fibonacci-24").up
    off = 1e-4 * np.cumsum(rng.standard_normal((40, 24, 3)), axis=1)
    after = np.arange(24) > rng.integers(4, 20, (20, 1))
    off[20:] = 1e-3 * after[:, :, None] * rng.standard_normal((20, 1, 3))
    values = up + off + 1e-4 * rng.standard_normal(off.shape)
    singly, together = codes_of_both(values, unknown_orientation=True)
    assert together == singly
    assert sum("replaced" in each for each in singly[20:]) > 5


def test_a_position_sticks_out_by_what_fitted_equations_leave():
    """Of 24 points of a circle and 9 harmonics: seldom by chance, and mostly one 12 sd off."""
    turns = np.outer(np.arange(24), np.arange(9)) * np.pi / 12.0
    Q = np.linalg.qr(np.hstack([np.cos(turns[:, :5]), np.sin(turns[:, 1:5])]))[0]
    y = np.random.default_rng(1).standard_normal((4000, 24))
    y[2000:, 0] += 12.0
    left = y - y @ Q @ Q.T
    ones = np.ones((1, 4000, 24))
    of = Solution(ones[None], np.zeros((1, 9, 4000, 24)), ones, left[None], ones, ones, ones)
    said = solution_findings._stick_out(of)
    assert said[:2000].mean() < 0.003
    assert said[2000:].mean() > 0.8
    few = of._replace(slopes=np.zeros((1, 22, 4000, 24)))
    assert not solution_findings._stick_out(few).any()


def test_a_term_that_all_units_lack_sends_none_to_the_single_fit(monkeypatch):
    count = []
    fit = solving.fit
    monkeypatch.setattr(solving, "fit", lambda *a, **o: count.append(1) or fit(*a, **o))
    mp.fit_many(fleet("fibonacci-24", cubic=2e-3), unit_column="unit", **KNOWN)
    mp.fit_many(fleet("fibonacci-24"), unit_column="unit", **KNOWN, model=OWN)
    assert len(count) <= 5  # the first of each, and a few that chance shows another cause in


def test_units_whose_model_bends_within_u_are_fitted_singly():
    """Half of the bias that `fit` reports, a tenth of u, is enough: noise differs by unit."""
    up = mp.read_scheme("all-26").up
    rng = np.random.default_rng(3)
    values = up / (1.0 + 0.03 * up**2) + 0.1 * rng.standard_normal((4, 26, 3))
    one = mp.fit(mp.Readings(values[0], up=up), model="each = b + s*own/(1 + k*own^2)", **KNOWN)
    shared = user_models.share_expression(one)
    assert (shared.bias * one.model.per_parameter(one.residual_sd)).max() > 0.1  # and so reported
    assert "model-bias" in {each.code for each in one.findings}
    for share, sound in ((0.49, True), (0.51, False)):
        limit = share * 0.1 / one.model.per_parameter(one.residual_sd)
        held = replace(shared, bias=limit)
        found = user_models.estimate_expression(
            held, [each[:1] for each in np.moveaxis(values, 2, 0)]
        )
        assert found.sound.tolist() == [sound]


def test_interchanged_rows_are_seen_behind_an_outlier():
    """Neighbours 12° apart in 400: the rms is a percent, as that of an outlier may be."""
    table = fleet("fibonacci-400")
    up = mp.read_scheme("fibonacci-400").up
    near = int(np.argsort(-up @ up[0])[1])
    for axis in "xyz":
        column = table[f"a{axis}"]
        column[[0, near]] = column[[near, 0]]
    found = mp.fit_many(table, unit_column="unit", **KNOWN)
    assert "interchanged-rows" in found["findings"][0]
    assert "interchanged-rows" not in "".join(found["findings"][1:])


@pytest.mark.parametrize(("axes", "n"), [(("x", "y"), 24), (("x", "y", "z"), 121)])
def test_there_are_no_angles_of_two_axes_or_of_many_positions(axes, n):
    shared = SimpleNamespace(model=SimpleNamespace(axes=axes), reference=np.zeros((n, 3)))
    assert Fixture.of(shared, (), shared.reference) is None


def test_outputs_together_are_judged_by_fisher():
    """−2 Σ ln p of three outputs on χ² of six; two kinds that are tested share the level."""
    level = 1.0 - np.sqrt(1.0 - LEVEL)
    limits = [np.log(level), -0.5 * stats.chi2.isf(level, 6), -np.inf]
    np.testing.assert_allclose(unit_findings._limits(np.array([[1, 3, 0]]))[0], limits)
