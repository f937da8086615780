"""The result `Fleet`, and the front door `fleet`: many units, and what all of them show.

- `fleet` calibrates units and judges them; `assemble` makes a `Fleet` of units that are solved.

Numbers of the line are those of units that count: fitted, and fit for use. What is left out of
them is counted and listed.
"""

from collections.abc import Callable, Mapping
from concurrent.futures import Executor
from contextlib import nullcontext
from dataclasses import field
from pathlib import Path, PurePath
from typing import Any, Unpack

import numpy as np

from multipos import __version__
from multipos.errors import UsageError
from multipos.files.limits import Limit, LimitsSource, read_limits
from multipos.files.tables import Source
from multipos.files.whole import now
from multipos.finding import Finding, Findings, in_order, read_findings
from multipos.fitting.fit_readings import fit
from multipos.fitting.options import FitOptions, takes_options
from multipos.fleets import fit_many, line, pictures, quality
from multipos.fleets.one_unit import asked
from multipos.fleets.outlying_units import find_outliers
from multipos.fleets.stations import describe_stations
from multipos.fleets.unit_results import Texts, Units
from multipos.fleets.verdicts import FAIL, PASS, VERDICTS, column, judge_units
from multipos.fleets.workers import Engine, open_engine
from multipos.numerics.arrays import Mask
from multipos.results import Columns, Drawn, Result, frozen, plain_dict

SCHEMA = "multipos/fleet/1"


@frozen
class Fleet(Result, Drawn):
    """Many units: each one's calibration and verdict, and what only all of them tell.

    Attributes
    ----------
    summary : mapping
        What `fleet.json` holds: input, asked, units, fitted, failed, yield, parameters, outliers,
        stations, drift, and beside them verdicts, causes with the first unit of each, units that
        are unfit or outside their limits.
    calibrations : Columns
        One row a unit: every parameter, ``u_…``, ``dof_…``, rms [g], findings.
    verdicts : Columns
        unit, verdict, reasons.
    time : (B,) array
        Mean of the column `time` of every unit; NaN without.
    created, version : str

    Examples
    --------
    >>> import numpy as np
    >>> import multipos as mp
    >>> rng = np.random.default_rng(1)
    >>> up = mp.read_scheme("faces-6").up
    >>> bias = 0.01 * rng.standard_normal((3, 1, 3))
    >>> values = bias + up + 1e-4 * rng.standard_normal((3, 6, 3))
    >>> table = {"unit": np.repeat(["A", "B", "C"], 6), "position": np.tile(np.arange(1, 7), 3)}
    >>> table |= dict(zip(("ax", "ay", "az"), values.reshape(-1, 3).T))
    >>> found = mp.fleet(table, unit_column="unit", scheme="faces-6")
    >>> found.summary["units"], found.verdicts["verdict"].tolist()
    (3, ['pass', 'pass', 'pass'])
    """

    summary: Mapping[str, Any]
    calibrations: Columns
    verdicts: Columns
    time: np.ndarray[Any, np.dtype[np.float64]]
    created: str = field(compare=False)
    version: str

    def __getitem__(self, key: str) -> Any:
        return self.summary[key]

    @property
    def findings(self) -> Findings:
        """What the fleet as a whole shows: units without a calibration, stations that are off."""
        return read_findings(self.summary)

    def to_dict(self) -> dict[str, Any]:
        """Return what `fleet.json` holds."""
        head = {"schema": SCHEMA, "multipos_version": self.version, "created": self.created}
        return plain_dict(head | dict(self.summary))

    def to_pandas(self) -> Any:
        """Return the table of calibrations, with the verdicts, as a pandas data frame."""
        beside = {name: self.verdicts[name] for name in ("verdict", "reasons")}
        return Columns(dict(self.calibrations) | beside).to_pandas()


@takes_options(FitOptions, fit)
def fleet(
    *tables: Source,
    unit_column: str | None = None,
    station_column: str | None = None,
    raw: bool = False,
    limits: LimitsSource | None = None,
    engine: Engine = "threads",
    scheduler: str | None = None,
    executor: Executor | None = None,
    progress_folder: Path | None = None,
    progress: Callable[[int], object] | None = None,
    **options: Unpack[FitOptions],
) -> Fleet:
    """Calibrate every unit of a table, and say what all of them together tell.

    Parameters
    ----------
    tables, unit_column, station_column, options
        As in `fit_many`.
    raw : bool
        The tables are raw logs, one a unit: each is averaged first, and of unknown orientation
        unless a scheme is given.
    limits : path or mapping of name to (lsl, usl), optional
        Of the numbers of a unit (`multipos.fleets.verdicts`).
    engine, scheduler : str
        'threads', 'processes', or 'dask' with the address of its scheduler.
    executor : concurrent.futures.Executor, optional
        Instead of an engine.
    progress_folder : path, optional
        Where finished tasks are kept while the run goes on, so that one that was stopped goes on.
    progress : callable, optional
        Called with how many units are done.

    Returns
    -------
    Fleet

    Raises
    ------
    MultiposError
        A table, a column or the limits are missing or cannot be read.
    UsageError
        An option is at fault.

    Examples
    --------
    >>> import numpy as np
    >>> import multipos as mp
    >>> rng = np.random.default_rng(1)
    >>> up = mp.read_scheme("faces-6").up
    >>> bias = 0.01 * rng.standard_normal((3, 1, 3))
    >>> values = bias + up + 1e-4 * rng.standard_normal((3, 6, 3))
    >>> table = {"unit": np.repeat(["A", "B", "C"], 6), "position": np.tile(np.arange(1, 7), 3)}
    >>> table |= dict(zip(("ax", "ay", "az"), values.reshape(-1, 3).T))
    >>> limits = {"bias_ax": (-0.05, 0.05)}
    >>> found = mp.fleet(table, unit_column="unit", scheme="faces-6", limits=limits)
    >>> found.summary["fitted"], found.summary["yield"]["value"]
    (3, 1.0)
    """
    given = () if limits is None else read_limits(limits)
    if len({limit.name for limit in given}) < len(given):
        raise UsageError("--limits names a number twice; give one pair of limits for each.")
    opened = open_engine(engine, scheduler) if executor is None else nullcontext(executor)
    with opened as running:
        units = fit_many.fit_units(
            tables,
            unit_column,
            station_column,
            options,
            running,
            folder=progress_folder,
            report=progress or (lambda done: None),
            fixtures=True,
            raw=raw,
        )
    return assemble(units, given, asked(units.key, station_column, options) | {"raw": raw})


def assemble(units: Units, limits: tuple[Limit, ...], how: Mapping[str, Any]) -> Fleet:
    """Return the fleet of solved units; `how` is what `asked` tells of the options."""
    unfit = units.unfit
    judged = judge_units(units, limits, unfit)
    counted = ~units.failed & ~unfit
    failed = int(units.failed.sum())
    passed = int(np.sum(judged.verdict == PASS))
    total, verdicts = len(units), judged.verdict.tolist()
    stations = describe_stations(units, counted)
    summary = {
        "input": [
            {"file": PurePath(name).name, "sha256": sha256} for name, sha256 in units.sources
        ],
        "asked": dict(how),
        "units": total,
        "fitted": total - failed,
        "failed": failed,
        "counted": int(counted.sum()),
        "yield": quality.proportion(passed, total)._asdict(),
        "verdicts": {name: count for name in VERDICTS if (count := verdicts.count(name))},
        "causes": dict(sorted(judged.causes.items(), key=lambda item: -item[1])),
        "first": judged.first,
        "unfit": _named(units, unfit, units.why_unfit),
        "outside": _named(units, judged.verdict == FAIL, judged.reasons),
        "parameters": _parameters(units, limits, counted),
        "outliers": find_outliers(units, counted),
        "stations": stations,
        "drift": line.find_drift(units, counted),
    }
    off = [found for station in stations for found in read_findings(station)]
    found = in_order((*_find_failed(units), *off, *units.notes))
    summary["findings"] = [each.to_dict() for each in found]
    by_unit = {"unit": units.unit_column, "verdict": judged.verdict, "reasons": judged.reasons}
    tables = units.columns(), Columns(by_unit)
    return Fleet(_settled(summary), *tables, units.time, now(), __version__)


def _named(units: Units, which: Mask, reasons: Texts) -> list[dict[str, str]]:
    """Return some units by name, each with its reason."""
    return [
        {"unit": units.unit[i], "station": units.station[i], "reason": reasons[i]}
        for i in np.flatnonzero(which).tolist()
    ]


def _find_failed(units: Units) -> Findings:
    """Return a warning of units without a calibration, where there are any."""
    failed = np.flatnonzero(units.failed).tolist()
    if not failed:
        return ()
    first = failed[0]
    text = (
        f"{len(failed)} of {len(units)} units have no calibration, first {units.unit[first]}: "
        f"{units.reasons[first]}"
    )
    return (Finding("failed-units", "warning", text),)


def _settled(value: Any) -> Any:
    """Return nested lists as tuples, which a result cannot change."""
    if isinstance(value, dict):
        return {key: _settled(each) for key, each in value.items()}
    return tuple(map(_settled, value)) if isinstance(value, list) else value


def _parameters(units: Units, limits: tuple[Limit, ...], counted: Mask) -> list[dict[str, Any]]:
    """Return what is said of every parameter, and of what else is limited."""
    by_name = {limit.name: (limit.lsl, limit.usl) for limit in limits}
    _, stations = np.unique(np.array(units.station)[counted], return_inverse=True)
    lines = pictures.charts(units, counted)
    described = []
    for place, name in enumerate(units.names):
        unit = "" if units.model is None else units.model.units[place]
        values = units.parameters[counted, place]
        own = units.u[counted, place]
        if units.gravity_u > 0.0 and units.model is not None:
            common = units.model.force_degrees[place] * units.gravity_u * values
            own = np.sqrt(np.maximum(own**2 - common**2, 0.0))
        limit = by_name.pop(name, None)
        said = quality.describe(name, unit, values, own, stations, limit, units.confidence)
        described.append(said | {"histogram": pictures.histogram(values), "chart": lines[place]})
    for name, limit in by_name.items():
        values = column(units, name)[counted]
        said = quality.describe(name, "", values, None, stations, limit, units.confidence)
        described.append(said | {"histogram": pictures.histogram(values), "chart": []})
    return described
