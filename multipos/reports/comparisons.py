"""What a report of repeated calibrations says, from the file that `compare -o FILE.json` wrote.

The verdict and what has moved stand first, then the parameters run by run, and how stable the
biases are. Repeated regressions have a table of their terms.
"""

import math
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from multipos.errors import MultiposError
from multipos.files.numbers import (
    beyond_rounding,
    chance,
    common_units,
    decimals_of,
    number,
    p_in_words,
    plain_number,
    readable_unit,
    uncertain,
)
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
from multipos.files.trees import read_json_value
from multipos.finding import FINDINGS, errors_of, read_findings, serious
from multipos.numerics.arrays import Array
from multipos.plots.runs import draw_values
from multipos.reports.certificate import Content, lab_fields, read_lab
from multipos.reports.sections import (
    Figure,
    Language,
    PageTable,
    Section,
    Translator,
    draw_svg,
    with_annex,
)
from multipos.reports.sensor_result import sessions_section
from multipos.sensor.calibration_file import from_dict
from multipos.verification.comparison import change_rows, comparison_sentence

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
_KEYS = ("calibrations", "regressions")


def read_comparison(path: str | os.PathLike[str]) -> dict[str, Any] | None:
    """Return what a file says that `compare` wrote; None where it is another file.

    Raises
    ------
    MultiposError
        It is such a file, and damaged.
    """
    try:
        content = read_json_value(path, "file")
    except MultiposError:  # whoever reads it next says so
        return None
    if not isinstance(content, dict) or "consistent" not in content:
        return None
    kind = next((key for key in _KEYS if key in content), None)
    if kind is None:
        return None
    described = _CALIBRATIONS if kind == "calibrations" else _REGRESSIONS
    require(content, described, str(path), "compare again")
    runs = len(content[kind])
    entries = content["parameters" if kind == "calibrations" else "terms"]
    columns = [entry[key] for entry in entries for key in ("values", "U") if key in entry]
    if any(len(column) != runs for column in columns):
        raise MultiposError(f"{path}: it has not a value for each of {runs} runs; compare again.")
    return content


def comparison_content(
    found: Mapping[str, Any],
    *,
    lab: "str | os.PathLike[str] | Mapping[str, Any] | None" = None,
    language: Language = "en",
) -> Content:
    """Return what the report of repeated calibrations or regressions says.

    Parameters
    ----------
    found : mapping
        As the JSON of `compare` holds it.
    lab, language
        As of `multipos.report`.
    """
    tr = Translator(language)
    said = read_lab(lab)
    findings = read_findings(found)
    of_regressions = "regressions" in found
    runs = found["regressions" if of_regressions else "calibrations"]
    sections = (
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
        sections=with_annex((*sections, _origin(runs, tr)), tr),
        lab=said,
        result=_result(found, tr),
    )


def _result(found: Mapping[str, Any], tr: Translator) -> Section:
    """Return by what test the runs agree, what has moved, and the biases by run.

    Of regressions the terms by run.
    """
    if "parameters" not in found:
        return Section(tr("Result"), tables=(_terms(found, tr),))
    paragraphs: list[str] = []
    header, rows = change_rows(found)
    changes = PageTable(
        tr("Changes between the first and the last"),
        tuple(map(tr, header)),
        tuple(map(tuple, rows)),
        left=2,
    )
    if found["p"] is not None:
        paragraphs.append(
            f"{tr(found['test'])}: {number(found['statistic'])}, {p_in_words(found['p'])}"
        )
    moved = [entry["name"] for entry in found["parameters"] if entry["moved"]]
    if moved:
        paragraphs.append(tr("Moved beyond chance: {names}.", names=tr.listed(moved)))
    biases = [entry for entry in found["parameters"] if entry["term"] == "1"]
    picture = Figure(
        tr("Biases by run, each less its mean, with U")
        if all("U" in entry for entry in biases)
        else tr("Biases by run, each less its mean"),
        tr("One line for each output; the numbers are in the table below."),
        lambda: draw_svg(
            tr,
            1,
            2.4,
            lambda axes: draw_values(
                {entry["name"]: _less_mean(entry) for entry in biases},
                axes[0],
                unit=biases[0]["unit"],
            ),
        ),
    )
    return Section(
        tr("Result"), tuple(paragraphs), (picture,) if biases else (), (changes,) if rows else ()
    )


def _less_mean(entry: Mapping[str, Any]) -> tuple[Array, Array]:
    """Return the values of a parameter less their mean, and their U: NaN where there is none."""
    values = np.array([_or_nan(value) for value in entry["values"]])
    finite = values[np.isfinite(values)]
    U = [_or_nan(size) for size in entry.get("U", (None,) * len(values))]
    return values - (finite.mean() if len(finite) else math.nan), np.array(U)


def _parameters(found: Mapping[str, Any], tr: Translator) -> Section:
    runs = [str(i + 1) for i in range(len(found["calibrations"]))]
    per = found["parameters"][0]["drift_unit"].rpartition("/")[2]
    header = (
        *(tr(word) for word in ("Parameter", "Unit")),
        *runs,
        *(tr("mean(sd)"), tr("drift per {unit}", unit=tr(per)), tr("its p"), "p", ""),
    )
    units = common_units(
        (entry["unit"], _or_nan(value))
        for entry in found["parameters"]
        for value in entry["values"]
    )
    rows = tuple(
        (
            entry["name"],
            *_values_of(entry, units[entry["unit"]]),
            chance(entry["drift_p"]),
            chance(entry["p"]),
            tr("moved") if entry["moved"] else "",
        )
        for entry in found["parameters"]
    )
    finite = tr(
        "Each parameter in every run. p is the probability of such differences by the stated "
        "uncertainties; drift is the slope over the runs, with its own p."
    )
    table = PageTable(tr("Parameters by run"), header, rows, left=2)
    return Section(tr("Parameters"), (finite,), tables=(table,))


def _values_of(entry: Mapping[str, Any], shown: tuple[float, str]) -> list[str]:
    """Return unit, values, mean and sd, and drift of a parameter, in the unit to show."""
    values = np.array([_or_nan(value) for value in entry["values"]])
    factor, unit = shown
    sd = factor * _or_nan(entry["sd"])
    decimals = decimals_of(sd)
    form = ".7g" if decimals is None else f".{decimals + 1}f"
    middle = factor * _or_nan(entry["mean"])
    cells = ["-" if np.isnan(value) else f"{value:{form}}" for value in factor * values]
    drift = None if entry["drift"] is None else beyond_rounding(factor * entry["drift"])
    mean = f"{middle:{form}}" if decimals is None else uncertain(middle, sd)
    return [unit, *cells, mean, plain_number(drift, 2)]


def _combined(found: Mapping[str, Any], tr: Translator) -> list[Section]:
    """Return the one calibration of all sessions, or how it is made."""
    if "combined" not in found:
        finite = tr("multipos compare … --combine -o CAL.json makes one calibration of all runs.")
        return [Section(tr("Combined sessions"), (finite,))]
    combined = from_dict(found["combined"], "the combined calibration")
    return [] if combined.sessions is None else [sessions_section(combined, combined.sessions, tr)]


def _stability(found: Mapping[str, Any], tr: Translator) -> Section:
    unit = next((e["unit"] for e in found["parameters"] if e["term"] == "1"), "")
    estimated_of = [sd for sd in found["bias_stability"].values() if sd is not None]
    factor, unit = readable_unit(max(estimated_of, default=0.0), unit)
    rows = tuple(
        (output, plain_number(None if sd is None else factor * sd))
        for output, sd in found["bias_stability"].items()
    )
    finite = tr("Standard deviation of the repeated biases, from switch-on to switch-on.")
    table = PageTable(tr("Bias stability"), (tr("Output"), f"sd [{unit}]"), rows)
    return Section(tr("Bias stability"), (finite,), tables=(table,))


def _terms(found: Mapping[str, Any], tr: Translator) -> PageTable:
    runs = [str(i + 1) for i in range(len(found["regressions"]))]
    rows = tuple(
        (
            entry["segment"],
            entry["term"],
            *(number(value, 5) for value in entry["values"]),
            number(entry["sd"], 2),
            chance(entry["p"]),
        )
        for entry in found["terms"]
    )
    header = (tr("Segment"), tr("Term"), *runs, "sd", "p")
    return PageTable(tr("Terms by run"), header, rows, left=2)


def _origin(runs: Sequence[Mapping[str, Any]], tr: Translator) -> Section:
    rows = tuple(
        (str(i), run["file"] or "-", run["created"] or "-") for i, run in enumerate(runs, start=1)
    )
    header = (tr("Run"), tr("File"), tr("Computed"))
    return Section(tr("Data"), tables=(PageTable(tr("Runs"), header, rows, left=3),))


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value
