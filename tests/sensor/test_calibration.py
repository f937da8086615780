"""The one result: complete, frozen, and the same after a round trip through its file."""

import copy
import json

import numpy as np
import pandas as pd
import pytest
from amounts import few_and_many
from known_noise import with_known_noise
from numpy.testing import assert_allclose, assert_array_equal

import multipos as mp
from multipos.errors import MultiposError
from multipos.reports.summary import text_report
from multipos.sensor.calibration_file import from_dict
from multipos.sensor.fit_diagnostics import linearity

# INTERFACE, "JSON out"
PROMISED = """
    schema multipos_version created input convention gravity estimator criterion gauge model
    outputs axes inputs unit confidence positions parameters covariance residuals residual_sd dof
    readings reference rms linearity diagnostics cross_check intrinsic installation_deg
"""


def readings(n=14, *, seed=0, **options):
    rng = np.random.default_rng(seed)
    up = mp.read_scheme("faces-corners-14").up[:n]
    values = 0.1 + up @ (np.eye(3) + 0.01 * rng.standard_normal((3, 3)))
    return mp.Readings(values + 1e-3 * rng.standard_normal((n, 3)), up=up, unit="V", **options)


def calibrations():
    rng = np.random.default_rng(1)
    warm = {"temperature": rng.uniform(0, 40, 14), "time": np.arange(14.0)}
    square = rng.standard_normal((42, 42)) * 1e-4
    yield "linear", mp.fit(readings())
    yield "gravity", mp.fit(readings(), convention="gravity", gravity=9.81, gravity_u=1e-3)
    yield "stated u", mp.fit(readings(u=np.full((14, 3), 2e-3)), model="own-quadratic")
    yield "covariance", mp.fit(readings(covariance=square @ square.T + 1e-6 * np.eye(42)))
    up = [[0, 0, 1], [0, 1, 0], [1, 0, 0], [-1, 0, 0]]
    yield "no dof", mp.fit(mp.Readings([0.1, 0.1, 1.1, -0.9], up=up))
    yield (
        "temperature",
        mp.fit(
            readings(
                environment=warm,
                positions=[f"p{i // 2}" for i in range(14)],
                sd=np.ones((14, 3)),
                samples=np.arange(1, 15),
                group=["g", ""] * 7,
            ),
            model="1 + x + y + z + temperature*own",
            confidence=0.99,
        ),
    )
    attitudes = mp.Readings(np.eye(6)[:, :3])  # nothing of which is at their orientation
    yield "attitudes", mp.fit(attitudes, scheme="song-qin-6", orientation_sd=0)


CALIBRATIONS = dict(calibrations())
every = pytest.mark.parametrize("cal", CALIBRATIONS.values(), ids=CALIBRATIONS)


@every
def test_the_file_says_everything_again(cal, tmp_path):
    path = tmp_path / "cal.json"
    cal.save(path)
    again = mp.load(path)
    # what was left out on reading is among the warnings; its words are not kept twice
    assert again.to_dict() == cal.to_dict() == json.loads(path.read_text(encoding="utf-8"))
    assert text_report(again) == text_report(cal)
    raw = cal.readings.values
    assert_array_equal(
        again.compensate(raw, cal.readings.environment),
        cal.compensate(raw, cal.readings.environment),
    )
    assert again.model == cal.model


@every
def test_the_file_has_every_promised_key(cal):
    content = cal.to_dict()
    assert set(PROMISED.split()) <= set(content)
    assert content["schema"] == "multipos/calibration/1"
    assert set(content["input"]) == {"file", "sha256"}
    keys = {"output", "term", "name", "value", "u", "dof", "k", "U", "unit"}
    assert all(keys <= set(entry) for entry in content["parameters"])
    keys = {"rank", "parameters", "condition", "lack_of_fit", "outliers", "unidentifiable"}
    assert {*keys, "findings"} <= set(content["diagnostics"])


@every
def test_the_residuals_are_derived_again_from_the_file(cal):
    content = json.loads(json.dumps(cal.to_dict()))
    values, f = np.array(content["readings"]), np.array(content["reference"])
    columns = {"x": f[:, 0], "y": f[:, 1], "z": f[:, 2]}
    columns |= {name: np.array(c) for name, c in content.get("environment", {}).items()}
    model = np.zeros_like(values)
    for entry in content["parameters"]:  # by a reader of its own: products of bare names and powers
        term = np.ones(len(values))
        for factor in entry["term"].split("*"):
            name, _, power = factor.partition("^")
            term = term * (1.0 if name == "1" else columns[name] ** int(power or 1))
        model[:, content["outputs"].index(entry["output"])] += entry["value"] * term
    assert_allclose(values - model, content["residuals"], atol=1e-14)
    for entry, variance in zip(
        content["parameters"], np.diag(np.array(content["covariance"], dtype=float)), strict=True
    ):
        if entry["u"] is not None:
            assert entry["u"] == pytest.approx(np.sqrt(variance))
            assert pytest.approx(entry["k"] * entry["u"]) == entry["U"]


def test_rms_and_linearity_are_what_they_say():
    cal = CALIBRATIONS["linear"]
    matrix = (cal.model.linear_map({}) @ cal.parameters)[:, 1:]
    bias = cal.parameters[::4]
    force = np.linalg.solve(matrix, (cal.readings.values - bias).T).T
    assert_allclose(cal.compensate(cal.readings.values), force, atol=1e-14)
    assert cal.rms == pytest.approx(np.sqrt(np.mean(np.sum((force - cal.reference) ** 2, axis=1))))
    share = np.abs(cal.residuals) / cal.residual_sd
    assert_allclose(cal.relative_residuals, share.max(axis=1), rtol=1e-12)
    assert cal.linearity == linearity(cal.model, cal.reference, cal.readings.values, cal.residuals)


def test_infinite_and_missing_degrees_of_freedom():
    stated = with_known_noise(CALIBRATIONS["stated u"]).to_dict()
    assert set(stated["dof"].values()) == {None}
    assert stated["parameters"][0]["dof"] is None
    assert stated["parameters"][0]["k"] == pytest.approx(1.959964, abs=1e-6)
    left = CALIBRATIONS["no dof"].to_dict()
    assert left["dof"] == {"ax": 0}
    assert [left["parameters"][0][key] for key in ("u", "dof", "k", "U")] == [None, 0, None, None]
    assert left["diagnostics"]["findings"][0]["code"] == "no-redundancy"


def test_by_name_and_by_array():
    cal = with_known_noise(CALIBRATIONS["stated u"])
    p = cal["ay", "y^2"]
    i = cal.names.index("quad_ay")
    assert (p.value, p.u, p.k, p.dof) == (cal.parameters[i], cal.u[i], cal.k[i], np.inf)
    assert cal.U[i] == p.U == p.k * p.u
    assert (p.output, p.term, p.name, p.unit) == ("ay", "y^2", "quad_ay", "V/g^2")
    assert (p.symbol, p.label) == ("K_ay3", "second-order coefficient of ay along y")
    assert cal["ay", "own^2"] == p
    assert_allclose(np.diag(cal.correlation), 1)
    with pytest.raises(KeyError, match="no parameter"):
        cal["ay", "x^2"]
    assert "quad_ay" in str(cal)
    (row,) = (line for line in str(cal).splitlines() if line.startswith("quad_ay"))
    assert row.split()[1] == "K_ay3"


def test_a_calibration_never_changes():
    cal = CALIBRATIONS["linear"]
    for array in (cal.parameters, cal.covariance, cal.residuals, cal.reference, cal.dof):
        with pytest.raises(ValueError, match="read-only"):
            array[:] = 0
    with pytest.raises(AttributeError):
        cal.convention = "gravity"


def test_predict_and_compensate_take_one_or_many():
    cal = CALIBRATIONS["linear"]
    f = np.array([[0.3, -0.2, 0.9], [0, 0, 1]])
    assert_allclose(cal.compensate(cal.predict(f)), f, atol=1e-14)
    assert_allclose(cal.compensate(cal.predict(f[0])[0]), f[:1], atol=1e-14)
    assert_allclose(cal.compensate(pd.DataFrame(cal.predict(f))), f, atol=1e-14)
    named = pd.DataFrame(cal.predict(f), columns=cal.outputs)
    assert_allclose(cal.compensate(named[[*cal.outputs[::-1]]]), f, atol=1e-14)
    with pytest.raises(MultiposError, match=r"`raw` must have shape \(n, 3\), got \(2, 2\)"):
        cal.compensate(np.ones((2, 2)))
    one = CALIBRATIONS["no dof"]
    assert_allclose(one.compensate([0.1, 0.2, 0.3]), one.compensate([[0.1], [0.2], [0.3]]))
    warm = CALIBRATIONS["temperature"]
    with pytest.raises(ValueError, match="needs column 'temperature'"):
        warm.compensate(np.ones((2, 3)))


# --- files that are no calibrations


def test_a_truncated_file_is_refused_at_any_length(tmp_path):
    path = tmp_path / "cal.json"
    CALIBRATIONS["linear"].save(path)
    text = path.read_text()
    for length in np.linspace(0, len(text) - 3, 40).astype(int):
        path.write_text(text[:length])
        with pytest.raises(MultiposError, match=r"cal\.json: .*not valid JSON"):
            mp.load(path)


def places(value, path=()):
    """Every place of a nested object: all keys, and the first of each list."""
    if path:
        yield path
    items = value.items() if isinstance(value, dict) else []
    if isinstance(value, list) and value:
        items = [(0, value[0])]
    for key, item in items:
        yield from places(item, (*path, key))


WRONG = (None, "text", -1, [], {"a": 1}, float("nan"), ["a"])


@pytest.mark.parametrize("step", few_and_many(32, 1))
@pytest.mark.parametrize("name", ["stated u", "temperature"])
def test_a_damaged_file_is_used_or_refused_in_one_line(name, step):
    """Any value replaced by any other, or taken away: never an error that is not ours."""
    whole = CALIBRATIONS[name].to_dict()
    data = {column: [0.1, 0.2] for column in ("ax", "ay", "az", "temperature")}
    refused = 0
    for row, place in enumerate(places(whole)):
        for wrong in (KeyError, *WRONG)[row % step :: step]:
            content = copy.deepcopy(whole)
            inner = content
            for key in place[:-1]:
                inner = inner[key]
            if wrong is not KeyError:
                inner[place[-1]] = wrong
            else:
                del inner[place[-1]]
            try:
                cal = from_dict(content)
                text_report(cal)
                mp.apply(cal, data, uncertainty=True)
            except MultiposError:
                refused += 1
                continue
            cal.to_dict()
    assert refused > 300 / step


def test_a_later_version_may_say_more():
    """A key of which this version knows nothing is left alone, wherever it stands."""
    whole = CALIBRATIONS["stated u"].to_dict()
    assert whole["diagnostics"]["claim"] is not None
    for place in ((), ("status",), ("input",), ("diagnostics",), ("diagnostics", "claim")):
        content = copy.deepcopy(whole)
        inner = content
        for key in place:
            inner = inner[key]
        inner["later"] = 1.5
        assert from_dict(content) == CALIBRATIONS["stated u"]


def test_the_line_names_the_file_and_the_key(tmp_path):
    path = tmp_path / "cal.json"
    content = CALIBRATIONS["linear"].to_dict()
    del content["covariance"]
    path.write_text(json.dumps(content))
    with pytest.raises(MultiposError, match=r"cal\.json: the key 'covariance' is missing"):
        mp.load(path)
    content["covariance"] = [[1.0]]
    path.write_text(json.dumps(content))
    with pytest.raises(
        MultiposError, match=r"'covariance' has shape \(1, 1\), but \(12, 12\) fits"
    ):
        mp.load(path)
    path.write_text('{"schema": "multipos/regression/1"}')
    with pytest.raises(MultiposError, match="the schema is 'multipos/regression/1'"):
        mp.load(path)


def test_a_noise_too_small_to_divide_by_is_none():
    content = CALIBRATIONS["linear"].to_dict()
    content["residual_sd"]["ay"] = 5e-324
    assert from_dict(content).residual_sd[1] == 0.0


def test_entries_sign_and_mean_environment():
    found = dict(calibrations())
    cal = found["temperature"]
    assert [entry.name for entry in cal.entries] == list(cal.names)
    assert cal.entries[1] == cal[cal.names[1]]
    mean = float(np.mean(cal.readings.environment["temperature"]))
    assert cal.mean_environment == {"temperature": mean}
    assert (found["linear"].sign, found["gravity"].sign) == (1.0, -1.0)


def test_a_formula_of_a_single_column_is_read_back(tmp_path):
    """A word alone passes for the name of a model, unless it is known to be a column."""
    rng = np.random.default_rng(1)
    columns = {"position": range(8), "ax": rng.normal(size=8), "heat": np.arange(1.0, 9.0)}
    up = dict(zip(("up_x", "up_y", "up_z"), mp.read_scheme("corners-8").up.T, strict=True))
    found = mp.fit({**columns, **up}, model="heat", outputs="ax")
    found.save(tmp_path / "cal.json")
    assert mp.load(tmp_path / "cal.json").names == found.names


def test_what_earlier_versions_said_of_orientation_errors_and_of_rows_set_aside():
    """Version 0.2 gave value ± u alone, 0.1 no word on what was determined; neither gave rows."""
    up = mp.read_scheme("fibonacci-24").up
    rng = np.random.default_rng(4)
    values = up + 2e-3 * rng.standard_normal(up.shape)
    values[5] += 0.2
    positions = [f"p{i}" for i in range(24)]
    cal = mp.fit(mp.Readings(values, up=up, positions=positions))
    content = json.loads(json.dumps(cal.to_dict()))
    (aside,) = content["excluded"]
    assert (aside["label"], aside["row"]) == ("p5", 6)
    found = content["variance_components"]["orientation_sd_deg"]
    assert set(found) == {"value", "u", "determined", "low", "high", "source"}
    del aside["row"], found["low"], found["high"], found["source"]
    found |= {"value": 0.1, "u": 0.02, "determined": True}
    for gone in (set(), {"determined"}):
        for key in gone:
            del found[key]
        again = from_dict(content)
        spread = again.orientation_spread
        assert spread.determined
        assert (spread.low, spread.high) == pytest.approx((0.08, 0.12))
        assert spread.source == "estimated"
        assert again.excluded[0]._replace(row=6) == cal.excluded[0]
        assert_array_equal(again.U, cal.U)
