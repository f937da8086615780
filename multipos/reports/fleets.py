"""The page of a fleet: yield, why units do not pass, capability, stations, what moved, outliers.

It is made of what `fleet.json` holds and nothing else, so that a page of a million units is as
small as one of a hundred.
"""

from collections.abc import Mapping
from functools import partial
from typing import Any

from multipos.files.numbers import uncertain
from multipos.fleets.text import (
    Rows,
    cause_rows,
    drift_rows,
    gauge_rows,
    gauge_title,
    outlier_rows,
    parameter_rows,
    percent,
    station_rows,
)
from multipos.plots.fleets import draw_causes, draw_chart, draw_histogram
from multipos.reports.certificate import Content
from multipos.reports.page import Figure, PageTable, Section, draw_svg
from multipos.reports.translations import Translator

_ROUNDING = 1e-9  # [deg]
_SHOWN = 50  # units of a table; fleet.json has all
_TOLD = (
    "Numbers of the line are those of units that were fitted and are fit for use.",
    (
        "sd holds what the measurement adds, 'sd of units' does not. Cpk is taken with the spread "
        "within stations, Ppk with that of all units, 'true' with the measurement removed; in "
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
    tr = Translator("en")
    good = found["yield"]
    counts = ", ".join(f"{count} {name}" for name, count in found["verdicts"].items())
    sections = [
        _section("Why units do not pass", cause_rows(found), (), _causes(found, tr)),
        _section("Parameters", parameter_rows(found), _TOLD, _histograms(found, tr)),
        _risks(found),
        _section("Stations", station_rows(found), (_STATIONS,)),
        _nests(found),
        _gauge(found),
        _section("What moved", drift_rows(found), (), _charts(found, tr)),
        _section("Units that do not belong", outlier_rows(found), (_OUTLIERS,)),
        _origin(found),
    ]
    return Content(
        language="en",
        title="Report of a fleet",
        subtitle=f"{found['units']} units: {counts}",
        verdict=f"Yield {percent(good['value'])} "
        f"({percent(good['low'])} to {percent(good['high'])} with 95 % confidence)",
        warnings=(),
        fields=(("Units", str(found["units"])), ("Computed", found["created"])),
        sections=tuple(section for section in sections if section is not None),
    )


_STATIONS = (
    "Level is the rotation that turns a station's listed references into its true ones, shift its "
    "zero, both against the mean of all stations, which a fleet cannot tell. Their standard "
    "uncertainty holds what units differ by, as units are allotted to stations at random."
)
_GAUGE = (
    "Units whose positions came again at several stations: repeatability is what trials of one "
    "unit at one station differ by, reproducibility what stations do beside it, in all units alike "
    "or in each otherwise, in brackets the interval of both together. Share is that of both in "
    "all that measured units differ by; 'of limits' is six times both over the width of the limits."
)
_OUTLIERS = (
    "Far from the others in all parameters together, as at most one in a hundred of those named "
    "is by chance. The page of one: multipos report DIR --unit ID -o ID.html."
)


def _section(
    title: str,
    grid: Rows,
    paragraphs: tuple[str, ...] = (),
    figures: tuple[Figure, ...] = (),
) -> Section | None:
    header, rows = grid
    if not rows:
        return None
    caption = title
    if len(rows) > _SHOWN:
        caption = f"{title} (the first {_SHOWN} of {len(rows)}; fleet.json has all)"
    table = PageTable(caption, header, tuple(rows[:_SHOWN]))
    return Section(title, paragraphs, figures, (table,))


def _causes(found: Mapping[str, Any], tr: Translator) -> tuple[Figure, ...]:
    if not found["causes"]:
        return ()
    draw = partial(_drawn, tr, draw_causes, found["causes"])
    return (Figure("Why units do not pass", "bars, the commonest cause first", draw),)


def _histograms(found: Mapping[str, Any], tr: Translator) -> tuple[Figure, ...]:
    return tuple(
        Figure(
            each["name"],
            f"histogram of {each['count']} units, with limits where there are any",
            partial(_drawn, tr, draw_histogram, each),
        )
        for each in found["parameters"]
        if each["histogram"] is not None
    )


def _charts(found: Mapping[str, Any], tr: Translator) -> tuple[Figure, ...]:
    moved = {each["name"] for each in found["drift"]}
    return tuple(
        Figure(
            f"{each['name']} by station",
            "medians of consecutive units, one line a station, dotted the limits of its EWMA",
            partial(_drawn, tr, draw_chart, each),
        )
        for each in found["parameters"]
        if each["name"] in moved and each["chart"]
    )


def _drawn(tr: Translator, draw: Any, what: Any) -> str:
    return draw_svg(tr, 1, 2.2, lambda axes: draw(what, axes[0]))


def _risks(found: Mapping[str, Any]) -> Section | None:
    rows = [
        (each["name"], percent(each["risk"]["consumer"]), percent(each["risk"]["producer"]))
        for each in found["parameters"]
        if each["risk"] is not None
    ]
    if not rows:
        return None
    header = ("parameter", "pass although outside", "fail although inside")
    told = (
        "With the uncertainty of the measurement, some units pass although their true value is "
        "outside the limits (consumer's risk), and some fail although it is inside (producer's "
        "risk); shares of all units."
    )
    return Section(
        "Wrong verdicts", (told,), (), (PageTable("Wrong verdicts", header, tuple(rows)),)
    )


def _nests(found: Mapping[str, Any]) -> Section | None:
    tables = []
    for station in found["stations"]:
        rows = [
            (each["position"], *(_angle(each[axis]) for axis in "xyz"))
            for each in station["positions_deg"]
            if any(each[axis] is not None for axis in "xyz")
        ]
        if rows:
            name = f"Station {station['station']}" if station["station"] else "All units"
            header = ("position", "x [deg]", "y [deg]", "z [deg]")
            tables.append(PageTable(name, header, tuple(rows)))
    if not tables:
        return None
    told = (
        "By how much every position of a nest is turned, from what units leave in common; a turn "
        "that all positions share is not seen. From ten units on, stations/NAME.csv lists the "
        "positions where they are, as a scheme, and NAME.toml how well that is known, as a budget."
    )
    return Section("Angles of the positions", (told,), (), tuple(tables))


def _angle(figure: Mapping[str, float] | None) -> str:
    # A turn about what is up does not show: what stands there is rounding.
    if figure is None or not figure["u"] > _ROUNDING:
        return "-"
    return uncertain(figure["value"], figure["u"])


def _gauge(found: Mapping[str, Any]) -> Section | None:
    gauge = found.get("gauge")
    if gauge is None:
        return None
    header, rows = gauge_rows(gauge)
    table = PageTable(gauge_title(gauge), header, tuple(rows))
    return Section("Repeatability and reproducibility", (_GAUGE,), (), (table,))


def _origin(found: Mapping[str, Any]) -> Section:
    rows = tuple((each["file"], each["sha256"] or "-") for each in found["input"])
    return Section("Data", tables=(PageTable("Tables", ("table", "SHA-256"), rows, left=2),))
