"""C of regressions against Python: rates, segments, branches and limits, row by row."""

import shutil
import subprocess
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from consumers import fill, fitted_rows, replay
from test_exporters import SANITIZERS, WARNINGS, made

import multipos as mp
from multipos.errors import MultiposError, UsageError
from multipos.exports.c_correction import _Writer, declarations
from multipos.exports.parts import Correction
from multipos.exports.target_correction import (
    Drive,
    expected_rows,
)
from multipos.numerics.terms import parse_terms

ROWS = 100_000


def chamber(seed=1, n=600):
    """A run over temperature: heating, cooling, an error that knows both and the voltage."""
    rng = np.random.default_rng(seed)
    time = 0.5 * np.arange(float(n)) + rng.uniform(0.0, 0.1, n)
    device = 10.0 + 40.0 * np.sin(2 * np.pi * time / 150.0)
    rate = 40.0 * 2 * np.pi / 150.0 * np.cos(2 * np.pi * time / 150.0)
    force = np.array([1.0, -1.0, 0.0])[(time // 4.0).astype(int) % 3]
    error = 0.02 + 5e-4 * device + 4e-6 * device**2 + 1e-3 * rate + 1e-4 * device * force
    error += np.where(rate > 0, 2e-4 * device, 0.0) + rng.normal(0.0, 2e-4, n)
    columns = {"time": time, "V": force + error, "temperature": device, "error": error}
    return {name: np.round(column, 6) for name, column in columns.items()}


VARIABLES = "V,temperature,temperature_rate"
MODELS = {
    "rates and segments": {"variables": VARIABLES, "degree": 2, "segment": "temperature:-10.1,20"},
    "segments": {"variables": "V,temperature", "segment": "temperature:10"},
    "segments of a rate": {"variables": VARIABLES, "segment": "temperature_rate:-0.3,0.4"},
    "no rates": {"variables": "V,temperature", "degree": 3, "stepwise": True},
    "a modulus": {"terms": "1 + temperature + |temperature| + V*|temperature|"},
    "no constant": {"terms": "V + temperature^2"},
}


def fitted(name, seed=1):
    if name == "branches":
        return branched(fitted("segments", seed))
    return mp.regress(chamber(seed), response="error", causal=True, rate_window=5.0, **MODELS[name])


def branched(r):
    """Return a regression as a file of version 0.2 holds one of heating and one of cooling."""
    heating = [replace(s, branch="heating") for s in r.segments]
    cooling = [replace(s, branch="cooling", values=0.9 * s.values) for s in r.segments]
    rates = {"temperature_rate": 5.0}
    both = (*heating, *cooling)
    return replace(r, segments=both, branch_column="temperature_rate", rates=rates, time="time")


def drive(c, rows=ROWS):
    """Rows that wander over and beyond what was fitted, at steps of any length."""
    rng = np.random.default_rng(7)
    time = np.cumsum(rng.uniform(0.1, 1.0, rows))
    run = np.arange(rows) // (rows // 4)
    columns = []
    for name in c.inputs:
        if name == "temperature":
            swing = 60.0 * np.sin(time / 40.0) + 5.0 * np.sin(time / 3.0)
            columns.append(10.0 + swing)
        else:
            columns.append(rng.uniform(-1.3, 1.3, rows))
    return Drive(run, time, np.column_stack(columns))


def program(folder, compiler, c, text, name, single, *options):
    if shutil.which(compiler) is None:
        pytest.skip(f"no {compiler} on this machine")
    state, start, correct = declarations(c, name, single=single)
    main_c = fill(
        "run_correction.c",
        name=name,
        state=state,
        start=start,
        correct=correct,
        kind="float" if single else "double",
        columns=len(c.inputs) + 2,
        inputs=len(c.inputs),
        outputs=len(c.regressions),
    )
    (folder / "main.c").write_text(main_c)
    (folder / "export.c").write_text(text)
    command = [compiler, *WARNINGS, "-O2", *options, "main.c", "export.c", "-o", "run"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return folder / "run"


def replayed(folder, compiler, c, text, rows, *, single, options=()):
    run = program(folder, compiler, c, text, "multipos", single, *options)
    table = np.column_stack([rows.begins.astype(float), rows.time, rows.values])
    (folder / "readings").write_bytes(table.tobytes())
    subprocess.run([run], cwd=folder, check=True)
    back = np.frombuffer((folder / "forces").read_bytes())
    return back.reshape(-1, len(c.regressions) + 1)


@pytest.mark.parametrize(
    ("name", "compiler"),
    [(name, ("gcc", "clang")[i % 2]) for i, name in enumerate([*MODELS, "branches"])]
    + [("rates and segments", "clang")],
)
def test_c_is_apply(tmp_path, compiler, name):
    """1e-12 of the largest output over 1e5 rows, 4 runs, steps of any length, 0 and 1 alike."""
    # eq. (1) of exports.c_correction
    regression = fitted(name)
    exported = mp.export(regression, "c")
    c = Correction(None, (regression,))
    rows = drive(c, ROWS if name == "rates and segments" else ROWS // 10)
    out, beyond, certain = expected_rows(c, rows, single=False)
    back = replayed(
        tmp_path, compiler, c, exported.text, rows, single=False, options=SANITIZERS[compiler]
    )
    assert certain.mean() > 0.999
    assert 0.05 < beyond.mean() < 0.95  # both sides are met
    np.testing.assert_array_equal(back[certain, 0], beyond[certain])
    np.testing.assert_allclose(
        back[certain, 1:], out[certain], rtol=0, atol=1e-12 * np.abs(out).max()
    )


@pytest.mark.parametrize("name", ["rates and segments", "branches", "no rates"])
def test_single_precision_keeps_its_figure(tmp_path, name):
    """The file verifies itself by the figure in its header; here the figure is not idle either."""
    # eq. (2) of exports.c_correction
    regression = fitted(name)
    found = replay(Correction(None, (regression,)), single=True)
    assert 0.0 < found.difference.max() <= found.allowed.max() < 1e-5


@pytest.mark.parametrize(
    ("compiler", "single", "rate"),
    [("gcc", False, "temperature_rate"), ("clang", True, "temperature_rate,f_{}_rate")],
)
def test_three_axes_behind_a_calibration(tmp_path, compiler, single, rate):
    """The compensated forces are what is corrected, and variables of it, as are their rates."""
    calibration = made("1 + x + y + z + temperature", "xyz", 1e-3, 0.3)
    columns = chamber()
    fits = []
    for axis in "xyz":
        force = {f"f_{axis}": columns["V"], f"e{axis}": columns["error"]}
        fits.append(
            mp.regress(
                columns | force,
                response=f"e{axis}",
                variables=f"f_{axis},temperature,{rate.format(axis)}",
                degree=2,
                causal=True,
            )
        )
    parts = [calibration, *fits]
    correct = ("f_x", "f_y", "f_z")
    exported = mp.export(parts, "c", correct=correct, float=single)
    assert exported.text.count("void multipos_compensate(") == 1
    (tmp_path / "export.c").write_text(exported.text)
    (tmp_path / "export_test.c").write_text(exported.test)
    if shutil.which(compiler) is None:
        pytest.skip(f"no {compiler} on this machine")
    command = [compiler, *WARNINGS, *SANITIZERS[compiler], "export.c", "export_test.c", "-o", "t"]
    subprocess.run([*command, "-lm"], cwd=tmp_path, check=True)
    said = subprocess.run([tmp_path / "t"], capture_output=True, text=True, check=False)
    assert said.stdout == "multipos_correct: all values met\n"
    # the same by hand: apply, then correct
    c = Correction(calibration, tuple(fits), correct)
    assert c.inputs == ("a1", "a2", "a3", "temperature")
    rng = np.random.default_rng(3)
    values = np.column_stack([rng.uniform(-0.5, 0.5, (400, 3)), rng.uniform(0.0, 40.0, 400)])
    rows = Drive(np.zeros(400, int), np.arange(400.0), values)
    table = {**dict(zip(c.inputs, values.T, strict=True)), "time": rows.time}
    applied = dict(mp.apply(calibration, table, outside="clamp"))
    del applied["outside"]
    for k, (fit, name) in enumerate(zip(fits, correct, strict=True)):
        by_hand = mp.correct(fit, applied, column=name, outside="clamp")["corrected"]
        out = expected_rows(c, rows, single=False).out[:, k]
        np.testing.assert_allclose(out, by_hand, rtol=0, atol=1e-15)


@pytest.mark.parametrize("compiler", ["gcc", "clang"])
def test_three_regressions_in_one_file_compile_without_a_warning(tmp_path, compiler):
    """Also where the region of a segment has a term in no sum, or one twice, as a file may say."""
    if shutil.which(compiler) is None:
        pytest.skip(f"no {compiler} on this machine")
    fits = [fitted("rates and segments", seed) for seed in (1, 2)] + [fitted("a modulus")]
    segments = []
    for s in fits[0].segments:
        terms = (*s.region.terms, term("V^2*temperature^2"), term("V*temperature"))
        none = np.zeros(len(s.region.factor))
        factor = np.column_stack([s.region.factor, none, none + 1e-6])
        segments.append(replace(s, region=replace(s.region, terms=terms, factor=factor)))
    fits[0] = replace(fits[0], segments=tuple(segments))
    exported = mp.export(fits, "c")
    (tmp_path / "export.c").write_text(exported.text)
    (tmp_path / "export_test.c").write_text(exported.test)
    flags = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic"]
    command = [compiler, *flags, "export.c", "export_test.c", "-o", "t"]
    subprocess.run(command, cwd=tmp_path, check=True)
    said = subprocess.run([tmp_path / "t"], capture_output=True, text=True, check=False)
    assert said.stdout == "multipos_correct: all values met\n"


def test_rows_of_the_fit_are_replayed():
    regression = mp.regress(
        chamber(), response="error", variables=VARIABLES, causal=True, rate_window=5
    )
    for corrected in ((), ("V",)):
        found = replay(Correction(None, (regression,), corrected), data=chamber())
        assert found.rows == 600
        assert found.difference <= found.allowed < 2e-12


@pytest.mark.parametrize("single", [False, True])
def test_an_edge_belongs_to_the_segment_above(tmp_path, single):
    """Ten degrees, and the number just below."""
    regression = fitted("segments")
    c = Correction(None, (regression,))
    number = np.float32 if single else np.float64
    values = np.full((2, len(c.inputs)), 0.5)
    at = number(10.0), np.nextafter(number(10.0), number(-1.0))
    values[:, c.inputs.index("temperature")] = at
    rows = Drive(np.zeros(2, int), np.arange(2.0), values)
    text = mp.export(regression, "c", float=single).text
    back = replayed(tmp_path, "gcc", c, text, rows, single=single)
    out = expected_rows(c, rows, single=single).out
    np.testing.assert_allclose(back[:, 1:], out, rtol=0, atol=1e-6 if single else 1e-14)


def test_time_that_does_not_rise_leaves_the_state(tmp_path):
    regression = fitted("rates and segments")
    c = Correction(None, (regression,))
    text = mp.export(regression, "c").text
    rows = drive(c, 8)
    values = rows.values.copy()
    values[5, c.inputs.index("temperature")] = np.nan
    time = rows.time.copy()
    time[3] = time[2]
    time[6] = np.nan
    begins = Drive(np.zeros(8, int), time, values)
    back = replayed(tmp_path, "gcc", c, text, begins, single=False)
    assert back[[3, 5, 6], 0].tolist() == [2.0, 2.0, 2.0]
    kept = [0, 1, 2, 4, 7]
    clean = Drive(np.zeros(5, int), time[kept], values[kept])
    out = expected_rows(c, clean, single=False).out
    np.testing.assert_allclose(back[kept, 1], out[:, 0], rtol=0, atol=1e-14)


def test_cost_of_a_row(tmp_path):
    """Instructions, not seconds: no more than a tenth above C written by hand for this model.

    The region of q terms adds q(q + 1) to each segment: 1.7 to 2.5 times the time of a row.
    """
    if shutil.which("gcc") is None:
        pytest.skip("no gcc on this machine")
    regression = fitted("rates and segments")
    c = Correction(None, (regression,))
    ours = mp.export(regression, "c").text
    regions = sum(len(s.region.terms) * (len(s.region.terms) + 1) for s in regression.segments)
    hand = operations(tmp_path, "gcc", by_hand(c))
    assert operations(tmp_path, "gcc", ours) <= 1.1 * hand + regions


def by_hand(c):
    """The same model as one would write it: a rate, three segments, ten terms each, clamped."""
    (r,) = c.regressions
    lines = [
        "typedef struct { int started; double time, last, behind, rate; } S;",
        "void hand_start(S *s) { s->started = 0; s->rate = 0; s->behind = 0; }",
        "int hand(S *s, double time, const double *in, double *out) {",
        "double T = in[1], dT, V = in[0], p; int bad = 0;",
        "if (s->started) { if (!(time > s->time)) return 2;",
        "double dt = time - s->time, g = 1.0 / (1.25 + dt), a = s->behind + T - s->last;",
        "double m = a * dt * g; s->behind = a - m; s->rate += (m - s->rate * dt) * g; }",
        "s->last = T; s->time = time; s->started = 1; dT = s->rate;",
    ]
    names = {"V": "V", "temperature": "T", "temperature_rate": "dT"}
    for i, s in enumerate(r.segments):
        lines.append(
            ("if" if i == 0 else "else if") + f" (T < {r.edges[i]!r}) {{" if i < 2 else "else {"
        )
        for name, short in names.items():
            low, high = s.range if name == "temperature" else s.limits[name]
            lines.append(f"if (!({short} >= {low!r})) {{ {short} = {low!r}; bad = 1; }}")
            lines.append(f"else if ({short} > {high!r}) {{ {short} = {high!r}; bad = 1; }}")
        products = [
            "*".join([repr(b), *(names[f.variable] for f in t.factors for _ in range(f.power))])
            for b, t in zip(s.values.tolist(), s.terms, strict=True)
        ]
        lines.append(f"p = {' + '.join(products)}; }}")
    return "\n".join([*lines, "*out = p; return bad; }"])


def operations(folder, compiler, text):
    """Floating-point instructions in the compiled text."""
    (folder / "one.c").write_text(text)
    command = [compiler, "-std=c99", "-O2", "-S", "one.c", "-o", "one.s"]
    subprocess.run(command, cwd=folder, check=True)
    words = [
        line.split()[0] for line in (folder / "one.s").read_text().splitlines() if line.split()
    ]
    return sum(
        word.startswith(("mul", "add", "sub", "div", "fmul", "fadd", "fsub")) for word in words
    )


# --- refusals


def test_rates_from_later_rows_are_refused():
    smooth = mp.regress(chamber(), response="error", variables=VARIABLES)
    with pytest.raises(MultiposError, match="fit it again with --causal"):
        mp.export(smooth, "c")


def test_options_that_contradict():
    regression = fitted("no rates")
    calibration = made("linear", "xyz", 0.0, 0.3)
    with pytest.raises(UsageError, match="exported --to c"):
        mp.export(regression, "px4")
    with pytest.raises(UsageError, match="names 2 columns for 1 regressions"):
        mp.export(regression, "c", correct="V,error")
    with pytest.raises(UsageError, match="--correct goes with a regression"):
        mp.export(calibration, "c", correct="V")
    with pytest.raises(UsageError, match="comes before the regressions"):
        mp.export([regression, calibration], "c")
    with pytest.raises(UsageError, match="no C identifier"):
        mp.export(regression, "c", name="a b")


def test_rows_of_the_fit_may_have_gaps():
    columns = chamber()
    columns["V"][5] = np.nan
    regression = mp.regress(
        columns, response="error", variables=VARIABLES, causal=True, drop_missing=True
    )
    from multipos.files.tables import read_table

    rows = fitted_rows(Correction(None, (regression,)), read_table(columns, what="data"))
    assert len(rows.time) == 599


# --- the recursion


def test_each_run_starts_at_rest(tmp_path):
    one, two = chamber(1, 100), chamber(2, 100)
    both = {name: np.concatenate([one[name], two[name]]) for name in one}
    both["run"] = np.repeat(["a", "b"], 100)
    options = {"response": "error", "variables": VARIABLES, "rate_window": 5.0, "causal": True}
    regression = mp.regress(both, run="run", **options)
    alone = mp.correct(regression, {name: column[100:] for name, column in both.items()})
    together = mp.correct(regression, both)
    np.testing.assert_array_equal(alone["predicted"], together["predicted"][100:])
    with pytest.raises(MultiposError, match=r"does not increase at row 101.*--run"):
        mp.regress(both, **options)
    regression.save(tmp_path / "reg.json")
    assert mp.load_regression(tmp_path / "reg.json") == regression


@pytest.mark.parametrize(("value", "towards"), [(0.1, 1.0), (0.1, -1.0), (0.7, 1.0), (0.7, -1.0)])
def test_a_bound_in_single_precision_is_the_nearest_that_is_inside(value, towards):
    """Of doubles .1 is below and .7 above its nearest in single precision."""
    near = np.float32(value) + np.spacing(np.float32(value)) * np.arange(-1, 2, dtype=np.float32)
    inside = [float(x) for x in near if (float(x) - value) * towards >= 0.0]
    writer = SimpleNamespace(_single=True, _real=SimpleNamespace(number=float))
    wanted = min(inside, key=lambda x: abs(x - value))
    assert _Writer._inside(writer, value, towards) == wanted
    writer._inside = lambda *given: _Writer._inside(writer, *given)
    lower, upper = _Writer._held(writer, "t", (value, value))
    assert f"t = {wanted};" in (lower if towards > 0.0 else upper)


def term(text):
    (found,) = parse_terms(text)
    return found
