"""The page of a fleet: yield, why units do not pass, capability, stations, what moved, outliers.

It is made of what `fleet.json` holds and nothing else, so that a page of a million units is as
small as one of a hundred.
"""

from collections.abc import Mapping
from functools import partial
from typing import Any

from multipos.files import numbers
from multipos.finding import read_findings, serious
from multipos.fleets import fleet_text
from multipos.fleets.stations import is_off
from multipos.plots.fleets import draw_chart, draw_histogram, limited
from multipos.reports import sections
from multipos.reports.certificate import Content

_ROUNDING = 1e-9  # [deg]
_DRAWN = 6  # parameters, those with limits first
_SHOWN = 24  # units of a table; fleet.json has all
_EXPLAINED = (
    "Statistics cover units with a valid fit.",
    (
        "'sd' includes measurement noise; 'sd of units' does not. Cpk is taken with the spread "
        "within stations, Ppk with that of all units, Ppk of units without measurement noise; in "
        "brackets 95 % intervals."
    ),
)


def fleet_content(found: Mapping[str, Any]) -> Content:
    """Return what the report of a fleet says.

    Parameters
    ----------
    found : mapping
        As `fleet.json` holds it.
    """
    outliers, named = fleet_text.outlier_rows(found)
    header, stations = fleet_text.station_rows(found)
    alone = len(stations) == 1 and len(header) == len(("station", "units"))
    parts = [
        _section("Why units do not pass", fleet_text.cause_rows(found)),
        None if alone else _section("Stations", (header, stations), (_STATIONS,)),
        _section("Parameters", fleet_text.parameter_rows(found), _EXPLAINED, _histograms(found)),
        _risks(found),
        _fixtures(found),
        _section("What moved", _moves(found), (), _charts(found)),
        _section("Units that do not belong", ((_WHICH, *outliers[1:]), named), (_OUTLIERS,)),
        _tables_of(found),
    ]
    return Content(
        title="Report of a fleet",
        subtitle=f"Computed {found['created']}",
        sentence=_answer(found),
        unfit=False,
        findings=tuple(each.text for each in serious(read_findings(found))),
        fields=(),
        sections=sections.with_annex(part for part in parts if part is not None),
    )


def _answer(found: Mapping[str, Any]) -> str:
    """Return the yield, and the units by verdict."""
    counts = ", ".join(f"{count} {name}" for name, count in found["verdicts"].items())
    value, low, high = (fleet_text.percent(found["yield"][key]) for key in ("value", "low", "high"))
    return (
        f"Yield {value} ({low} to {high} with 95 % confidence) of {found['units']} units: {counts}."
    )


_STATIONS = (
    "Level is the rotation that turns a station's listed references into its true ones, shift its "
    "zero, both against the mean of all stations, which a fleet cannot determine. Their standard "
    "uncertainty includes the variation of units, as units are allotted to stations at random."
)
_WHICH = "name of the unit"  # a parameter has a unit of another kind
_OUTLIERS = (
    "Far from the others in all parameters together, as at most one in a hundred of those named "
    "is by chance. The page of one: multipos report DIR --unit ID -o ID.html."
)
_RISKS = (
    "With the uncertainty of the measurement, some units pass although their true value is "
    "outside the limits (consumer's risk), and some fail although it is inside (producer's "
    "risk); shares of all units."
)
_FIXTURES = (
    "Rotation of every position of a fixture, from the common residuals of units; a rotation "
    "common to all positions is not identifiable. From ten units on, stations/NAME.csv lists the "
    "positions where they are, as a scheme, and NAME.toml how well that is known, as a budget."
)


def _section(
    title: str,
    grid: fleet_text.Rows,
    paragraphs: tuple[str, ...] = (),
    figures: tuple[sections.Figure, ...] = (),
) -> sections.Section | None:
    if not grid[1]:
        return None
    table = _table(title, grid)
    return sections.Section(title, paragraphs, figures, (table,))


def _table(caption: str, grid: fleet_text.Rows) -> sections.PageTable:
    """Return the first rows of a table."""
    header, rows = grid
    if len(rows) > _SHOWN:
        caption += f" (the first {_SHOWN} of {len(rows)}; fleet.json has all)"
    return sections.PageTable(caption, tuple(header), tuple(rows[:_SHOWN]))


def _histograms(found: Mapping[str, Any]) -> tuple[sections.Figure, ...]:
    return tuple(
        sections.Figure(
            each["name"],
            f"histogram of {each['count']} units, with limits where there are any",
            partial(sections.draw_svg, 2.2, partial(draw_histogram, each)),
        )
        for each in limited(found["parameters"], _DRAWN)
    )


def _charts(found: Mapping[str, Any]) -> tuple[sections.Figure, ...]:
    moved = {each["name"] for each in found["drift"]}
    said = "medians of consecutive units, one line a station, dotted the limits of its EWMA"
    return tuple(
        sections.Figure(
            f"{each['name']} by station",
            said,
            partial(sections.draw_svg, 2.2, partial(draw_chart, each)),
        )
        for each in found["parameters"]
        if each["name"] in moved and each["chart"]
    )


def _moves(found: Mapping[str, Any]) -> fleet_text.Rows:
    header, rows = fleet_text.drift_rows(found)
    return header, [(*row[:2], f"a {row[2]}", *row[3:]) for row in rows]


def _risks(found: Mapping[str, Any]) -> sections.Section | None:
    rows = [
        (
            each["name"],
            fleet_text.percent(each["risk"]["consumer"]),
            fleet_text.percent(each["risk"]["producer"]),
        )
        for each in found["parameters"]
        if each["risk"] is not None
    ]
    header = ("parameter", "pass although outside", "fail although inside")
    return _section("Wrong verdicts", (header, rows), (_RISKS,))


def _fixtures(found: Mapping[str, Any]) -> sections.Section | None:
    tables = []
    for station in found["stations"]:
        known = [
            each
            for each in station["positions_deg"]
            if any(each[axis] is not None for axis in "xyz")
        ]
        if known:
            rows = [(each["position"], *(_angle(each[axis]) for axis in "xyz")) for each in known]
            name = station["station"]
            caption = f"Station {name}" if name else "All units"
            off = [", ".join(axis for axis in "xyz" if is_off(each[axis])) for each in known]
            header: tuple[str, ...] = ("position", "x [deg]", "y [deg]", "z [deg]")
            if any(off):
                header = (*header, "off")
                rows = [(*row, said) for row, said in zip(rows, off, strict=True)]
            tables.append(sections.PageTable(caption, header, tuple(rows)))
    if not tables:
        return None
    return sections.Section("Angles of the positions", (_FIXTURES,), (), tuple(tables))


def _angle(figure: Mapping[str, float] | None) -> str:
    # A turn about what is up does not show: what stands there is rounding.
    if figure is None or not figure["u"] > _ROUNDING:
        return "-"
    return numbers.uncertain(figure["value"], figure["u"])


def _tables_of(found: Mapping[str, Any]) -> sections.Section:
    rows = tuple((each["file"], each["sha256"] or "-") for each in found["input"])
    table = sections.PageTable("Tables", ("table", "SHA-256"), rows, left=2)
    return sections.Section("Data", tables=(table,))
