"""Names are given as text with commas, as a list or as a tuple, and mean the same."""

import inspect
from typing import Literal, get_args, get_origin, get_type_hints

import numpy as np
import pytest

import multipos as mp
from multipos.errors import UsageError
from multipos.files.spelling import near, split_names, split_numbers
from multipos.logs.opening import open_log

UP = mp.read_scheme("faces-6").up
TABLE = {"direction": ["E-U-S", "E-N-U", "D-E-S", "W-D-S", "U-W-S", "S-W-D"], "p": [0.1] * 6}
TABLE |= dict(zip(("ax", "ay"), (UP @ [[0.0, 1.0], [1.01, 0.0], [0.0, 0.02]]).T, strict=True))
ROWS = {name: np.random.default_rng(i).normal(size=40) for i, name in enumerate(("y", "A", "B"))}


def log():
    sensor = mp.fit(mp.Readings(UP, unit="g"), scheme="faces-6")
    return mp.simulate_log(sensor, "faces-6", rate=50.0, rest=2.0, sample_sd=1e-3, seed=1)


TAKEN = {
    "read_readings": (lambda names: mp.read_readings(TABLE, outputs=names), ("ax", "ay")),
    "fit, outputs": (lambda names: mp.fit(TABLE, outputs=names), ("ax", "ay")),
    "fit, axes": (lambda names: mp.fit(TABLE, outputs=["ax", "ay"], axes=names), ("y", "x")),
    "fit, inputs": (lambda names: mp.fit(TABLE, outputs=["ax", "ay"], inputs=names), ("x", "y")),
    "schemes, axes": (lambda names: mp.schemes("faces-6", axes=names), ("x", "z")),
    "schemes, inputs": (lambda names: mp.schemes("faces-6", axes="x", inputs=names), ("x", "y")),
    "design": (lambda names: mp.design("linear", 4, axes=names), ("x", "z")),
    "regress": (lambda names: mp.regress(ROWS, response="y", variables=names), ("A", "B")),
    "average, outputs": (lambda names: mp.average(log(), outputs=names), ("az", "ax")),
    "average, only": (lambda names: mp.average(log(), only=names), ("1", "3", "4")),
    "average, columns": (lambda names: mp.average(log(), columns=names), ("time", "a", "b", "c")),
    "open_log": (lambda names: open_log(log(), columns=names).columns, ("time", "a", "b", "c")),
    "tumble, outputs": (
        lambda names: mp.tumble(
            {"E": np.cos(np.arange(24) * np.pi / 12), "F": [0.0] * 24},
            scheme="tumble-24",
            outputs=names,
        ),
        ("E",),
    ),
}


@pytest.mark.parametrize("name", TAKEN)
def test_text_lists_and_tuples_name_the_same(name):
    call, names = TAKEN[name]
    expected = call(names)
    assert call(list(names)) == expected
    assert call(",".join(names)) == expected
    assert call(" " + " , ".join(names) + "\t") == expected
    with pytest.raises(UsageError, match="names nothing next to a comma"):
        call(",".join(names) + ",")
    with pytest.raises(TypeError, match="a name must be text, got 3"):
        call([*names[:-1], 3])


def test_schemes_and_runs_are_taken_one_by_one_or_as_one_list():
    one = mp.schemes("faces-6", "corners-8")
    assert mp.schemes(["faces-6", "corners-8"]) == mp.schemes(("faces-6", "corners-8")) == one
    assert len(one["schemes"]) == 2
    runs = [mp.fit(mp.Readings(UP * size, unit="g"), scheme="faces-6") for size in (1.0, 1.01)]
    assert mp.compare(runs) == mp.compare(tuple(runs)) == mp.compare(*runs)
    with pytest.raises(UsageError, match="two or more"):
        mp.compare(runs[:1])


def test_names_are_stripped_and_none_is_empty():
    assert split_names(" ax ,ay") == split_names(["ax ", "ay"]) == ("ax", "ay")
    for empty in ("", " ", "a,,b", ",", [], [""], ("a", " ")):
        with pytest.raises(UsageError, match=r"^--only: '.*' names nothing next to a comma\.$"):
            split_names(empty, "--only")


def test_numbers_are_read_with_blanks_beside_commas():
    assert split_numbers(" -1, 2.5 ,3e2") == (-1.0, 2.5, 300.0)
    for wrong in ("", "1,", "1,b", "1;2"):
        with pytest.raises(UsageError, match=f"'{wrong}' is not a number or numbers"):
            split_numbers(wrong)


def test_a_parameter_is_found_by_its_name():
    cal = mp.fit(mp.Readings(UP, unit="g"), scheme="faces-6", model="own-quadratic")
    for i, name in enumerate(cal.names):
        assert cal[name] == cal[cal.model.keys[i][0], str(cal.model.keys[i][1])]
        assert cal[name].name == name
    for wrong, offered in (("scale_aX", "scale_ax"), ("scaleax", "scale_ax"), ("quad_a", "quad_a")):
        with pytest.raises(KeyError, match=f"no parameter '{wrong}'; did you mean '{offered}"):
            cal[wrong]
    with pytest.raises(KeyError, match=r"no parameter 'ax'\. The model has bias_ax, scale_ax, "):
        cal["ax"]


def test_a_near_name_is_offered_whatever_its_case():
    assert near("TEMPERATUR", ["time", "temperature"]) == "; did you mean 'temperature'?"
    assert near("pressure", ["time", "temperature"]) == "."


CHOICES = [
    (mp.fit, "convention", (TABLE,)),
    (mp.fit, "gauge", (TABLE,)),
    (mp.fit, "robust", (TABLE,)),
    (mp.tumble, "convention", ({"E": [1.0, 0.0, -1.0, 0.0]},), {"scheme": "tumble-4"}),
    (mp.average, "convention", (TABLE,)),
    (mp.apply, "outside", (mp.fit(mp.Readings(UP), scheme="faces-6"), TABLE)),
    (mp.correct, "outside", (mp.regress(ROWS, response="y", variables="A"), ROWS)),
]


@pytest.mark.parametrize("case", CHOICES, ids=lambda case: f"{case[0].__name__} {case[1]}")
def test_a_choice_has_a_type_that_lists_what_is_taken(case):
    function, name, arguments, *more = case
    hint = get_type_hints(function)[name]
    literal = hint if get_origin(hint) is Literal else get_args(hint)[0]
    assert get_origin(literal) is Literal
    default = inspect.signature(function).parameters[name].default
    assert default in (None, inspect.Parameter.empty, *get_args(literal))
    with pytest.raises(UsageError) as refused:
        function(*arguments, **{name: "another"}, **(more[0] if more else {}))
    assert "'another'" in str(refused.value)
    for choice in get_args(literal):
        assert choice in str(refused.value)
