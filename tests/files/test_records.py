"""Files of results are held to their description: the first thing amiss is named by its key."""

import copy
import json

import numpy as np
import pytest

import multipos as mp
from multipos.errors import MultiposError
from multipos.files.numbers import markdown_line, markdown_text, table
from multipos.files.records import (
    LARGEST,
    Entries,
    Fields,
    Listed,
    Maybe,
    Named,
    Number,
    Numbers,
    Text,
    Whole,
    require,
    require_covariance,
    restore,
)
from multipos.files.spelling import visible


@pytest.mark.parametrize(
    ("kind", "value", "message"),
    [
        (Text(), 5, "a is 5; a text is needed there"),
        (Text(), "x\x1b[31m", r"a is 'x\x1b[31m'; a text without control characters"),
        (Text(), "x\u202ey", "a text without control characters"),
        (Text(), "x\ud800", "a text without control characters"),
        (Text(), "x" * 10_001, "a text of at most 10000 characters"),
        (Text(("one", "two")), ["one"], "a is a list of 1; one of one, two is needed"),
        (Number(), True, "a is true; a number is needed there"),
        (Number(), float("nan"), "a is nan; a number of at least -1e+100"),
        (Number(), 10**400, "a number of at least -1e+100 and at most 1e+100 is needed"),
        (Number(0.0, 1.0, above=True, below=True), 1, "a number above 0 and below 1 is needed"),
        (Whole(1), 1.0, "a whole number from 1 to"),
        (Maybe(Number()), "1", "a is '1'; a number is needed there"),
        (Listed(Number(), 2, 2), [1], "a is a list of 1; a list of 2 is needed there"),
        (Listed(Number()), {"b": 1}, "a is an object; a list is needed there"),
        (Listed(Number()), [1, None], "a[1] is null; a number is needed there"),
        (Entries((Text(), Whole())), ["x", "y"], "a[1] is 'y'; a whole number"),
        (Named(Number()), {"b": "x"}, "a.b is 'x'; a number is needed there"),
        (Named(Number()), {"\n": 1}, r"a key of a is '\n'; a text without control characters"),
        (Numbers(2), [[1, 2], [3]], "a[1] is a list of 1; a list of 2 is needed there"),
        (Numbers(2), [[1, 2], [3, "4"]], "a[1][1] is '4'; a number is needed there"),
        (Numbers(2), [[1, None]], "a[0][1] is null; a number is needed there"),
        (Numbers(2), [1, 2], "a[0] is 1; a list is needed there"),
        (Numbers(1), [1e200], "a[0] is 1e+200; a number of at least -1e+100"),
    ],
)
def test_what_is_not_of_its_kind_is_named(kind, value, message):
    with pytest.raises(MultiposError) as error:
        require({"a": value}, Fields({"a": kind}), "f.json", "do it again")
    assert message in str(error.value)
    assert str(error.value).startswith("f.json: a")
    assert str(error.value).endswith("; the file is damaged, do it again.")


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        (Text(), "东天南 µg\u00a0café 👩‍🔬"),
        (Numbers(2, gaps=True), [[1, None], [2, 3.5]]),
        (Numbers(2), []),
        (Numbers(1), [LARGEST, -LARGEST]),
        (Maybe(Number()), None),
    ],
)
def test_what_is_of_its_kind_passes(kind, value):
    kind.check(value, "a")


@pytest.mark.parametrize(
    ("covariance", "u", "message"),
    [
        ([[4.0, 0.0], [0.0, 1.0]], [1.0, 1.0], "squared uncertainties on its diagonal"),
        ([[-1.0, 0.0], [0.0, 1.0]], [np.nan, 1.0], "squared uncertainties on its diagonal"),
        ([[1.0, 0.5], [0.0, 1.0]], [1.0, 1.0], "not symmetric"),
        ([[1.0, 1.5], [1.5, 1.0]], [1.0, 1.0], "negative in a direction"),
        ([[1.0, np.nan], [np.nan, 1.0]], [1.0, 1.0], "has gaps"),
        ([[0.0, 1.0], [1.0, 1.0]], [0.0, 1.0], "no uncertainty"),
    ],
)
def test_a_covariance_that_is_none(covariance, u, message):
    with pytest.raises(ValueError, match=message):
        require_covariance(np.array(covariance), np.array(u))


def test_covariances_that_are():
    require_covariance(np.array([[4.0, 2.0], [2.0, 1.0]]), np.array([2.0, 1.0]))  # fully correlated
    require_covariance(np.array([[1.0, np.nan], [np.nan, np.nan]]), np.array([1.0, np.nan]))
    require_covariance(np.zeros((2, 2)), np.zeros(2))
    require_covariance(1e-200 * np.eye(2), np.array([1e-100, 1e-100]))
    require_covariance(np.zeros((0, 0)), np.zeros(0))


def test_what_contradicts_itself_is_named_with_the_way_out():
    def whole(content):
        if content["a"] + content["b"] != 1:
            raise ValueError("'a' and 'b' are no whole.")
        return content["a"]

    kind = Fields({"a": Number(), "b": Number()})
    said = {"what": "share", "again": "share again"}
    assert restore({"a": 0.25, "b": 0.75}, kind, whole, "f.json", **said) == 0.25
    with pytest.raises(MultiposError) as error:
        restore({"a": 1, "b": 1}, kind, whole, "f.json", **said)
    assert str(error.value) == "f.json: not a share: 'a' and 'b' are no whole; share again."
    with pytest.raises(MultiposError, match=r"f\.json: b is null; .* damaged, share again\."):
        restore({"a": 1, "b": None}, kind, whole, "f.json", **said)


# --- the three kinds of files


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """The content of a calibration, a regression and a check, with what loads each."""
    folder = tmp_path_factory.mktemp("files")
    rng = np.random.default_rng(3)
    up = mp.read_scheme("all-26").up
    (folder / "lab.toml").write_text("[gain]\nu = 1e-4\n", encoding="utf-8")
    readings = mp.Readings(up + 1e-3 * rng.normal(size=up.shape), up=up, unit="g")
    cal = mp.fit(readings, budget=folder / "lab.toml")
    cal.save(folder / "cal.json")
    run = mp.Readings(up[:9] + 1e-3 * rng.normal(size=(9, 3)), up=up[:9])
    mp.check(cal, run, limit_g=0.01).save(folder / "check.json")
    time = np.arange(200.0)
    t = 20.0 + 15.0 * np.sin(time / 20.0)
    table = {"time": time, "t": t, "y": 1.0 + 0.1 * t + rng.normal(size=200)}
    mp.regress(table, response="y", variables="t", segment="t:15,25").save(folder / "reg.json")
    loaders = {"cal": mp.load, "reg": mp.load_regression, "check": mp.load_check}
    return {
        name: (json.loads((folder / f"{name}.json").read_text()), load)
        for name, load in loaders.items()
    }


REMOVED = object()


@pytest.mark.parametrize(
    ("name", "place", "value", "message"),
    [
        ("cal", ["created"], "2026\nSM: [0]", r"created is '2026\nSM: [0]'; a text"),
        ("cal", ["multipos_version"], "1\x85", "multipos_version is '1\\x85'"),
        ("cal", ["unit"], "\x1b[31m", "unit is '\\x1b[31m'"),
        ("cal", ["positions", 4], "\u2028", "positions[4] is"),
        ("cal", ["parameters", 3, "u"], "x", "parameters[3].u is 'x'; a number is needed there"),
        ("cal", ["parameters", 3, "u"], REMOVED, "the key 'parameters[3].u' is missing"),
        ("cal", ["parameters", 3, "u"], 1.0, "the squared uncertainties on its diagonal"),
        ("cal", ["budget", "scatter", 0, 0], -1.0, "its budget has a variance below zero"),
        ("cal", ["readings", 2], [0.5], "readings[2] is a list of 1; a list of 3 is needed there"),
        ("cal", ["reference", 2, 1], 1e300, "reference[2][1] is 1e+300"),
        ("cal", ["axes"], ["x", "y"], "not a calibration: --axes names 2 axes for 3 outputs"),
        ("cal", ["outputs"], ["ax", "ay", "ay"], "'residual_sd' names ax, ay, az, not its outputs"),
        ("cal", ["status"], {"converged": True}, "the key 'status.iterations' is missing"),
        ("cal", ["gravity"], {"value": 9.8, "u": -1}, "gravity.u is -1; a number of at least 0"),
        ("cal", ["confidence"], 1.0, "confidence is 1.0; a number of at least 1e-40 and below 1"),
        ("cal", ["estimator"], "x", "one of closed-form, linear, uncertain-orientation"),
        ("cal", ["gauge"], "lower", "its parameters are not those of its model"),
        ("cal", ["model"], "own^9" * 3000, "model is 'own^9own^9"),
        ("cal", ["up", 0, 0], "x", "up[0][0] is 'x'; a number is needed"),
        ("cal", ["robust_weight"], [1.0], "'robust_weight' has shape (1,), but (26,) fits"),
        ("reg", ["edges"], [25.0, 15.0], "not a regression: its edges do not ascend"),
        ("reg", ["edges"], [15.0], "its segments do not fit its edges and branches"),
        ("reg", ["segment_variable"], ["t"], "segment_variable is a list of 1; a text is needed"),
        ("reg", ["segment_variable"], "", "segment_variable is ''; a text that is not empty"),
        (
            "reg",
            ["segments", 0, "terms", 1, "factors"],
            [["t", 2**63, False]],
            "segments[0].terms[1].factors[0][1] is 9.223372036854776e+18; a whole number from 0",
        ),
        (
            "reg",
            ["segments", 0, "terms", 1, "factors"],
            [["q", 1, False]],
            "a segment lacks the limits of a variable of its terms",
        ),
        (
            "reg",
            ["segments", 0, "region", "terms", 1],
            [["t", 2, False]],
            "the terms of a segment's region do not begin with its own",
        ),
        ("reg", ["segments", 0, "limits", "t"], [2.0, 1.0], "limits end before they begin"),
        ("reg", ["segments", 0, "limits", "t"], [2.0], "segments[0].limits.t is a list of 1"),
        ("reg", ["segments", 0, "covariance"], [[1.0]], "of a segment has shape (1, 1)"),
        ("reg", ["segments", 0, "robust"], "hac", "with 'robust' lacks 'covariance_robust'"),
        ("reg", ["segments", 0, "r2"], "1", "segments[0].r2 is '1'; a number is needed there"),
        ("reg", ["rates"], {"t": 20.0}, "it has rates, but no time or column"),
        ("check", ["limit"], "0.01", "limit is '0.01'; a number is needed there"),
        ("check", ["nominal", "scale"], None, "nominal.scale is null; a number is needed there"),
        ("check", ["positions", 1, "after"], {"x": 0.0}, "'after' is of x, not of its axes"),
        ("check", ["positions", 1, "U", "x"], -1.0, "positions[1].U.x is -1.0; a number of at"),
        ("check", ["by_axis"], {}, "'by_axis' is of , not of its axes"),
        ("check", ["positions", 1, "counted", "x"], 1, "positions[1].counted.x is 1; true or"),
    ],
)
def test_a_damaged_file_names_the_key(files, name, place, value, message, tmp_path):
    content, load = files[name]
    content = copy.deepcopy(content)
    inner = content
    for key in place[:-1]:
        inner = inner[key]
    if value is REMOVED:
        del inner[place[-1]]
    else:
        inner[place[-1]] = value
    path = tmp_path / "f.json"
    path.write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(MultiposError) as error:
        load(path)
    assert str(error.value).startswith(f"{path}: ")
    assert message in str(error.value)
    assert str(error.value) == visible(str(error.value))


# --- text that goes to terminals and into reports


def test_names_with_control_characters_are_refused(tmp_path):
    up = np.eye(3)
    for options, message in (
        ({"outputs": ("ax", "a\x1b", "az")}, r"`outputs` 2 is 'a\\u001b', with a control"),
        ({"positions": ("1", "2", "3\n")}, r"`positions` 3 is '3\\u000a'"),
        ({"group": ("\x07", "", "")}, r"`group` 1 is '\\u0007'"),
        ({"environment": {"t\t": np.ones(3)}}, r"`environment` 1 is 't\\u0009'"),
        ({"unit": "V\x9b"}, r"`unit` 1 is 'V\\u009b'"),
    ):
        with pytest.raises(MultiposError, match=message):
            mp.Readings(up, up=up, **options)
    assert mp.Readings(up, up=up, source="a\x1b.csv").source == r"a\u001b.csv"
    (tmp_path / "r.csv").write_text("position,ax\x1b[31m\n1,2\n")
    with pytest.raises(MultiposError, match=r"column 2, 'ax\\u001b\[31m', has a control"):
        mp.read_readings(tmp_path / "r.csv")


def test_tables_show_no_control_characters():
    assert table(["a"], [["x\x1b[31m\n"]]).splitlines()[1] == r"x\u001b[31m\u000a"


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("<script>alert(1)</script>", "&lt;script&gt;alert(1)&lt;/script&gt;"),
        ("&lt;b>", "&amp;lt;b&gt;"),
        ("x*|x|", r"x\*\|x\|"),
        ("`x`", r"\`x\`"),
        ("scale_ax and _x_", r"scale_ax and \_x\_"),
        ("[a](javascript:b)", r"[a\](javascript:b)"),
        ("x [deg]", "x [deg]"),
        ("a\\", "a\\\\"),
        ("-0.5", "-0.5"),
    ],
)
def test_markdown_shows_text_as_it_is(text, shown):
    assert markdown_text(text) == shown


@pytest.mark.parametrize("text", ["# a", "- a", "+ a", "1. a", "12) a", "~~~", "==="])
def test_no_line_of_markdown_begins_a_block(text):
    assert markdown_line(text).lstrip("0123456789")[0] == "\\"
