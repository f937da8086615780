"""The rests of a log as readings: what `multipos.logs.averaging` finds, and how it is written.

`averages_text` and `averages_sentence` put them in words, `taken_in_words` what they were taken of.
"""

from collections.abc import Mapping, Sequence
from dataclasses import field
from functools import cached_property
from typing import Any

import numpy as np

from multipos.files.numbers import in_unit, number, table, uncertain
from multipos.files.spelling import StrPath, listed
from multipos.files.tables import Column, write_table
from multipos.finding import Finding, Findings
from multipos.logs.rest_means import RestMean
from multipos.logs.rests import Rest
from multipos.numerics.arrays import Array
from multipos.positions.readings import Readings
from multipos.results import Result, Tabular, frozen, plain_dict

_LISTED = 6  # rests of a message


@frozen
class RestAverage(Result):
    """One rest of a log, averaged.

    Attributes
    ----------
    position : str
    rows : Rest
        First row of the log and the one after the last, counted from 0.
    time : (float, float) or None [s]
        Of the first and the last sample.
    found : RestMean
    environment : mapping of str to float
        Means of the columns that are no outputs; NaN where all cells are empty.
    distance_deg : float or None
        Angle to the position of the scheme.
    findings : tuple of Finding
        About the rest.
    log : str
        Name of the log, without its folder.
    """

    position: str
    rows: Rest
    time: tuple[float, float] | None
    found: RestMean
    environment: Mapping[str, float]
    distance_deg: float | None
    findings: Findings
    log: str = field(default="", compare=False)


@frozen
class Averages(Result, Tabular):
    """The rests of a log, averaged: readings, and where they came from.

    Attributes
    ----------
    source : str
    outputs : tuple of M str
    rests : tuple of RestAverage
    scheme_up : (n, 3) array or None
        Up vectors of the positions, where a scheme was named.
    sample_rate : float or None [Hz]
    threshold : float or None
        Standard deviation of a window above which it moves; None where the log shows none.
    findings : tuple of Finding
    short : tuple of (str, Rest)
        Stretches that stood still for less than a rest: the name of the log, and its rows.
    unit : str or None
        Of the outputs, where the log tells it.
    layout : str
        How the rows of the log stand in its file.
    time_column : str or None
        Column that is the time.

    Examples
    --------
    >>> import multipos as mp
    >>> log = mp.simulate_log(mp.demo().calibration, "faces-6", sample_sd=1e-3, seed=1)
    >>> found = mp.average(log)
    >>> len(found.rests), found.outputs
    (6, ('ax', 'ay', 'az'))
    >>> found.readings.values.shape
    (6, 3)
    """

    source: str = field(compare=False)
    outputs: tuple[str, ...]
    rests: tuple[RestAverage, ...]
    scheme_up: Array | None
    sample_rate: float | None
    threshold: float | None
    findings: Findings
    short: tuple[tuple[str, Rest], ...] = field(default=(), compare=False)
    unit: str | None = None
    layout: str = field(default="", compare=False)
    time_column: str | None = field(default=None, compare=False)

    @property
    def seen(self) -> str:
        """What was taken of the log, in a sentence."""
        rests, short = [rest.rows for rest in self.rests], [rest for _, rest in self.short]
        return taken_in_words(self.outputs, rests, short)

    def _stack(self, name: str) -> Array:
        return np.array([getattr(rest.found, name) for rest in self.rests])

    @cached_property
    def _u(self) -> Array | None:
        """Standard uncertainties; None where some are zero, which no reading can be."""
        u = self._stack("u")
        return u if (u > 0.0).all() else None

    @property
    def readings(self) -> Readings:
        """The readings, ready to be fitted."""
        names = self.rests[0].environment
        columns = {n: np.array([rest.environment[n] for rest in self.rests]) for n in names}
        if self.rests[0].time is not None:
            columns["time"] = np.array([np.mean(rest.time) for rest in self.rests if rest.time])
        return Readings(
            values=self._stack("mean"),
            outputs=self.outputs,
            positions=tuple(rest.position for rest in self.rests),
            up=self.scheme_up,
            u=self._u,
            dof=None if self._u is None else self._stack("dof"),
            sd=self._stack("sd"),
            samples=self._stack("n"),
            environment=columns,
            unit=self.unit or "reading",
            source=self.source,
        )

    def columns(self) -> dict[str, Column]:
        """Return the columns of a readings file."""
        return self.readings.columns()

    def save(self, path: StrPath) -> None:
        """Write the readings as CSV, whole or not at all."""
        write_table(path, self.columns())

    def to_dict(self) -> dict[str, Any]:
        """Return what JSON can carry, keys as in the formats reference."""

        def named(values: Array) -> dict[str, float]:
            return dict(zip(self.outputs, values.tolist(), strict=True))

        positions = [
            {
                "position": rest.position,
                "log": rest.log,
                "t_start": None if rest.time is None else rest.time[0],
                "t_end": None if rest.time is None else rest.time[1],
                "start": rest.rows.start,
                "end": rest.rows.end,
                "n": rest.found.n,
                "mean": named(rest.found.mean),
                "sd": named(rest.found.sd),
                "u": named(rest.found.u),
                "dof": named(rest.found.dof),
                "n_effective": named(rest.found.effective),
                "drift": named(rest.found.drift),
                "environment": rest.environment,
                "distance_deg": rest.distance_deg,
                "findings": rest.findings,
            }
            for rest in self.rests
        ]
        return plain_dict(
            {
                "positions": positions,
                "sample_rate": self.sample_rate,
                "threshold": self.threshold,
                "findings": self.findings,
                "short": [{"log": log, "start": a, "end": b} for log, (a, b) in self.short],
                "unit": self.unit,
                "layout": self.layout,
                "taken": {"time": self.time_column, "outputs": self.outputs},
            }
        )


def taken_in_words(
    outputs: Sequence[str],
    rests: Sequence[Rest] = (),
    short: Sequence[Rest] = (),
    notes: Sequence[Finding] = (),
) -> str:
    """Return which outputs and rests a log has, and what is too short for one, in a sentence."""
    said = (each.text for each in notes if each.code not in ("outputs-by-name", "unused-column"))
    parts = [f"Outputs are {listed(outputs, _LISTED)}"]
    for stretches, kind in ((rests, "rest"), (short, "stretch too short")):
        rows = listed([f"{each.start} to {each.end}" for each in stretches], _LISTED)
        parts += [f"{kind}: rows {rows} ({len(stretches)})"] if stretches else []
    return f"{'; '.join([*parts, *said])}."


def averages_text(found: Averages) -> str:
    """Return the table of the rests, as people read it."""
    timed = found.rests[0].time is not None
    matched = found.rests[0].distance_deg is not None
    header = [
        "position",
        *(["from [s]", "to [s]"] if timed else ["from row", "to row"]),
        "n",
        "n_eff",
        *found.outputs,
        *(["off [deg]"] if matched else []),
    ]
    rows = []
    for rest in found.rests:
        ends = rest.rows if rest.time is None else rest.time
        mean, u = rest.found.mean.tolist(), rest.found.u.tolist()
        rows.append(
            [
                rest.position,
                *(f"{end:.2f}" if timed else str(end) for end in ends),
                str(rest.found.n),
                number(float(rest.found.effective.min()), 3),
                *map(uncertain, mean, u),
                *([f"{rest.distance_deg:.1f}"] if rest.distance_deg is not None else []),
            ]
        )
    rate = "" if found.sample_rate is None else f", {found.sample_rate:.6g} Hz"
    level = "" if found.threshold is None else f", threshold {found.threshold:.3g}"
    head = [f"{found.source}: {len(found.rests)} rests{rate}{level}"]
    return "\n".join([*head, "", table(header, rows), ""])


def averages_sentence(found: Averages) -> str:
    """Return how many rests were averaged, and how well."""
    u = found.readings.u
    unit = found.unit or ""
    known = "" if u is None else f"; u up to {in_unit(float(u.max()), unit)}"
    return f"{len(found.rests)} rests of {found.source} averaged{known}."
