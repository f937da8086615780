"""What a report of several calibrations says: of one unit, or of a fleet.

Of repeats, from the file that `compare -o FILE.json` wrote, the verdict and what has moved stand
first, then the parameters run by run, and how stable the biases are. Repeated regressions have a
table of their terms.

The page of a fleet: yield, why units do not pass, capability, stations, what moved, outliers.

It is made of what `fleet.json` holds and nothing else, so that a page of a million units is as
small as one of a hundred.
"""

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from multipos.errors import MultiposError
from multipos.files import numbers, trees
from multipos.files.records import (
    ANY_NUMBER,
    ANY_TEXT,
    FIGURE,
    P_VALUE,
    AnyOf,
    Fields,
    Flag,
    Listed,
    Maybe,
    Named,
    require,
)
from multipos.files.spelling import StrPath
from multipos.finding import FINDINGS, errors_of, read_findings, serious
from multipos.fleets import fleet_text
from multipos.fleets.stations import is_off
from multipos.numerics.arrays import Array
from multipos.plots.fleets import draw_chart, draw_histogram, limited
from multipos.plots.runs import draw_values
from multipos.reports import sections
from multipos.reports.certificate import Content, lab_fields, read_lab
from multipos.reports.findings import sessions_section
from multipos.sensor.calibration_file import from_dict
from multipos.verification.comparison import change_rows, comparison_sentence, or_nan

_RUNS = Listed(Fields({"file": Maybe(ANY_TEXT), "created": Maybe(ANY_TEXT)}), 2)
_VALUES = Listed(Maybe(ANY_NUMBER), 2)
_CHANGE = Fields(
    {
        "name": ANY_TEXT,
        "change": FIGURE,
        "U": FIGURE,
        "En": FIGURE,
        "per_year": Maybe(Fields({"value": FIGURE, "U": FIGURE})),
        "limit": Maybe(AnyOf((ANY_NUMBER, Listed(Maybe(ANY_NUMBER), 2)))),
        "within": Maybe(Flag()),
        "due": Maybe(ANY_TEXT),
    }
)
_CALIBRATIONS = Fields(
    {
        "calibrations": _RUNS,
        "parameters": Listed(
            Fields(
                {
                    "name": ANY_TEXT,
                    "term": ANY_TEXT,
                    "unit": ANY_TEXT,
                    "values": _VALUES,
                    "mean": FIGURE,
                    "sd": FIGURE,
                    "drift": FIGURE,
                    "drift_unit": ANY_TEXT,
                    "drift_p": P_VALUE,
                    "p": P_VALUE,
                    "moved": Flag(),
                },
                {"U": _VALUES},
            ),
            1,
        ),
        "bias_stability": Named(FIGURE),
        "statistic": FIGURE,
        "p": P_VALUE,
        "test": ANY_TEXT,
        "consistent": Flag(),
    },
    FINDINGS
    | {"changes": Listed(_CHANGE), "largest": Maybe(Fields({"name": ANY_TEXT, "En": FIGURE}))},
)
_REGRESSIONS = Fields(
    {
        "regressions": _RUNS,
        "terms": Listed(
            Fields(
                {
                    "segment": ANY_TEXT,
                    "term": ANY_TEXT,
                    "values": _VALUES,
                    "sd": FIGURE,
                    "p": P_VALUE,
                }
            ),
            1,
        ),
        "consistent": Flag(),
    },
    FINDINGS,
)
# What a comparison is of: how it is described, and which entries have a value for each run.
_KINDS = {"calibrations": (_CALIBRATIONS, "parameters"), "regressions": (_REGRESSIONS, "terms")}


def read_comparison(path: StrPath) -> dict[str, Any] | None:
    """Return what a file says that `compare` wrote; None where it is another file.

    Raises
    ------
    MultiposError
        It is such a file, and damaged.
    """
    try:
        content = trees.read_json_value(path, "file")
    except MultiposError:  # whoever reads it next says so
        return None
    if not isinstance(content, dict) or "consistent" not in content:
        return None
    kind = next((key for key in _KINDS if key in content), None)
    if kind is None:
        return None
    described, entries = _KINDS[kind]
    require(content, described, str(path), "compare again")
    runs = len(content[kind])
    columns = [entry[k] for entry in content[entries] for k in ("values", "U") if k in entry]
    if any(len(column) != runs for column in columns):
        raise MultiposError(f"{path}: it has not a value for each of {runs} runs; compare again.")
    return content


def comparison_content(
    found: Mapping[str, Any],
    *,
    lab: "StrPath | Mapping[str, Any] | None" = None,
    language: sections.Language = "en",
) -> Content:
    """Return what the report of repeated calibrations or regressions says.

    Parameters
    ----------
    found : mapping
        As the JSON of `compare` holds it.
    lab, language
        As of `multipos.report`.
    """
    tr = sections.Translator(language)
    said = read_lab(lab)
    findings = read_findings(found)
    of_regressions = "regressions" in found
    runs = found["regressions" if of_regressions else "calibrations"]
    parts = (
        []
        if of_regressions
        else [_parameters(found, tr), *_combined(found, tr), _stability(found, tr)]
    )
    return Content(
        language=language,
        title=tr("Report of repeated calibrations"),
        subtitle=tr("{count} runs of one unit", count=str(len(runs))),
        sentence=tr.message(comparison_sentence(found)),
        unfit=bool(errors_of(findings)) or not found["consistent"],
        findings=tuple(tr.message(each.text) for each in serious(findings)),
        fields=lab_fields(said, tr),
        sections=sections.with_annex((*parts, _origin(runs, tr)), tr),
        lab=said,
        result=_result(found, tr),
    )


def _result(found: Mapping[str, Any], tr: sections.Translator) -> sections.Section:
    """Return by what test the runs agree, what has moved, and the biases by run.

    Of regressions the terms by run.
    """
    if "parameters" not in found:
        return sections.Section(tr("Result"), tables=(_terms(found, tr),))
    paragraphs: list[str] = []
    header, rows = change_rows(found)
    changes = sections.PageTable(
        tr("Changes between the first and the last"),
        tuple(map(tr, header)),
        tuple(map(tuple, rows)),
        left=2,
    )
    if found["p"] is not None:
        paragraphs.append(
            f"{tr(found['test'])}: {numbers.number(found['statistic'])}, "
            f"{numbers.p_in_words(found['p'])}"
        )
    moved = [entry["name"] for entry in found["parameters"] if entry["moved"]]
    if moved:
        paragraphs.append(tr("Moved beyond chance: {names}.", names=tr.listed(moved)))
    biases = [entry for entry in found["parameters"] if entry["term"] == "1"]
    values = {entry["name"]: _less_mean(entry) for entry in biases}
    draw = partial(draw_values, values, unit=biases[0]["unit"] if biases else "")
    picture = sections.Figure(
        tr("Biases by run, each less its mean, with U")
        if all("U" in entry for entry in biases)
        else tr("Biases by run, each less its mean"),
        tr("One line for each output; the numbers are in the table below."),
        partial(sections.draw_svg, tr, 2.4, draw),
    )
    return sections.Section(
        tr("Result"), tuple(paragraphs), (picture,) if biases else (), (changes,) if rows else ()
    )


def _less_mean(entry: Mapping[str, Any]) -> tuple[Array, Array]:
    """Return the values of a parameter less their mean, and their U: NaN where there is none."""
    values = np.array([or_nan(value) for value in entry["values"]])
    finite = values[np.isfinite(values)]
    U = [or_nan(size) for size in entry.get("U", (None,) * len(values))]
    return values - (finite.mean() if len(finite) else math.nan), np.array(U)


def _parameters(found: Mapping[str, Any], tr: sections.Translator) -> sections.Section:
    runs = [str(i + 1) for i in range(len(found["calibrations"]))]
    per = found["parameters"][0]["drift_unit"].rpartition("/")[2]
    header = (
        *(tr(word) for word in ("Parameter", "Unit")),
        *runs,
        *(tr("mean(sd)"), tr("drift per {unit}", unit=tr(per)), tr("its p"), "p", ""),
    )
    units = numbers.common_units(
        (entry["unit"], or_nan(value)) for entry in found["parameters"] for value in entry["values"]
    )
    rows = tuple(
        (
            entry["name"],
            *_values_of(entry, units[entry["unit"]]),
            numbers.chance(entry["drift_p"]),
            numbers.chance(entry["p"]),
            tr("moved") if entry["moved"] else "",
        )
        for entry in found["parameters"]
    )
    finite = tr(
        "Each parameter in every run. p is the probability of such differences by the stated "
        "uncertainties; drift is the slope over the runs, with its own p."
    )
    table = sections.PageTable(tr("Parameters by run"), header, rows, left=2)
    return sections.Section(tr("Parameters"), (finite,), tables=(table,))


def _values_of(entry: Mapping[str, Any], shown: tuple[float, str]) -> list[str]:
    """Return unit, values, mean and sd, and drift of a parameter, in the unit to show."""
    values = np.array([or_nan(value) for value in entry["values"]])
    factor, unit = shown
    sd = factor * or_nan(entry["sd"])
    decimals = numbers.decimals_of(sd)
    form = ".7g" if decimals is None else f".{decimals + 1}f"
    middle = factor * or_nan(entry["mean"])
    cells = ["-" if np.isnan(value) else f"{value:{form}}" for value in factor * values]
    drift = None if entry["drift"] is None else numbers.beyond_rounding(factor * entry["drift"])
    mean = f"{middle:{form}}" if decimals is None else numbers.uncertain(middle, sd)
    return [unit, *cells, mean, numbers.plain_number(drift, 2)]


def _combined(found: Mapping[str, Any], tr: sections.Translator) -> list[sections.Section]:
    """Return the one calibration of all sessions, or how it is made."""
    if "combined" not in found:
        finite = tr("multipos compare … --combine -o CAL.json makes one calibration of all runs.")
        return [sections.Section(tr("Combined sessions"), (finite,))]
    combined = from_dict(found["combined"], "the combined calibration")
    return [] if combined.sessions is None else [sessions_section(combined, combined.sessions, tr)]


def _stability(found: Mapping[str, Any], tr: sections.Translator) -> sections.Section:
    unit = next((e["unit"] for e in found["parameters"] if e["term"] == "1"), "")
    estimated_of = [sd for sd in found["bias_stability"].values() if sd is not None]
    factor, unit = numbers.readable_unit(max(estimated_of, default=0.0), unit)
    rows = tuple(
        (output, numbers.plain_number(None if sd is None else factor * sd))
        for output, sd in found["bias_stability"].items()
    )
    finite = tr("Standard deviation of the repeated biases, from switch-on to switch-on.")
    table = sections.PageTable(tr("Bias stability"), (tr("Output"), f"sd [{unit}]"), rows)
    return sections.Section(tr("Bias stability"), (finite,), tables=(table,))


def _terms(found: Mapping[str, Any], tr: sections.Translator) -> sections.PageTable:
    runs = [str(i + 1) for i in range(len(found["regressions"]))]
    rows = tuple(
        (
            entry["segment"],
            entry["term"],
            *(numbers.number(value, 5) for value in entry["values"]),
            numbers.number(entry["sd"], 2),
            numbers.chance(entry["p"]),
        )
        for entry in found["terms"]
    )
    header = (tr("Segment"), tr("Term"), *runs, "sd", "p")
    return sections.PageTable(tr("Terms by run"), header, rows, left=2)


def _origin(runs: Sequence[Mapping[str, Any]], tr: sections.Translator) -> sections.Section:
    rows = tuple(
        (str(i), run["file"] or "-", run["created"] or "-") for i, run in enumerate(runs, start=1)
    )
    header = (tr("Run"), tr("File"), tr("Computed"))
    return sections.Section(
        tr("Data"), tables=(sections.PageTable(tr("Runs"), header, rows, left=3),)
    )


_ROUNDING = 1e-9  # [deg]
_DRAWN = 6  # parameters, those with limits first
_SHOWN = 24  # units of a table; fleet.json has all
_EXPLAINED = (
    "Statistics cover units with a valid fit.",
    (
        "'sd' includes measurement noise; 'sd of units' does not. Cpk is taken with the spread "
        "within stations, Ppk with that of all units, 'true' with the measurement removed; in "
        "brackets 95 % intervals."
    ),
)


def fleet_content(found: Mapping[str, Any], *, language: sections.Language = "en") -> Content:
    """Return what the report of a fleet says.

    Parameters
    ----------
    found : mapping
        As `fleet.json` holds it.
    language
        As of `multipos.report`.
    """
    tr = sections.Translator(language)
    outliers, named = fleet_text.outlier_rows(found)
    header, stations = fleet_text.station_rows(found)
    alone = len(stations) == 1 and len(header) == len(("station", "units"))
    parts = [
        _section("Why units do not pass", fleet_text.cause_rows(found), tr),
        None if alone else _section("Stations", (header, stations), tr, (_STATIONS,)),
        _section(
            "Parameters", fleet_text.parameter_rows(found), tr, _EXPLAINED, _histograms(found, tr)
        ),
        _risks(found, tr),
        _fixtures(found, tr),
        _gauge(found, tr),
        _section("What moved", _moves(found), tr, (), _charts(found, tr)),
        _section("Units that do not belong", ((_WHICH, *outliers[1:]), named), tr, (_OUTLIERS,)),
        _tables_of(found, tr),
    ]
    return Content(
        language=language,
        title=tr("Report of a fleet"),
        subtitle=tr("Computed {date}", date=str(found["created"])),
        sentence=_answer(found, tr),
        unfit=False,
        findings=tuple(tr.message(each.text) for each in serious(read_findings(found))),
        fields=(),
        sections=sections.with_annex((part for part in parts if part is not None), tr),
    )


def _answer(found: Mapping[str, Any], tr: sections.Translator) -> str:
    """Return the yield, and the units by verdict."""
    counts = [tr(f"{{count}} {name}", count=str(n)) for name, n in found["verdicts"].items()]
    return tr(
        "Yield {value} ({low} to {high} with 95 % confidence) of {units} units: {counts}.",
        **{key: fleet_text.percent(found["yield"][key]) for key in ("value", "low", "high")},
        units=str(found["units"]),
        counts=tr.listed(counts),
    )


_STATIONS = (
    "Level is the rotation that turns a station's listed references into its true ones, shift its "
    "zero, both against the mean of all stations, which a fleet cannot determine. Their standard "
    "uncertainty includes the variation of units, as units are allotted to stations at random."
)
_GAUGE = (
    "Units whose positions came again at several stations: repeatability is what trials of one "
    "unit at one station differ by, reproducibility what stations add, equally in all units or "
    "not, in brackets the interval of both together. Share is that of both in "
    "all that measured units differ by; 'of limits' is six times both over the width of the limits."
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
    tr: sections.Translator,
    paragraphs: tuple[str, ...] = (),
    figures: tuple[sections.Figure, ...] = (),
) -> sections.Section | None:
    if not grid[1]:
        return None
    table = _table(tr(title), grid, tr)
    return sections.Section(tr(title), tuple(map(tr, paragraphs)), figures, (table,))


def _table(caption: str, grid: fleet_text.Rows, tr: sections.Translator) -> sections.PageTable:
    """Return the first rows of a table, each cell in the language of the page."""
    header, rows = grid
    if len(rows) > _SHOWN:
        more = " (the first {shown} of {count}; fleet.json has all)"
        caption += tr(more, shown=str(_SHOWN), count=str(len(rows)))
    shown = tuple(tuple(map(tr.message, row)) for row in rows[:_SHOWN])
    return sections.PageTable(caption, tuple(_heading(cell, tr) for cell in header), shown)


def _heading(text: str, tr: sections.Translator) -> str:
    word, _, rest = text.partition(" ")  # level x [°], shift ax
    return f"{tr(word)} {rest}" if word in ("level", "shift") else tr.label(text)


def _histograms(found: Mapping[str, Any], tr: sections.Translator) -> tuple[sections.Figure, ...]:
    return tuple(
        sections.Figure(
            each["name"],
            tr(
                "histogram of {count} units, with limits where there are any",
                count=str(each["count"]),
            ),
            partial(sections.draw_svg, tr, 2.2, partial(draw_histogram, each)),
        )
        for each in limited(found["parameters"], _DRAWN)
    )


def _charts(found: Mapping[str, Any], tr: sections.Translator) -> tuple[sections.Figure, ...]:
    moved = {each["name"] for each in found["drift"]}
    said = "medians of consecutive units, one line a station, dotted the limits of its EWMA"
    return tuple(
        sections.Figure(
            tr("{name} by station", name=each["name"]),
            tr(said),
            partial(sections.draw_svg, tr, 2.2, partial(draw_chart, each)),
        )
        for each in found["parameters"]
        if each["name"] in moved and each["chart"]
    )


def _moves(found: Mapping[str, Any]) -> fleet_text.Rows:
    header, rows = fleet_text.drift_rows(found)
    return header, [(*row[:2], f"a {row[2]}", *row[3:]) for row in rows]


def _risks(found: Mapping[str, Any], tr: sections.Translator) -> sections.Section | None:
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
    return _section("Wrong verdicts", (header, rows), tr, (_RISKS,))


def _fixtures(found: Mapping[str, Any], tr: sections.Translator) -> sections.Section | None:
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
            caption = tr("Station {name}", name=name) if name else tr("All units")
            off = [", ".join(axis for axis in "xyz" if is_off(each[axis])) for each in known]
            header: tuple[str, ...] = (tr("position"), "x [deg]", "y [deg]", "z [deg]")
            if any(off):
                header = (*header, tr("off"))
                rows = [(*row, said) for row, said in zip(rows, off, strict=True)]
            tables.append(sections.PageTable(caption, header, tuple(rows)))
    if not tables:
        return None
    return sections.Section(tr("Angles of the positions"), (tr(_FIXTURES),), (), tuple(tables))


def _angle(figure: Mapping[str, float] | None) -> str:
    # A turn about what is up does not show: what stands there is rounding.
    if figure is None or not figure["u"] > _ROUNDING:
        return "-"
    return numbers.uncertain(figure["value"], figure["u"])


def _gauge(found: Mapping[str, Any], tr: sections.Translator) -> sections.Section | None:
    gauge = found.get("gauge")
    if gauge is None:
        return None
    table = _table(tr.message(fleet_text.gauge_title(gauge)), fleet_text.gauge_rows(gauge), tr)
    return sections.Section(tr("Repeatability and reproducibility"), (tr(_GAUGE),), (), (table,))


def _tables_of(found: Mapping[str, Any], tr: sections.Translator) -> sections.Section:
    rows = tuple((each["file"], each["sha256"] or "-") for each in found["input"])
    table = sections.PageTable(tr("Tables"), (tr("table"), "SHA-256"), rows, left=2)
    return sections.Section(tr("Data"), tables=(table,))
