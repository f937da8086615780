"""One unit of a fleet by itself, as `fit` finds it: what its own page is made of.

- `fit_unit` returns its calibration, by what `fleet.json` says.
- `asked` returns what `fleet.json` keeps of how units were fitted.

`fleet.json` names the tables and says with what options units were fitted; the readings stay in
the tables. Of Parquet only the rows of the unit are read.
"""

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from multipos.errors import MultiposError
from multipos.files.pipes import is_there
from multipos.files.spelling import near, quoted
from multipos.files.tables import Source
from multipos.fitting.fit_readings import fit
from multipos.fleets import fit_many, grouping
from multipos.fleets.sources import Averaging, read_rows
from multipos.sensor.calibration import Calibration


def asked(
    unit_column: str | None, station_column: str | None, options: Mapping[str, Any]
) -> dict[str, Any]:
    """Return what `fleet.json` keeps of how units were fitted; options None where no file can."""
    given = {name: value for name, value in options.items() if value is not None}
    kept = given if all(map(_is_plain, given.values())) else None
    return {"unit_column": unit_column, "station_column": station_column, "options": kept}


def _is_plain(value: Any) -> bool:
    if isinstance(value, list | tuple):
        return all(map(_is_plain, value))
    return isinstance(value, str | int | float)


def fit_unit(
    found: Mapping[str, Any],
    unit: str,
    *,
    station: str | None = None,
    data: Sequence[Source] = (),
    beside: Path = Path(),
) -> Calibration:
    """Return the calibration of one unit of a fleet.

    Parameters
    ----------
    found : mapping
        As `fleet.json` holds it.
    unit, station : str
        The station where the unit was at several.
    data : paths, optional
        The tables of the fleet; otherwise those that it names, in `beside`, here or in its folders.
    beside : path

    Raises
    ------
    MultiposError
        There is no such unit or table, or the unit cannot be fitted.
    """
    how = found["asked"]
    if how["options"] is None:
        raise MultiposError(
            "this fleet was fitted from Python with options that no file holds; fit the rows of "
            "the unit there."
        )
    given, tables = how["options"], data or _named(found, beside)
    if how.get("raw", False):
        given = fit_many.with_rests(given)
        with ThreadPoolExecutor() as executor:
            raw = Averaging(fit_many.averaging_options(given), executor)
            rows, owners = read_rows(tables, None, None, unit, raw=raw)
    else:
        rows, owners = read_rows(tables, how["unit_column"], how["station_column"], unit)
    known = {each["sha256"] for each in found["input"]}
    for table in rows.tables:
        if table.sha256 not in known:
            raise MultiposError(
                f"{table.source} is not the table that this fleet was fitted from, or has changed "
                "since; give that with --data, or run multipos fleet again."
            )
    units = grouping.group_rows(owners)
    here = {units.station[i]: i for i, name in enumerate(units.unit) if name == unit}
    if not here:
        raise MultiposError(f"no unit '{unit}'{near(unit, owners.unit.names)} Look at units.csv.")
    place = here[_station_of(unit, list(here), station)]
    return fit(rows.select(units.rows(place).tolist()), **given)


def _station_of(unit: str, stations: list[str], wanted: str | None) -> str:
    if wanted is None and len(stations) == 1:
        return stations[0]
    if wanted is None:
        raise MultiposError(
            f"unit '{unit}' was at stations {quoted(stations)}; choose one with --station."
        )
    if wanted not in stations:
        raise MultiposError(f"unit '{unit}' was at {quoted(stations)}, not at '{wanted}'.")
    return wanted


def _named(found: Mapping[str, Any], beside: Path) -> list[Source]:
    """Return the tables that a fleet names, where they lie."""
    tables: list[Source] = []
    for each in found["input"]:
        places = [folder / each["file"] for folder in (beside, Path(), *Path().glob("*"))]
        there = next((path for path in places if is_there(path)), None)
        if there is None:
            raise MultiposError(
                f"the table {each['file']} of this fleet is not in its folder; give it with --data."
            )
        tables.append(there)
    return tables
