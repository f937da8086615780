"""Regression: the result of `multipos.regress`.

The rows are cut into segments, ranges of one variable, and where heating and cooling differ, by the
sign of a rate; each has a model of its own (`multipos.regression.segment`). The result is complete
when it is made and never changes.

Regressions of several responses, one for each axis, on the same columns.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import field
from typing import Any

import numpy as np

from multipos.errors import MultiposError
from multipos.files.numbers import chance, number, p_in_words, table, uncertain
from multipos.files.spelling import StrPath
from multipos.files.trees import to_json
from multipos.files.whole import write_text
from multipos.finding import Findings, about, in_order
from multipos.numerics.arrays import Array, Environment, Mask, Places
from multipos.numerics.selection import Tested
from multipos.regression.branches import branch_of
from multipos.regression.junctions import Junction
from multipos.regression.segment import Segment
from multipos.regression.segmentation import segment_of
from multipos.results import Result, Tabular, frozen, stacked


@frozen
class Balance(Result):
    """What a regression predicts in thermal balance.

    Attributes
    ----------
    variable : str
        The temperature.
    at, predicted, U : (n,) arrays
    outside : (n,) array of bool
        Whether that is beyond what was measured.
    """

    variable: str
    at: Array
    predicted: Array
    U: Array
    outside: Mask

    def rows(self) -> list[dict[str, Any]]:
        """Return the points, one by one."""
        columns = (self.at, self.predicted, self.U, self.outside)
        names = (self.variable, "predicted", "U", "outside")
        points = zip(*(column.tolist() for column in columns), strict=True)
        return [dict(zip(names, point, strict=True)) for point in points]


@frozen
class Regression(Result, Tabular):
    """Piecewise regression of one column on others, with its tests.

    Attributes
    ----------
    response : str
    variables : tuple of str
    candidates : tuple of str
        The terms that could be in the model.
    method : str
        'full' or 'stepwise'; of version 0.2 also 'backward' or 'subsets'.
    segments : tuple of Segment
        Branch by branch, each by ascending range.
    segment_variable : str or None
    edges : tuple of float
    continuous : bool
    branch_column : str or None
        The rate whose sign tells heating from cooling, in a file of version 0.2.
    time : str or None
    rates : mapping of str to float
        Columns formed from the time column, with the window of each.
    causal : bool
        Whether rates are from the rows up to each, as the exported C forms them.
    run : str or None
        The column that tells one switch-on from another.
    junctions : tuple of Junction
        The jump at every edge of segments that were fitted apart.
    balance : Balance or None
        Predictions in thermal balance, where rates are among the variables.
    confidence : float
    n, dropped : int
    findings : tuple of Finding
    source, sha256, created, version : str or None

    Examples
    --------
    >>> import numpy as np
    >>> import multipos as mp
    >>> T = np.linspace(-20.0, 60.0, 81)
    >>> table = {"T": T, "error": 0.01 + 5e-4 * T + 1e-4 * np.sin(7.0 * T)}
    >>> found = mp.regress(table, response="error", variables="T")
    >>> found.variables, found.n
    (('T',), 81)
    >>> bool(abs(found.predict({"T": [20.0]})[0] - 0.02) < 1e-4)
    True
    """

    response: str
    variables: tuple[str, ...]
    candidates: tuple[str, ...]
    method: str
    segments: tuple[Segment, ...]
    segment_variable: str | None
    edges: tuple[float, ...]
    continuous: bool
    time: str | None
    rates: Mapping[str, float]
    confidence: float
    n: int
    dropped: int
    source: str | None = field(compare=False)
    sha256: str | None
    created: str = field(compare=False)
    version: str
    thresholds: Mapping[str, float] = field(default_factory=dict)
    causal: bool = False
    run: str | None = None
    branch_column: str | None = None
    junctions: tuple[Junction, ...] = ()
    findings: Findings = ()
    balance: Balance | None = None

    def segment_of(self, columns: Mapping[str, Array], run: Places | None = None) -> Places:
        """Return the number of the segment of every row of columns (n,), of numbered runs."""
        n = len(next(iter(columns.values())))
        place = np.zeros(n, dtype=np.intp)
        if self.segment_variable is not None:
            place = segment_of(columns[self.segment_variable], self.edges)
        if self.branch_column is not None:
            place = place + branch_of(columns[self.branch_column], run) * (len(self.edges) + 1)
        return place

    @property
    def range_variable(self) -> str:
        """The variable that the segments' ranges are of."""
        return self.segment_variable or self.variables[0]

    @property
    def needed(self) -> tuple[str, ...]:
        """Columns that a prediction needs."""
        names = [name for s in self.segments for name in s.used]
        return tuple(
            dict.fromkeys(
                name for name in (*names, self.segment_variable, self.branch_column) if name
            )
        )

    def predict(self, columns: Environment) -> Array:
        """Return the response (n,) that the model expects.

        Parameters
        ----------
        columns : mapping of str to (n,) array
            At least `needed`.
        """
        given = {name: np.asarray(column, dtype=np.float64) for name, column in columns.items()}
        # Imported here, for that module is about regressions and so imports this one.
        from multipos.regression.prediction import predict_rows

        return predict_rows(self, given, self.segment_of(given))

    def columns(self) -> dict[str, Any]:
        """Return the terms: segment, term, value, u, t, p."""
        terms = [(i, c) for i, s in enumerate(self.segments, start=1) for c in s.coefficients]
        names = ("term", "value", "u", "t", "p")
        listed = {key: [getattr(c, key) for _, c in terms] for key in names}
        return {"segment": [i for i, _ in terms], **listed}

    def to_dict(self) -> dict[str, Any]:
        """Return everything as what JSON can carry, keys as in the formats reference."""
        # Imported here, for the file's module makes regressions and so imports this one.
        from multipos.regression.regression_file import regression_dict

        return regression_dict(self)

    def save(self, path: StrPath) -> None:
        """Write the regression as JSON, whole or not at all."""
        write_text(path, to_json(self.to_dict()))

    def __str__(self) -> str:
        return "\n".join(_text(self))


def format_span(variable: str, span: tuple[float, float], branch: str | None) -> str:
    """Return a segment in words."""
    text = f"{variable} {number(span[0], 5)} to {number(span[1], 5)}"
    return text if branch is None else f"{text}, {branch}"


def _text(r: Regression) -> list[str]:
    lines = [*_outline(r), *_jumps(r), *_balanced(r), "", _overview(r)]
    for i, segment in enumerate(r.segments, start=1):
        span = format_span(r.range_variable, segment.range, segment.branch)
        lines += ["", f"Segment {i}: {span}", *_segment_text(segment), *_runs_text(segment)]
        if segment.left_out:
            lines.append(f"left out: {', '.join(one.term for one in segment.left_out)}")
        last = i == len(r.segments) or r.segments[i].branch != segment.branch
        if last or not r.continuous:  # segments fitted together share their path
            lines += _path_text(segment)
    return lines


def _outline(r: Regression) -> list[str]:
    """Say of what the regression is made."""
    counted = f"{r.n} rows" + (f", {r.dropped} dropped" if r.dropped else "")
    limits = ", ".join(f"{k} {v:g}" for k, v in r.thresholds.items())
    method = f"{r.method} ({limits})" if limits else r.method
    lines = [
        f"response   {r.response}, {counted}",
        f"terms      {len(r.candidates)} candidates, {method}",
    ]
    past = ", of past rows" if r.causal else ""
    lines += [f"rate       {name}: window {w:.6g}{past}" for name, w in r.rates.items()]
    if r.edges:
        edges = ", ".join(f"{edge:.6g}" for edge in r.edges)
        joined = ", continuous" if r.continuous else ""
        lines.append(f"edges      {r.segment_variable} = {edges}{joined}")
    return lines


def _jumps(r: Regression) -> list[str]:
    """Say by how much segments differ where they meet."""
    lines = []
    for j in r.junctions:
        where = f"{r.segment_variable} = {j.edge:.6g}" + (f", {j.branch}" if j.branch else "")
        lines.append(f"jump       at {where}: up to {uncertain(j.jump, j.u)}, U {number(j.U, 2)}")
    return lines


def _balanced(r: Regression) -> list[str]:
    """Say what is predicted where nothing heats or cools."""
    if r.balance is None:
        return []
    b, inside = r.balance, ~r.balance.outside
    if not inside.any():
        return ["balance    at rate 0 nothing was measured: every prediction there is outside"]
    low, high = (
        number(float(v), 4) for v in (b.predicted[inside].min(), b.predicted[inside].max())
    )
    said = f"balance    at rate 0: {low} to {high}, U up to {number(float(b.U[inside].max()), 2)}"
    beyond = int(b.outside.sum())
    return [said + (f"; {beyond} of {len(b.at)} temperatures are outside" if beyond else "")]


def _overview(r: Regression) -> str:
    robust = any(s.robust is not None for s in r.segments)
    header = [
        "segment",
        "n",
        "k",
        "dof",
        "R²",
        "rms",
        "PRESS",
        "AICc",
        "F",
        f"F_{r.confidence:g}",
        *(["F_robust", "p_robust"] if robust else []),
        "significant",
    ]
    rows = []
    for i, s in enumerate(r.segments, start=1):
        row = [
            str(i),
            str(s.n),
            str(s.dof[0]),
            str(s.dof[1]),
            number(s.r2),
            number(s.rms),
            number(s.press),
            number(s.aicc, 5),
            number(s.F),
            f"{s.F_critical:.4f}",
        ]
        if robust:
            row += ["-", "-"] if s.robust is None else [number(s.robust.F), chance(s.robust.p)]
        rows.append([*row, "yes" if s.significant else "no"])
    return table(header, rows)


def _segment_text(s: Segment) -> list[str]:
    robust = s.robust is not None
    header = ["term", "value(u)", "t", "p", *(["u_robust", "p_robust"] if robust else [])]
    rows = [
        [
            c.term,
            uncertain(c.value, c.u),
            number(c.t),
            chance(c.p),
            *([number(c.u_robust, 2), chance(c.p_robust)] if robust else []),
        ]
        for c in s.coefficients
    ]
    return [table(header, rows)]


def _tested_text(tested: Tested) -> str:
    return f"{tested.term} (F = {number(tested.F)}, {p_in_words(tested.p)})"


def _runs_text(s: Segment) -> list[str]:
    """Say by what runs differ."""
    if s.between is None:
        return []
    b = s.between
    listed = f"between {b.runs} runs: the constant by {b.sd:.2g} (sd on {b.runs - 1} dof)"
    if b.slope_sd is not None:
        listed += f", the slope of {b.variable} by {b.slope_sd:.2g}"
    return [listed]


def _path_text(s: Segment) -> list[str]:
    lines = []
    if s.path:
        steps = [
            [
                str(x.step),
                f"{'+' if x.action == 'add' else '-'}{x.term}",
                number(x.F, 6),
                chance(x.p),
                "" if x.runner_up is None else _tested_text(x.runner_up),
            ]
            for x in s.path
        ]
        lines += ["", table(["step", "term", "F", "p", "runner-up"], steps, left=2)]
    if s.runner_up is not None:
        lines.append(
            f"next: {s.runner_up.term}, F = {number(s.runner_up.F)} where "
            f"{number(s.F_to_enter)} is needed, {p_in_words(s.runner_up.p)}"
        )
    return lines


def require_same_data(r: Regression, source: str, sha256: str | None) -> None:
    """Refuse a file that is not the one that a regression was fitted to, by its checksum."""
    if r.sha256 is not None and r.sha256 != sha256:
        raise MultiposError(
            f"{source}: not the data that the regression of '{r.response}' was fitted to "
            f"({r.source}), by its checksum; give it where it is one file, or leave out --data."
        )


@frozen
class Regressions(Result, Tabular, Mapping[str, Regression]):
    """Regressions by the response that each describes: ``found["error_x"]``.

    Attributes
    ----------
    responses : mapping of str to Regression

    Examples
    --------
    >>> import numpy as np
    >>> import multipos as mp
    >>> T = np.linspace(-20.0, 60.0, 81)
    >>> hum = 1e-4 * np.sin(7.0 * T)
    >>> table = {"T": T, "zero_x": 0.01 + 5e-4 * T + hum, "zero_y": 0.02 - 1e-4 * T + hum}
    >>> found = mp.regress(table, response="zero_x,zero_y", variables="T")
    >>> list(found.responses), found["zero_x"].response
    (['zero_x', 'zero_y'], 'zero_x')
    """

    responses: Mapping[str, Regression]

    def __getitem__(self, response: str) -> Regression:
        return self.responses[response]

    def __iter__(self) -> Iterator[str]:
        return iter(self.responses)

    def __len__(self) -> int:
        return len(self.responses)

    @property
    def findings(self) -> Findings:
        """What was found about each, with its response before the text."""
        return in_order(each for name, r in self.items() for each in about(name, r.findings))

    def columns(self) -> dict[str, Any]:
        """Return the terms of every regression: response, then as of one."""
        return stacked("response", {name: r.columns() for name, r in self.items()})

    def to_dict(self) -> dict[str, Any]:
        """Return everything as what JSON can carry, keys as in the formats reference."""
        # Imported here, for the file's module makes regressions and so imports this one.
        from multipos.regression.regression_file import SCHEMA

        return {
            "schema": SCHEMA,
            "responses": {name: r.to_dict() for name, r in self.items()},
            "findings": [each.to_dict() for each in self.findings],
        }

    def save(self, path: StrPath) -> None:
        """Write the regressions as JSON, whole or not at all."""
        write_text(path, to_json(self.to_dict()))

    def __str__(self) -> str:
        return "\n\n".join(str(r) for r in self.values())


def all_of(regression: Regression | Regressions) -> tuple[Regression, ...]:
    """Return the regressions, one or several."""
    return (regression,) if isinstance(regression, Regression) else tuple(regression.values())


def regression_sentence(found: Regression | Regressions) -> str:
    """Return how much of the response is described, and by what."""
    return " ".join(_described(r) for r in all_of(found))


def _described(r: Regression) -> str:
    n = np.array([s.n for s in r.segments], dtype=np.float64)
    rms = math.sqrt(float(n @ np.array([s.rms**2 for s in r.segments])) / float(n.sum()))
    least = min(s.r2 for s in r.segments)
    pieces = f"{len(r.segments)} segments" if len(r.segments) > 1 else "1 segment"
    significant = all(s.significant for s in r.segments)
    verdict = "" if significant else "; not significant"
    return (
        f"{r.response} by {', '.join(r.variables)}: R² {'at least ' if n.size > 1 else ''}"
        f"{number(least, 4)}, residual sd {number(rms, 3)}, {r.n} rows, {pieces}{verdict}."
    )
