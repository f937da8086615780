"""Results can be pickled, copied and compared, and stay frozen through all of it."""

import copy
import json
import pickle
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import FrozenInstanceError, fields, is_dataclass, replace
from functools import cache, partial
from inspect import isfunction
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import get_args, get_type_hints

import numpy as np
import pandas as pd
import pytest
from fleet_bench import line

import multipos as mp
from multipos.diagnostics.criticism import find_influence, judge_terms
from multipos.files.trees import to_json
from multipos.results import Columns, Frozen, Keyed, Result, Tabular
from multipos.uncertainty.budgets import read_budget
from multipos.uncertainty.monte_carlo import simulate_budget
from multipos.uncertainty.propagation import evaluate_budget

BUDGET = {
    "gravity": {"value": 9.81, "u": 1e-4},
    "gain": {"u": 1e-4},
    "offset": {"u": 1e-4, "distribution": "rectangular"},
}
TWICE = {"scheme": "faces-corners-14", "model": "own-quadratic"}


@cache
def sensor():
    return mp.fit(
        mp.Readings(
            mp.read_scheme("faces-6").up * [1.01, 0.99, 1.0] + [0.01, 0.0, -0.02], unit="g"
        ),
        scheme="faces-6",
    )


@cache
def session(seed=1):
    return mp.Readings(
        np.column_stack(
            [
                mp.simulate(sensor(), TWICE["scheme"], reading_sd=1e-3, seed=seed)[name]
                for name in ("ax", "ay", "az")
            ]
        ),
        unit="g",
    )


@cache
def calibrated(seed=1):
    return mp.fit(session(seed), budget=BUDGET, orientation_sd=0, **TWICE)


@cache
def warmed():
    t = np.repeat([-20.0, 20.0, 60.0], 6)
    up = np.tile(mp.read_scheme("faces-6").up, (3, 1))
    noise = 1e-4 * np.random.default_rng(1).standard_normal(len(t))
    columns = dict(zip(("up_x", "up_y", "up_z"), up.T, strict=True))
    columns |= {"ax": up[:, 0] * (1 + 1e-4 * t) + 1e-3 * t + noise, "temperature": t}
    return mp.fit(columns, model="1 + x + y + z + temperature + temperature*x")


@cache
def regressed():
    rng = np.random.default_rng(2)
    t = np.linspace(-40.0, 80.0, 240)
    data = {"time": np.arange(240.0), "t": t, "V": 1.0 + 0.01 * t + 1e-4 * t**2}
    data["y"] = 0.3 + 0.02 * t + np.where(t > 20.0, 0.05 * (t - 20.0), 0.0)
    data["y"] = data["y"] + 0.01 * rng.standard_normal(240)
    return mp.regress(
        data,
        response="y",
        variables="t,V",
        degree=2,
        stepwise=True,
        segment="t:20",
    )


@cache
def tumbled():
    t = 2 * np.pi * np.arange(24) / 24
    noise = 1e-4 * np.random.default_rng(1).standard_normal(24)
    return mp.tumble({"E": np.cos(t) + 0.01 + noise}, scheme="tumble-24")


@cache
def tumbled_all():
    scheme = mp.read_scheme("roll-z-8+roll-y-8")
    noise = 1e-4 * np.random.default_rng(2).standard_normal((16, 2))
    values = scheme.up[:, [0, 1]] + noise
    return mp.tumble({"ax": values[:, 0], "ay": values[:, 1]}, scheme=scheme)


@cache
def averaged():
    log = mp.simulate_log(sensor(), "faces-6", rate=50.0, rest=2.0, sample_sd=1e-3, seed=1)
    return mp.average(log, scheme="faces-6")


@cache
def checked():
    return mp.check(calibrated(), session(2), scheme=TWICE["scheme"], limit_g=0.01)


@cache
def doubted():
    up = np.tile(mp.read_scheme("faces-6").up, (2, 1))
    readings = mp.Readings(up * [1.0, 0.0, 1.0] + 1e-3, up=up, unit="g")
    return mp.fit(readings).diagnostics.findings[0]


@cache
def rested():
    rng = np.random.default_rng(1)
    t = np.arange(2000) / 10.0
    warm = 0.02 * np.exp(-t / 20.0)
    logs = [
        {
            "time": t,
            "ax": warm + 1e-3 * rng.standard_normal(len(t)),
            "temperature": 20.0 + np.sin(t / 9.0),
        }
        for _ in range(2)
    ]
    return mp.stability(logs, unit="g")


@cache
def captured():
    with TemporaryDirectory() as folder:
        log = mp.simulate_log(sensor(), "all-26", rate=50.0, rest=4.0, sample_sd=1e-3, seed=1)
        mp.write_table(Path(folder) / "log.csv", log)
        return mp.capture(f"replay:{Path(folder) / 'log.csv'}:0", positions=16)


RESULTS = {
    "Averages": averaged,
    "Budget": lambda: read_budget(BUDGET),
    "Calibration": calibrated,
    "Calibration of unknown orientations": lambda: mp.fit(session(), unknown_orientation=True),
    "Calibration with uncertain orientations": lambda: mp.fit(
        session(), orientation_sd=0.1, **TWICE
    ),
    "Calibration, robust": lambda: mp.fit(session(), robust="huber", **TWICE),
    "Calibration without degrees of freedom": lambda: mp.fit(
        mp.Readings([[1.01, 0.01], [-0.99, 0.02], [0.02, 1.02]], unit="g"),
        scheme={"direction": ["U-N-W", "D-S-W", "S-U-W"]},
        inputs="x,y",
    ),
    "Captured": captured,
    "Check": checked,
    "Comparison": lambda: mp.compare(calibrated(1), calibrated(2)),
    "Demonstration": mp.demo,
    "Finding": doubted,
    "Evaluation": lambda: evaluate_budget(calibrated(), read_budget(BUDGET)),
    "Exported": lambda: mp.export(sensor(), to="c"),
    "Fleet": lambda: mp.fleet(line(5), unit_column="unit", station_column="station"),
    "Influence": lambda: find_influence(calibrated()),
    "Model": lambda: calibrated().model,
    "MonteCarlo": lambda: simulate_budget(calibrated(), trials=1000, rng=1),
    "Readings": session,
    "Readings with columns": lambda: warmed().readings,
    "Regression": regressed,
    "Regressions": lambda: mp.Regressions({"one": regressed()}),
    "Stability": rested,
    "RegressionComparison": lambda: mp.compare(regressed(), regressed()),
    "Scheme": lambda: mp.read_scheme("faces-6"),
    "Sphere": lambda: mp.evaluate_sphere(calibrated(), directions="faces-6"),
    "Term tests": lambda: tuple(judge_terms(calibrated())),
    "Tumble": tumbled,
    "Tumbles": tumbled_all,
    "Curves": lambda: mp.over_temperature(warmed()),
    "apply": lambda: mp.apply(calibrated(), mp.simulate(sensor(), "faces-6"), uncertainty=True),
    "correct": lambda: mp.correct(regressed(), {"t": [0.0, 30.0], "V": [1.0, 1.2], "y": [0.0, 1]}),
    "design": lambda: mp.design("linear", 6),
    "schemes": lambda: mp.schemes("faces-6", "roll-x-8"),
    "simulate": lambda: mp.simulate(sensor(), "faces-6", seed=1),
    "simulate_log": lambda: mp.simulate_log(sensor(), "faces-6", rate=10.0, rest=1.0, seed=1),
    "table_errors": lambda: tumbled().table_errors,
}
# Of what public functions return, who has a table, a figure, and correlated numbers. What has none
# is no table, or needs the rows that a regression does not hold.
METHODS = {
    "Applied": {"to_pandas"},
    "Averages": {"to_pandas"},
    "Calibration": {"plot", "to_pandas", "to_ufloats"},
    "Captured": set(),
    "Check": {"plot", "to_pandas"},
    "Columns": {"to_pandas"},
    "Comparison": {"plot", "to_pandas"},
    "Corrected": {"to_pandas"},
    "Curve": {"plot", "to_pandas"},
    "Demonstration": set(),
    "Design": {"plot", "to_pandas"},
    "Evaluation": {"plot", "to_pandas"},
    "Exported": set(),
    "Fleet": {"plot", "to_pandas"},
    "MonteCarlo": {"to_pandas"},
    "Readings": {"to_pandas"},
    "Regression": {"to_pandas"},
    "RegressionComparison": {"plot", "to_pandas"},
    "Regressions": {"to_pandas"},
    "Scheme": {"plot", "to_pandas"},
    "Schemes": {"to_pandas"},
    "SimulatedLog": {"to_pandas"},
    "Simulation": {"to_pandas"},
    "Sphere": {"to_pandas"},
    "Stability": {"plot", "to_pandas"},
    "TableErrors": {"to_pandas"},
    "Tumble": {"plot", "to_pandas"},
    "Tumbles": {"plot", "to_pandas"},
}
every_result = pytest.mark.parametrize("name", RESULTS)


@cache
def result_of(name):
    """Return a result, made once: they are frozen."""
    return RESULTS[name]()


def arrays(value):
    """Yield the arrays that a result holds, as deep as they lie."""
    if isinstance(value, np.ndarray):
        yield value
    elif is_dataclass(value):
        for field in fields(value):
            yield from arrays(getattr(value, field.name))
    elif isinstance(value, dict):
        for entry in value.values():
            yield from arrays(entry)
    elif isinstance(value, tuple):
        for entry in value:
            yield from arrays(entry)


def nudged(value):
    """Return a value with its first number changed, or None where it has none."""
    if isinstance(value, bool | np.bool_):
        return not value
    if isinstance(value, int | float | np.number):
        return value * 1.001 + 1 if np.isfinite(value) else 0.0
    if isinstance(value, np.ndarray) and value.size and value.dtype.kind in "fiub":
        changed = value.copy()
        place = min(1, value.size - 1)  # not the first: an up vector (1, 0, 0) has any length
        changed.flat[place] = nudged(changed.flat[place])
        return changed
    if is_dataclass(value) or isinstance(value, dict | tuple | list):
        return next(nudges(value), None)
    return None


def nudges(value):
    """Yield the value with a number changed in one of its parts, for each part that has one."""
    if is_dataclass(value):
        parts = {f.name: getattr(value, f.name) for f in fields(value) if f.compare}
        for name, part in parts.items():
            if (changed := nudged(part)) is not None:
                yield replace(value, **{name: changed})
    elif isinstance(value, dict):
        for name, part in value.items():
            if (changed := nudged(part)) is not None:
                yield type(value)({**value, name: changed})
    else:
        for i, part in enumerate(value):
            if (changed := nudged(part)) is not None:
                parts = [*value[:i], changed, *value[i + 1 :]]
                yield type(value)(*parts) if hasattr(value, "_fields") else type(value)(parts)


@every_result
def test_a_pickle_and_a_copy_equal_the_result_and_are_frozen(name):
    result = result_of(name)
    str(result)  # whatever it caches stays behind
    again = [pickle.loads(pickle.dumps(result, protocol)) for protocol in range(2, 6)]
    for found in (*again, copy.deepcopy(result), copy.copy(result)):
        assert type(found) is type(result)
        assert found == result
        assert (found != result) is False
        assert not any(array.flags.writeable for array in arrays(found))


@every_result
def test_a_result_with_another_number_is_another(name):
    result = result_of(name)
    others = list(nudges(result))
    if name in ("Finding", "Exported"):  # those without a number
        others = [replace(result, text=result.text.replace("1", "7", 1))]
    assert others
    for other in others:
        assert other != result
        assert (other == result) is False


def test_every_public_type_of_results_is_among_them():
    kinds = {type(result_of(name)) for name in RESULTS}
    public = {getattr(mp, name) for name in mp.__all__ if isinstance(getattr(mp, name), type)}
    assert {kind for kind in public if not issubclass(kind, Exception | str)} <= kinds


def returned(annotation):
    """The types of results in what a function returns: one of several, a tuple or a list of one."""
    inside = [kind for part in get_args(annotation) for kind in returned(part)]
    own = isinstance(annotation, type) and issubclass(annotation, Result | Columns)
    return [annotation, *inside] if own else inside


def test_every_result_of_a_public_function_has_the_methods_it_should():
    functions = [getattr(mp, name) for name in mp.__all__]
    kinds = {
        kind
        for function in filter(isfunction, functions)
        for kind in returned(get_type_hints(function)["return"])
    }
    names = ("plot", "to_pandas", "to_ufloats")
    assert {
        kind.__name__: {name for name in names if hasattr(kind, name)} for kind in kinds
    } == METHODS
    assert all(hasattr(kind, "_repr_html_") for kind in kinds)


@every_result
def test_tables_are_frames_and_figures_are_axes(name):
    result = result_of(name)
    for one in result if isinstance(result, tuple) else [result]:
        has = METHODS.get(type(one).__name__, set())
        if "to_pandas" in has:
            frame = one.to_pandas()
            assert min(frame.shape) > 0
            if isinstance(one, Tabular):
                assert list(frame) == list(one.columns())
        if "plot" in has:
            axes = one.plot()
            assert all(panel.has_data() for panel in np.atleast_1d(axes))


def test_tables_hold_what_the_results_hold():
    budget = result_of("Evaluation")
    frame = budget.to_pandas()
    held = frame[~frame["contained"]]
    u = np.sqrt((held["contribution"] ** 2).groupby(held["parameter"], sort=False).sum())
    np.testing.assert_allclose(u[list(budget.names)], np.sqrt(np.diag(budget.covariance)))
    sphere = result_of("Sphere")
    assert sphere.to_pandas()["U"].tolist() == [
        told["U"] for axes in (sphere.force, sphere["tilt_deg"]) for told in axes.values()
    ]
    both = mp.Regressions({"one": regressed(), "two": regressed()}).to_pandas()
    assert both["response"].tolist() == ["one"] * (len(both) // 2) + ["two"] * (len(both) // 2)
    assert both["value"].tolist() == 2 * regressed().to_pandas()["value"].tolist()
    tumbles = tumbled_all().to_pandas()
    assert set(tumbles["output"]) == {"ax", "ay"}
    trials = result_of("MonteCarlo")
    assert (trials.to_pandas()["low"] < trials.mean).all()


def test_time_and_file_names_make_no_difference(tmp_path):
    text = "direction,ax\nE-U-S,0.01\nE-N-U,-0.01\nD-E-S,-0.99\nW-D-S,0\nU-W-S,1\nS-W-D,0\n"
    found = []
    for name in ("one.csv", "two.csv"):
        (tmp_path / name).write_text(text, encoding="utf-8")
        found.append(mp.fit(tmp_path / name))
    one, two = found[0], replace(found[1], created="2001-02-03T04:05:06Z")
    assert (one.readings.source, one.created) != (two.readings.source, two.created)
    assert one == two
    assert one != replace(two, convention="gravity")
    assert one != "a calibration"
    names = [str(tmp_path / name) for name in ("one.json", "two.json")]
    for calibration, name in zip(found, names, strict=True):
        calibration.save(name)
    assert mp.compare(*names) == mp.compare(*reversed(names))


def test_nan_equals_nan_and_shapes_count():
    columns = Frozen({"a": np.array([1.0, np.nan]), "b": [1.0, float("nan")]})
    assert columns == Frozen({"a": np.array([1.0, np.nan]), "b": [1.0, float("nan")]})
    assert columns != Frozen({"a": np.array([[1.0, np.nan]]), "b": [1.0, float("nan")]})
    assert columns != Frozen({"a": np.array([1.0, np.nan])})
    assert Frozen({"a": np.array([1.0])}) != Frozen({"a": 1.0})
    assert Frozen({"a": np.array([1.0])}) != np.array([1.0]).tolist()


keyed = pytest.mark.parametrize("name", ["schemes", "design"])
tables = pytest.mark.parametrize("name", ["apply", "correct", "simulate", "simulate_log"])


@keyed
def test_a_result_with_parts_is_read_by_attribute_and_by_key(name):
    found = result_of(name)
    assert isinstance(found, Keyed)
    names = [field.name for field in fields(found)]
    assert list(found) == list(found.keys()) == list(found.to_dict()) == names
    assert len(found) == len(names)
    assert dict(found) == {**found}
    for key in names:
        assert found[key] is getattr(found, key)
    assert "nonsense" not in found
    assert "to_dict" not in found
    with pytest.raises(KeyError, match="nonsense"):
        found["nonsense"]
    assert json.loads(to_json(found)) == found.to_dict()
    parts = [part for value in found.values() if isinstance(value, tuple) for part in value]
    assert all(isinstance(part, Keyed) for part in parts)


@tables
def test_a_table_is_read_by_attribute_and_by_key(name):
    found = result_of(name)
    assert isinstance(found, Columns)
    column = found["outside" if "outside" in found else "ax"]
    assert (found.outside if "outside" in found else found.ax) is column
    assert not hasattr(found, "nonsense")
    with pytest.raises(AttributeError, match=r"no column 'f_w'; the columns are "):
        found.f_w  # noqa: B018
    assert list(found.to_dict()["columns"]) == list(found)
    frame = found.to_pandas()
    pd.testing.assert_frame_equal(frame, pd.DataFrame(found))
    assert list(frame) == list(found)
    frame.iloc[0, -1] = 7  # a frame is the caller's own
    assert found == RESULTS[name]()


@pytest.mark.parametrize("name", ["apply", "correct"])
def test_a_table_leaves_the_arrays_it_was_given_as_they_were(name):
    function, with_, columns = {
        "apply": (mp.apply, sensor(), {axis: np.ones(2) for axis in ("ax", "ay", "az")}),
        "correct": (mp.correct, regressed(), {axis: np.ones(2) for axis in ("t", "V", "y")}),
    }[name]
    found = function(with_, columns)
    for given in columns.values():
        given[0] = 2.0
    assert found == function(with_, {axis: np.ones(2) for axis in columns})


def test_what_is_a_table_in_a_result_becomes_a_frame():
    found = mp.schemes("faces-6", "roll-x-8")
    frame = found.to_pandas()
    assert frame["name"].tolist() == ["faces-6", "roll-x-8"]
    assert frame["log_det"][0] == found.schemes[0].log_det
    assert np.isnan(frame["d_efficiency"][1])
    best = result_of("design")
    frame = best.to_pandas()
    assert list(frame) == ["position", "up_x", "up_y", "up_z"]
    np.testing.assert_array_equal(frame[["up_x", "up_y", "up_z"]], best.positions)


def test_without_pandas_a_frame_is_refused_in_words(monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    for name in ("schemes", "design", "simulate"):
        with pytest.raises(mp.MultiposError, match="needs pandas, which is not installed"):
            result_of(name).to_pandas()


def test_a_frozen_mapping_refuses_every_change():
    frozen = Frozen({"a": np.zeros(2), "b": {"c": 1}})
    for change in (
        lambda: frozen.update(a=1),
        lambda: frozen.pop("a"),
        frozen.clear,
        frozen.popitem,
        lambda: frozen.setdefault("d", 1),
        lambda: frozen.__setitem__("a", 1),
        lambda: frozen.__delitem__("a"),
        lambda: frozen.__ior__({"a": 1}),
        lambda: frozen["b"].update(c=2),
    ):
        with pytest.raises(TypeError, match=r"make a copy of it with dict\(…\)"):
            change()
    with pytest.raises(ValueError, match="read-only"):
        frozen["a"][0] = 1.0
    assert dict(frozen) | {"a": 1} == {"a": 1, "b": {"c": 1}}


def test_a_result_has_no_hash_and_a_model_has():
    with pytest.raises(TypeError, match="unhashable"):
        hash(sensor())
    assert len({calibrated(1).model, calibrated(2).model}) == 1
    with pytest.raises(FrozenInstanceError):
        sensor().parameters = np.zeros(12)


def test_a_user_defined_model_travels_once_it_has_been_used():
    cal = mp.fit(session(), scheme=TWICE["scheme"], model="each = b + s*own*(1 + k*own^2)")
    force = cal.compensate(session().values)  # compiles what cannot be pickled
    again = pickle.loads(pickle.dumps(cal))
    assert again == cal
    np.testing.assert_array_equal(again.compensate(session().values), force)


def test_a_process_pool_returns_calibrations():
    fit = partial(mp.fit, **TWICE)
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        (found,) = pool.map(fit, [session()])
    assert found == fit(session())


def test_an_error_comes_back_from_a_pool_of_processes_with_all_that_it_says():
    with pytest.raises(mp.RankError) as caught:
        mp.fit({"direction": ["E-U-S", "E-D-N"] * 3, "ay": [1.002, -0.998] * 3}, axes="y")
    for again in (pickle.loads(pickle.dumps(caught.value)), copy.deepcopy(caught.value)):
        assert type(again) is mp.RankError
        assert str(again) == str(caught.value)
        assert vars(again) == vars(caught.value)
        assert vars(again)["combinations"] != ()


@pytest.mark.parametrize(
    "call",
    [
        lambda path: mp.apply(path, {"ax": [0.0]}),
        lambda path: mp.check(path, "run.csv"),
        lambda path: mp.correct(path, "data.csv"),
        mp.evaluate_budget,
        mp.evaluate_sphere,
        mp.over_temperature,
        lambda path: mp.simulate(path, "faces-6"),
        lambda path: mp.simulate_log(path, "faces-6"),
        mp.simulate_budget,
        lambda path: mp.state_bench(path, reading_sd=1e-4),
        lambda path: mp.state_budget(path, {}),
        mp.table_errors,
    ],
)
def test_the_path_of_a_result_is_refused_with_the_way_to_read_it(call):
    with pytest.raises(TypeError, match=r"got str; .*`?multipos\.load"):
        call("cal.json")


def test_readings_without_labels_are_those_that_a_file_numbers(tmp_path):
    up = mp.read_scheme("faces-6").up
    found = mp.fit(mp.Readings(0.01 + up, up=up))
    found.save(tmp_path / "cal.json")
    again = mp.load(tmp_path / "cal.json")
    assert again.readings == found.readings
    named = mp.Readings(0.01 + up, up=up, positions=tuple("abcdef"))
    assert named != found.readings
    assert found.readings != named


def test_a_long_result_is_short_in_a_list_and_a_parameter_is_one_line():
    cal = mp.demo().calibration
    assert len(repr(cal)) == 500
    assert repr(cal).startswith("Calibration(version=")
    assert str(cal["bias_ax"]) == "bias_ax = -0.00079(52) g, U = 0.0067"
