"""Regression: the result of `multipos.regress`, and those of several responses.

The rows are cut into segments, ranges of one variable; each has a model of its own
(`multipos.regression.segment`). The result is complete when it is made and never changes.
What its fields declare is its file, which `load_regression` reads; what every key means is in
`docs/reference/formats`. `predict_rows` returns what it predicts of rows whose segments are known,
`all_of` the regressions of one result or of several responses; `require_same_data` refuses rows
that are not those of a fit.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import field
from itertools import pairwise
from typing import Annotated, Any, Literal

import numpy as np

from multipos.errors import MultiposError
from multipos.files.records import (
    FIGURE,
    NAME,
    NAMES,
    POSITIVE,
    AnyOf,
    Flag,
    Listed,
    Maybe,
    Named,
    Share,
    Whole,
)
from multipos.files.schema import As, Saved, Stored, restore, schema_of
from multipos.files.spelling import StrPath
from multipos.files.trees import read_json
from multipos.finding import Findings, about, findings_upgraded, in_order
from multipos.numerics.arrays import Array, Environment, Mask, Places
from multipos.regression.branches import BRANCHES, branch_of
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


def _balance(points: Sequence[Mapping[str, Any]]) -> Balance:
    """Return predictions in thermal balance, held to being of one variable."""
    names = {name for point in points for name in point} - {"predicted", "U", "outside"}
    if len(names) != 1 or any(len(point) != 4 for point in points):
        raise ValueError("'balance' is not of one variable")
    (variable,) = names
    at, predicted, U = (
        np.array([FIGURE.read(point[name]) for point in points])
        for name in (variable, "predicted", "U")
    )
    return Balance(variable, at, predicted, U, np.array([bool(p["outside"]) for p in points]))


_BALANCE = As(Listed(Named(AnyOf((FIGURE, Flag()))), 1), _balance, Balance.rows)


@frozen
class Regression(Saved, Tabular):
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

    schema = "multipos/regression/1"
    called = "regression"
    again = "run regress again"

    source: Annotated[str | None, Stored("input.file")] = field(compare=False)
    sha256: Annotated[str | None, Stored("input.sha256")]
    version: Annotated[str, Stored("multipos_version")]
    created: str = field(compare=False)
    response: Annotated[str, NAME]
    variables: Annotated[tuple[str, ...], NAMES]
    candidates: tuple[str, ...]
    method: Literal["full", "stepwise", "backward", "subsets"]
    thresholds: Mapping[str, float]
    confidence: Share
    n: Annotated[int, Whole(1)]
    dropped: int
    segment_variable: Annotated[str | None, Maybe(NAME)]
    edges: tuple[float, ...]
    continuous: bool
    time: Annotated[str | None, Maybe(NAME)]
    rates: Annotated[Mapping[str, float], Named(POSITIVE)]
    segments: Annotated[tuple[Segment, ...], Listed(schema_of(Segment), 1)]
    causal: bool = False
    run: Annotated[str | None, Maybe(NAME)] = None
    branch_column: Annotated[str | None, Maybe(NAME)] = None
    junctions: Annotated[tuple[Junction, ...], Stored("jumps")] = ()
    findings: Findings = ()
    balance: Annotated[Balance | None, _BALANCE, Stored(optional=True)] = None

    @classmethod
    def _upgraded(cls, content: Mapping[str, Any]) -> Any:
        """Return what a file says, with what version 0.1 did not write."""
        return findings_upgraded({"causal": False, "run": None, "jumps": [], **content})

    @classmethod
    def _from_file(cls, **values: Any) -> "Regression":
        """Return the regression that a file describes.

        Raises
        ------
        ValueError
            Its segments, edges, branches, variables and rates do not fit each other.
        """
        found = cls(**values)
        found._require_cuts()
        if found.segment_variable is None and not found.variables:
            raise ValueError("it has no variables")
        formed = all(name.endswith("_rate") for name in found.rates)
        if found.rates and (found.time is None or not formed):
            raise ValueError("it has rates, but no time or column that they are of")
        return found

    def _require_cuts(self) -> None:
        """Hold segments, edges and branches to each other."""
        branches = (None,) if self.branch_column is None else BRANCHES
        if any(low >= high for low, high in pairwise(self.edges)):
            raise ValueError("its edges do not ascend")
        if self.edges and self.segment_variable is None:
            raise ValueError("it has edges, but no variable that they are of")
        expected = [branch for branch in branches for _ in range(len(self.edges) + 1)]
        if [segment.branch for segment in self.segments] != expected:
            raise ValueError("its segments do not fit its edges and branches")

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
        return predict_rows(self, given, self.segment_of(given))

    def columns(self) -> dict[str, Any]:
        """Return the terms: segment, term, value, u, t, p."""
        terms = [(i, c) for i, s in enumerate(self.segments, start=1) for c in s.coefficients]
        names = ("term", "value", "u", "t", "p")
        listed = {key: [getattr(c, key) for _, c in terms] for key in names}
        return {"segment": [i for i, _ in terms], **listed}


def predict_rows(regression: Regression, columns: Mapping[str, Array], place: Places) -> Array:
    """Return what the regression predicts of every row."""
    predicted = np.empty(len(place))
    for number, segment in enumerate(regression.segments):
        rows = np.flatnonzero(place == number)
        predicted[rows] = segment.design(columns, rows) @ segment.values
    return predicted


def require_same_data(r: Regression, source: str, sha256: str | None) -> None:
    """Refuse a file that is not the one that a regression was fitted to, by its checksum."""
    if r.sha256 is not None and r.sha256 != sha256:
        raise MultiposError(
            f"{source}: not the data that the regression of '{r.response}' was fitted to "
            f"({r.source}), by its checksum; give it where it is one file, or leave out --data."
        )


@frozen
class Regressions(Saved, Tabular, Mapping[str, Regression]):
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

    schema = Regression.schema
    called, again = Regression.called, Regression.again

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
        return {
            "schema": self.schema,
            "responses": {name: r.to_dict() for name, r in self.items()},
            "findings": [each.to_dict() for each in self.findings],
        }


def all_of(regression: Regression | Regressions) -> tuple[Regression, ...]:
    """Return the regressions, one or several."""
    return (regression,) if isinstance(regression, Regression) else tuple(regression.values())


def load_regression(path: StrPath) -> Regression | Regressions:
    """Read a regression written by `Regression.save`, or those of several responses.

    Raises
    ------
    MultiposError
        The file is missing, truncated, of another schema, or holds what no regression does.

    Examples
    --------
    >>> import numpy as np
    >>> import multipos as mp
    >>> T = np.linspace(-20.0, 60.0, 81)
    >>> table = {"T": T, "error": 0.01 + 5e-4 * T + 1e-4 * np.sin(7.0 * T)}
    >>> found = mp.regress(table, response="error", variables="T")
    >>> found.save("model.json")
    >>> mp.load_regression("model.json") == found
    True
    """
    content = read_json(path, Regression.schema)
    if "responses" not in content:
        return restore(Regression, content, str(path))
    responses = content["responses"]
    if not isinstance(responses, dict) or not responses:
        raise MultiposError(
            f"{path}: 'responses' holds no regressions; the file is damaged, run regress again."
        )
    found = {name: restore(Regression, one, f"{path}: {name}") for name, one in responses.items()}
    wrong = [name for name, r in found.items() if r.response != name]
    if wrong:
        raise MultiposError(
            f"{path}: '{wrong[0]}' holds the regression of another response; the file is damaged, "
            "run regress again."
        )
    return Regressions(found)
