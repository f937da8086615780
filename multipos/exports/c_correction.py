"""The C99 file of regressions: rates, segments and terms, row by row.

`correction_source` returns the file, `declarations` the state and the functions in it and
`output_line` what its header says of an output; `rounding` is eq. (2).

    NAME_start(&state);                              a run begins
    NAME_correct(&state, time, in, out);             once a row, in the order of time

What one row does is what `multipos.compensation.correction` does of a whole table: rates by eq. (2)
of `multipos.regression.rates`, whose memory is the state; the segment by the edges and the
branch; every variable held where the segment's rows were; then the sum of the segment's terms,

    p = Σ_t b_t φ_t,     out = p, or column − p where a column is corrected,                (1)

and the leverage of the row by eq. (1) of `multipos.regression.region`, summed in the same order.

Rounding leaves of (1) at most

    u (m + d + 4) Σ_t |b_t| max |φ_t|,     u = 2^-53, or 2^-24 in single precision,         (2)

m terms of degree d, the maximum over the segment; a rate adds 2 T/Δt + 4 roundings of its own.
In single precision an edge or a limit is the number beside it on the inner side, so that every
row that single precision can hold falls where it does in Python. Time stays in double precision,
because single precision cannot count the milliseconds of a day.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from multipos import __version__
from multipos.exports.c_body import environment_range, written_factors
from multipos.exports.c_text import Real, Statement, function
from multipos.exports.parts import Correction
from multipos.exports.target import Wish
from multipos.exports.target_c import c_source, comment
from multipos.files.numbers import number
from multipos.numerics.arrays import LARGEST
from multipos.numerics.terms import CONSTANT, Term
from multipos.regression.rates import filter_time
from multipos.regression.regression import Regression
from multipos.regression.segment import Segment
from multipos.sensor.calibration import Calibration
from multipos.uncertainty.validity import applied

_ROUNDING = {False: 2.0**-53, True: 2.0**-24}
STEPS = 5.0  # T/Δt of the default window, 20 rows
_NUMBERS = {False: LARGEST, True: 1e30}  # beyond these an input is no number


def rounding(r: Regression, *, single: bool, steps: float = STEPS) -> float:
    """Return how far C may be from Python in the predicted response, eq. (2); `steps` is T/Δt."""
    return max(_segment_rounding(r, s, single, steps) for s in r.segments)


def _segment_rounding(r: Regression, s: Segment, single: bool, steps: float) -> float:
    largest = {name: np.array(max(map(abs, _limits(r, s)[name]))) for name in s.used}
    total = 0.0
    for b, term in zip(s.values.tolist(), s.terms, strict=True):
        formed = sum(f.degree for f in term.factors if f.variable in r.rates)
        degree = sum(f.degree for f in term.factors)
        roundings = len(s.terms) + degree + 4.0 + formed * (2.0 * steps + 4.0)
        total += roundings * abs(b) * float(term.evaluate(largest))
    return _ROUNDING[single] * total


def _limits(r: Regression, s: Segment) -> dict[str, tuple[float, float]]:
    """Return where the variables of a segment are held, as `correct` holds them."""
    limits = {name: s.limits[name] for name in s.used}
    if r.segment_variable is not None:
        limits[r.segment_variable] = s.range
    return limits


def declarations(c: Correction, name: str, *, single: bool) -> tuple[str, str, str]:
    """Return the type of the state and the two functions, without semicolons after these."""
    kind = "float" if single else "double"
    fields = ["    int started;", "    double time; /* of the last row */"]
    if c.rates:
        size = len(c.rates)
        fields.append(f"    {kind} last[{size}], behind[{size}], rate[{size}];")
    if c.branched:
        fields.append(f"    int cooling[{len(c.branched)}];")
    state = "\n".join(["typedef struct {", *fields, f"}} {name}_state;"])
    start = f"void {name}_start({name}_state *state)"
    correct = (
        f"int {name}_correct({name}_state *state, double time, "
        f"const {kind} in[{len(c.inputs)}], {kind} out[{len(c.regressions)}])"
    )
    return state, start, correct


def correction_source(c: Correction, name: str, *, single: bool) -> str:
    """Return the C99 file, with the calibration's function in front where there is one."""
    before = ""
    if c.calibration is not None:
        before = c_source(c.calibration, Wish(name, single)) + "\n"
    state, start, correct = declarations(c, name, single=single)
    begin = function(start, [f"*state = ({name}_state){{0}};"])
    body = function(correct, _Writer(c, name, single).statements())
    return f"{before}{_header(c, name, single)}\n{state}\n\n{begin}\n{body}"


def _header(c: Correction, name: str, single: bool) -> str:
    lines = [
        f"{name}_correct: one row at a time, after {name}_start at every switch-on.",
        "",
        *(f"in[{i}] = {column}" for i, column in enumerate(c.inputs)),
        *(output_line(c, k) for k in range(len(c.regressions))),
        *(f"time in the unit of '{t}'" for t in dict.fromkeys(r.time for r in c.regressions) if t),
        "returns 0 within what was fitted; 1 beyond it, where variables are held at its limits;",
        "2 where time does not rise, or it or what a rate is of is no number: nothing is changed.",
        "in and out may be the same array.",
        "",
        *(
            f"rate        of {column}, from past rows, as late as a line through the last {w:.6g}"
            for column, w in c.rates
        ),
    ]
    for r in c.regressions:
        lines += _described(r, single)
    lines += ["", f"written by  multipos {__version__}"]
    return "/*\n" + "\n".join(f" * {comment(line)}".rstrip() for line in lines) + "\n */"


def output_line(c: Correction, k: int) -> str:
    """Return what the header says of an output."""
    response = c.regressions[k].response
    what = f"{c.corrected[k]}, corrected by {response}" if c.corrected else f"{response}, predicted"
    return f"out[{k}] = {what}"


def _described(r: Regression, single: bool) -> list[str]:
    lines = [
        f"{r.response}: fitted {r.created} by multipos {r.version} to {r.n} rows",
        f"  precision  {number(rounding(r, single=single), 2)} of {r.response}, by rounding",
    ]
    for s in r.segments:
        span = f"{r.range_variable} {s.range[0]:.6g} to {s.range[1]:.6g}"
        branch = f", {s.branch}" if s.branch else ""
        lines.append(f"  segment    {span}{branch}: {len(s.terms)} terms, rms {number(s.rms, 3)}")
    return lines


class _Writer:
    """Turn a correction into the statements of its function."""

    def __init__(self, c: Correction, name: str, single: bool) -> None:
        self._c, self._name, self._single = c, name, single
        self._real = Real(single)

    def statements(self) -> list[Statement]:
        c = self._c
        body: list[Statement] = [f"const {self._real.kind} x{i} = in[{i}];" for i in self._read()]
        body += ["int beyond = 0;", "", *self._refused()]
        body += [] if self._needs_force else self._moved()
        if c.calibration is not None:
            body += self._compensated(c.calibration)
        for k in range(len(c.regressions)):
            body += self._regression(k)
        return [*body, "return beyond;"]

    def _read(self) -> list[int]:
        """Return the inputs that are read one by one; a calibration reads its own as an array."""
        c = self._c
        names = {*(column for column, _ in c.rates), *c.corrected, *self._sources()}
        names |= {n for r in c.regressions for n in r.needed if n not in r.rates}
        if c.calibration is not None:
            names |= set(c.calibration.model.environment)
        return [i for i, name in enumerate(c.inputs) if name in names]

    def _inside(self, value: float, towards: float) -> str:
        """Return a bound, in single precision the nearest number that is not beyond it."""
        if self._single:
            held = np.float32(value)
            if (float(held) - value) * np.sign(towards) < 0.0:
                held = np.nextafter(held, np.float32(towards))
            value = float(held)
        return self._real.number(value)

    def _expression(self, r: Regression, name: str) -> str:
        """Return what holds a variable of a regression."""
        c = self._c
        if name in r.rates:
            j = c.rates.index((name.removesuffix("_rate"), r.rates[name]))
            return f"state->rate[{j}]"
        return self._column(name)

    def _column(self, name: str) -> str:
        c = self._c
        if name in c.forces:
            return f"force[{c.forces.index(name)}]"
        return f"x{c.inputs.index(name)}"

    def _refused(self) -> list[str]:
        """Write what returns 2: nothing of the state may have been changed by then."""
        tests = [f"!(time > -{LARGEST!r} && time < {LARGEST!r})"]
        most = self._real.number(_NUMBERS[self._single])
        for source in self._sources():
            x = self._column(source)
            tests.append(f"!({x} > -{most} && {x} < {most})")
        tests.append("state->started && !(time > state->time)")
        return [f"if ({test}) return 2;" for test in tests]

    def _sources(self) -> list[str]:
        """Return the inputs that rates are made of."""
        c = self._c
        names = [name for name, _ in c.rates]
        if c.calibration is not None and self._needs_force:
            names += [*c.calibration.outputs, *c.calibration.model.environment]
        return [name for name in dict.fromkeys(names) if name in c.inputs]

    @property
    def _needs_force(self) -> bool:
        return any(column in self._c.forces for column, _ in self._c.rates)

    def _moved(self) -> list[Statement]:
        """Write eq. (2) of the rates, and the memory of the row."""
        c, kind = self._c, self._real.kind
        lines: list[Statement] = []
        if c.rates:
            span = "(float)(time - state->time)" if self._single else "time - state->time"
            inner = [f"const {kind} dt = {span};"]
            windows = list(dict.fromkeys(w for _, w in c.rates))
            for w, window in enumerate(windows):
                one, T = self._real.number(1.0), self._real.number(filter_time(window))
                inner.append(f"const {kind} s{w} = {one} / ({T} + dt);")
            for j, (column, window) in enumerate(c.rates):
                s, x = f"s{windows.index(window)}", self._column(column)
                inner += [
                    f"const {kind} a{j} = state->behind[{j}] + ({x} - state->last[{j}]);",
                    f"const {kind} m{j} = a{j} * dt * {s};",
                    f"state->behind[{j}] = a{j} - m{j};",
                    f"state->rate[{j}] += (m{j} - state->rate[{j}] * dt) * {s};",
                ]
            lines.append(("if (state->started)", inner))
        for j, (column, _) in enumerate(c.rates):
            lines.append(f"state->last[{j}] = {self._column(column)};")
        return [*lines, "state->time = time;", "state->started = 1;"]

    def _compensated(self, calibration: Calibration) -> list[Statement]:
        kind, c = self._real.kind, self._c
        environment = calibration.model.environment
        lines: list[Statement] = [f"{kind} force[{len(c.forces)}];"]
        if environment:
            lines.append(f"{kind} env[{len(environment)}];")
            for j, name in enumerate(environment):
                lines.append(f"env[{j}] = {self._column(name)};")
                lines += self._held(f"env[{j}]", environment_range(calibration, name))
        env = "env, " if environment else ""
        lines.append(f"{self._name}_compensate(in, {env}force);")
        lines += self._force_beyond(calibration)
        return lines + (self._moved() if self._needs_force else [])

    def _force_beyond(self, calibration: Calibration) -> list[str]:
        """Write what tells forces that were not applied, as `apply` does."""
        seen, axes = applied(calibration), list(calibration.model.sensed_axes)
        number = self._real.number
        squares = " + ".join(f"force[{i}] * force[{i}]" for i in range(len(axes)))
        limits = [number(seen.limit(size) ** 2) for size in (seen.sphere, seen.largest)]
        tests = [f"size <= {limits[0]}"]
        if seen.sphere != seen.largest:
            sides = zip(*map(np.ndarray.tolist, seen.box(axes)), strict=True)
            box = [
                f"force[{i}] >= {number(low)} && force[{i}] <= {number(high)}"
                for i, (low, high) in enumerate(sides)
            ]
            tests.append(f"(size <= {limits[1]} && {' && '.join(box)})")
        test = " || ".join(tests)
        return [f"const {self._real.kind} size = {squares};", f"if (!({test})) beyond = 1;"]

    def _held(self, name: str, limits: tuple[float, float]) -> list[str]:
        low, high = self._inside(limits[0], np.inf), self._inside(limits[1], -np.inf)
        return [
            f"if (!({name} >= {low})) {{ {name} = {low}; beyond = 1; }}",
            f"else if ({name} > {high}) {{ {name} = {high}; beyond = 1; }}",
        ]

    def _regression(self, k: int) -> list[Statement]:
        """Write the prediction of a regression, and its output."""
        c, r = self._c, self._c.regressions[k]
        lines: list[Statement] = ["", f"{self._real.kind} p{k};"]
        segments = len(r.edges) + 1
        if r.branch_column is None:
            lines.append(self._chain(k, r.segments))
        else:
            b = c.branched.index(k)
            rate = self._expression(r, r.branch_column)
            zero = self._real.number(0.0)
            heating, cooling = r.segments[:segments], r.segments[segments:]
            lines += [
                f"if ({rate} > {zero}) state->cooling[{b}] = 0;",
                f"if ({rate} < {zero}) state->cooling[{b}] = 1;",
                (
                    f"if (!state->cooling[{b}])",
                    [self._chain(k, heating)],
                    "else",
                    [self._chain(k, cooling)],
                ),
            ]
        value = f"{self._column(c.corrected[k])} - p{k}" if c.corrected else f"p{k}"
        return [*lines, f"out[{k}] = {value};"]

    def _chain(self, k: int, segments: Sequence[Segment]) -> Statement:
        """Write the segments of one branch, each behind the edge above it."""
        r = self._c.regressions[k]
        edges = r.edges if r.segment_variable is not None else ()
        tests = [
            f"if ({self._expression(r, str(r.segment_variable))} < {self._inside(edge, np.inf)})"
            for edge in edges
        ]
        chain: list[Any] = []
        for i, s in enumerate(segments[: len(edges) + 1]):
            head = " ".join(["else"] * bool(i) + tests[i : i + 1])
            chain += [head, self._segment(k, s)]
        return tuple(chain)

    def _segment(self, k: int, s: Segment) -> list[str]:
        r, kind = self._c.regressions[k], self._real.kind
        lines = []
        variables: dict[str, str] = {}
        for name, limits in _limits(r, s).items():
            variables[name] = f"v{len(variables)}"
            lines.append(f"{kind} {variables[name]} = {self._expression(r, name)};")
            lines += self._held(variables[name], limits)
        every = s.terms if s.region is None else s.region.terms
        rows = [] if s.region is None else s.region.factor.tolist()
        entries = [[(g, t) for g, t in zip(row, every, strict=True) if g] for row in rows]
        values = [(b, t) for b, t in zip(s.values.tolist(), s.terms, strict=True) if b]
        used = {term for row in (values, *entries) for _, term in row}
        names: dict[Term, str] = {CONSTANT: ""}
        for term in filter(used.__contains__, dict.fromkeys(every)):
            factors = written_factors(term, variables, self._single)
            if len(factors) > 1:
                names[term] = f"t{len(names)}"
                lines.append(f"const {kind} {names[term]} = {' * '.join(factors)};")
            else:  # no factor is left of a power of 0
                names[term] = "".join(factors)
        lines.append(f"p{k} = {self._sum(values, names)};")
        for i, row in enumerate(entries):  # summed as `Region.leverage` does
            lines.append(f"{'' if i else f'{kind} '}z = {self._sum(row, names)};")
            lines.append("h += z * z;" if i else f"{kind} h = z * z;")
        if s.region is not None:
            lines.append(f"if (h > {self._real.number(s.region.limit)}) beyond = 1;")
        return lines

    def _sum(self, parts: Iterable[tuple[float, Term]], names: Mapping[Term, str]) -> str:
        return self._real.sum((value, names[term]) for value, term in parts)
