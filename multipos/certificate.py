"""What a report of a calibration says: its sections, tables and figures, in English or Chinese.

The sections are what a calibration certificate contains by clause 7.8 of ISO/IEC 17025:2017, as
far as the data know it; what only the laboratory knows comes from its TOML file, and where that
is silent a field stays open, marked as such. `reports` writes the content as HTML, Markdown or
plain text. Figures are functions here and drawn only where they are wanted.
"""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from multipos import plots
from multipos.budgets import KINDS
from multipos.calibration import Calibration, labels
from multipos.derived import intrinsic_gradient
from multipos.errors import MultiposError
from multipos.files import read_toml
from multipos.formatting import number, uncertain
from multipos.model import COMPONENTS
from multipos.quantiles import coverage_factor
from multipos.translations import Translator
from multipos.uncertainty import Evaluation, evaluate_budget
from multipos.validity import sphere_uncertainty

LAB_FIELDS = {
    "report": {
        "number": "Report number",
        "issued": "Date of issue",
        "authorised_by": "Authorised by",
    },
    "laboratory": {
        "name": "Laboratory",
        "address": "Address",
        "location": "Place of calibration",
        "accreditation": "Accreditation",
    },
    "customer": {"name": "Customer", "address": "Address of the customer"},
    "item": {
        "description": "Item",
        "manufacturer": "Manufacturer",
        "type": "Type",
        "serial": "Serial number",
        "condition": "Condition",
        "received": "Date of receipt",
    },
    "measurement": {
        "performed": "Date of calibration",
        "method": "Method",
        "conditions": "Environmental conditions",
        "traceability": "Metrological traceability",
        "deviations": "Deviations from the method",
        "remarks": "Remarks",
    },
}
_WIDE = 16  # parameters beyond which the correlation matrix is only a figure


@dataclass(frozen=True)
class Grid:
    """A table: its caption, header and rows of text; the first `left` columns hold words."""

    caption: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    left: int = 1


@dataclass(frozen=True)
class Figure:
    """A figure: caption, what it shows in words, and the function that draws it as SVG."""

    caption: str
    description: str
    draw: Callable[[], str]


@dataclass(frozen=True)
class Section:
    """A section of the report, in the order paragraphs, figures, tables."""

    title: str
    paragraphs: tuple[str, ...] = ()
    figures: tuple[Figure, ...] = ()
    tables: tuple[Grid, ...] = ()


@dataclass(frozen=True)
class Content:
    """A whole report.

    Attributes
    ----------
    language, title, subtitle : str
    warnings : tuple of str
    fields : tuple of (label, text or None)
        What only the laboratory knows; None where it has not said.
    sections : tuple of Section
    words : mapping of str to str
        The template's own words, translated.
    """

    language: str
    title: str
    subtitle: str
    warnings: tuple[str, ...]
    fields: tuple[tuple[str, str | None], ...]
    sections: tuple[Section, ...]
    words: Mapping[str, str] = field(default_factory=dict)


def read_lab(source: "str | os.PathLike[str] | Mapping[str, Any] | None") -> dict[str, str]:
    """Return what the laboratory says, by ``section.key``.

    Raises
    ------
    MultiposError
        The file is missing or not TOML, or has a section or key that a report does not know.
    """
    if source is None:
        return {}
    where = "the lab file" if isinstance(source, Mapping) else str(source)
    tables = source if isinstance(source, Mapping) else read_toml(source, "lab file")
    said = {}
    for section, table in tables.items():
        if section not in LAB_FIELDS or not isinstance(table, Mapping):
            raise MultiposError(
                f"{where}: unknown section [{section}]; a report knows {', '.join(LAB_FIELDS)}."
            )
        for key, value in table.items():
            if key not in LAB_FIELDS[section]:
                raise MultiposError(
                    f"{where}, [{section}]: unknown key '{key}'; it takes "
                    f"{', '.join(LAB_FIELDS[section])}."
                )
            said[f"{section}.{key}"] = str(value)
    return said


def build_content(
    calibration: Calibration,
    *,
    lab: "str | os.PathLike[str] | Mapping[str, Any] | None" = None,
    language: str = "en",
) -> Content:
    """Return what the report of a calibration says.

    Parameters
    ----------
    calibration : Calibration
    lab : path or mapping, optional
        What only the laboratory knows.
    language : str
        'en' or 'zh'.
    """
    tr = Translator(language)
    said = read_lab(lab)
    c = calibration
    budget = evaluate_budget(c)
    fields = tuple(
        (tr(label), said.get(f"{section}.{key}"))
        for section, keys in LAB_FIELDS.items()
        for key, label in keys.items()
    )
    return Content(
        language=language,
        title=tr("Calibration report"),
        subtitle=tr(
            "Accelerometer with outputs {outputs}, model {model}",
            outputs=", ".join(c.outputs), model=c.model.text,
        ),
        warnings=tuple(
            tr.message(text) for text in (*c.diagnostics.warnings, *c.diagnostics.outliers)
        ),
        fields=fields,
        sections=(
            _parameters(c, tr),
            _sensor(c, budget, tr),
            _uncertainty(c, budget, tr),
            _sphere(c, tr),
            _residuals(c, tr),
            _errors(c, tr),
            _positions(c, tr),
            _correlation(c, tr),
            _checks(c, tr),
            _method(c, tr),
            _statements(c, tr),
        ),
        words={text: tr(text) for text in (
            "Warnings", "Administrative data", "to be filled in by the laboratory",
            "There is nothing to warn of.", "Contents", "end of the report",
        )},
    )  # fmt: skip


def _svg(tr: Translator, rows: int, height: float, draw: Callable[[Any], None]) -> str:
    figure, axes = plots.new_figure(rows, height=height)
    draw(axes)
    return tr.svg(plots.to_svg(figure))


def _parameters(c: Calibration, tr: Translator) -> Section:
    rows = []
    for output, term in c.model.keys:
        p = c[output, str(term)]
        rows.append(
            (p.name, p.symbol or "", tr.message(p.label), p.unit, uncertain(p.value, p.u),
             number(p.u, 2), number(p.k, 3), number(p.U, 2), number(p.dof))
        )  # fmt: skip
    header = ("Parameter", "Symbol", "Meaning", "Unit", "Value(u)", "u", "k", "U", "dof")
    symbols = any(row[1] for row in rows)
    keep = [i for i in range(len(header)) if symbols or i != 1]
    return Section(
        tr("Results"),
        (
            tr(
                "The model of output i is y_i = sum of coefficients times terms of the reference "
                "in g; the terms of each output are in the table."
            ),
            tr(
                "U = k u is the expanded uncertainty for a coverage probability of {percent} %, "
                "with k from Student's t at the effective degrees of freedom (dof). It says how "
                "well the coefficients of this model are known. Whether the model is right is "
                "outside it; the residuals and checks below speak of that.",
                percent=f"{100.0 * c.confidence:g}",
            ),
        ),
        tables=(
            Grid(
                tr("Parameters with uncertainty"),
                tuple(tr(header[i]) for i in keep),
                tuple(tuple(row[i] for i in keep) for row in rows),
                left=4 if symbols else 3,
            ),
        ),
    )


def _sensor(c: Calibration, budget: Evaluation, tr: Translator) -> Section:
    """Return what the sensor is: sensitivities, offsets, angles, with U."""
    rows = []
    if c.intrinsic is not None:
        values, gradient = intrinsic_gradient(c.model, c.parameters, c._mean)
        u, dof, _ = budget.combine(gradient)
        m = len(c.outputs)
        names = [
            *((tr("Sensitivity of {output}", output=o), f"{c.model.unit}/g") for o in c.outputs),
            *((tr("Offset of {output}", output=o), "g") for o in c.outputs),
            *((tr("Angle between input axes {pair}", pair=p), "deg") for p in ("xy", "xz", "yz")),
            *((tr("Mounting, rotation about {axis}", axis=a), "deg") for a in COMPONENTS),
        ]
        for (name, unit), value, sd, nu in zip(
            names, values.tolist(), u.tolist(), dof.tolist(), strict=True
        ):
            k = coverage_factor(c.confidence, nu)
            shown = "1" if unit == "g/g" else unit
            rows.append((name, shown, uncertain(value, sd), number(k * sd, 2), number(k, 3)))
        assert len(names) == 2 * m + 6
    for pair, found in c.installation_deg.items():
        in_mrad = {key: np.pi / 0.18 * size for key, size in found.items()}
        for unit, entry in (("deg", found), ("mrad", in_mrad)):
            rows.append(
                (tr("Output on {i} leans to {j}", i=pair[0], j=pair[1]), unit,
                 uncertain(entry["value"], entry["u"]), "", "")
            )  # fmt: skip
    if not rows:
        return Section(tr("The sensor"), (tr("The model has too few linear terms for it."),))
    header = tuple(map(tr, ("Quantity", "Unit", "Value(u)", "U", "k")))
    return Section(
        tr("The sensor"),
        (tr("Quantities derived from the parameters, with their full covariance."),),
        tables=(Grid(tr("Sensitivity, offset and axes"), header, tuple(rows), left=2),),
    )


def _uncertainty(c: Calibration, budget: Evaluation, tr: Translator) -> Section:
    seen, lines = set(), []
    for row in budget.rows:
        if row.quantity in seen:
            continue
        seen.add(row.quantity)
        lines.append(
            (tr(row.text), row.evaluation, tr(row.distribution), number(row.u, 3), row.unit,
             number(float(row.dof.min())), tr("yes") if row.common else tr("no"),
             tr("in the scatter") if row.contained.all() else tr("added"))
        )  # fmt: skip
    stated = c.extra.get("budget", {}).get("tables", {})
    absent = [
        tr(kind.text) for name, kind in KINDS.items() if name not in seen and name not in stated
    ]
    names = list(dict.fromkeys(row.quantity for row in budget.rows))
    contributions = [
        (name, *(_contribution(budget, quantity, i) for quantity in names), number(c.u[i], 2))
        for i, name in enumerate(budget.names)
    ]
    paragraphs = [
        tr(
            "Every input quantity enters by what it does to the parameters through this estimator "
            "at these positions. Quantities marked as common are systematic: they are the same at "
            "all positions and in repeated calibrations. What stands in brackets is independent at "
            "every position, so the scatter of the residuals holds it already and it is not "
            "added again."
        )
    ]
    if absent:
        paragraphs.append(tr("Not in the budget: {list}.", list=tr.listed(absent)))
    return Section(
        tr("Uncertainty budget"),
        tuple(paragraphs),
        (
            Figure(
                tr("Share of every input quantity in the variance of each parameter"),
                tr("Stacked bars, one for each parameter; the numbers are in the table below."),
                lambda: _svg(tr, 1, 0.9 + 0.2 * len(budget.names),
                             lambda axes: plots.draw_budget(budget, axes[0])),
            ),
        ),
        (
            Grid(
                tr("Input quantities"),
                tuple(map(tr, ("Quantity", "Type", "Distribution", "u", "Unit", "dof", "Common",
                               "Treatment"))),
                tuple(lines),
                left=3,
            ),
            Grid(
                tr("Contributions to the standard uncertainty of each parameter"),
                (tr("Parameter"), *(tr(name) for name in names), tr("combined u")),
                tuple(contributions),
            ),
        ),
    )  # fmt: skip


def _contribution(budget: Evaluation, quantity: str, parameter: int) -> str:
    """Return what a quantity contributes; in brackets what the scatter holds already."""
    rows = [row for row in budget.rows if row.quantity == quantity]
    size = float(np.sqrt(sum(max(row.covariance[parameter, parameter], 0.0) for row in rows)))
    if not size > 1e-12 * float(np.sqrt(budget.covariance[parameter, parameter])):
        return "0"  # rounding
    contained = any(row.contained[parameter] for row in rows)
    return f"({number(size, 2)})" if contained else number(size, 2)


def _sphere(c: Calibration, tr: Translator) -> Section:
    rows = []
    allowed = "third_order" in c.extra.get("budget", {}).get("tables", {})
    for size in (1.0, 2.0, 5.0) if allowed else (1.0,):
        for what, axes in sphere_uncertainty(c, size=size).items():
            if what == "tilt_deg" and size > 1.0:
                continue
            for axis, entry in axes.items():
                rows.append(
                    (tr("force along {axis}", axis=axis) if what == "force"
                     else tr("tilt of {axis}", axis=axis),
                     f"{size:g} g" + ("" if size <= 1.0 else " *"),
                     "g" if what == "force" else "deg",
                     number(entry["rms"], 2), number(entry["worst"], 2), number(entry["k"], 3),
                     number(entry["U"], 2), ", ".join(f"{v / size:.2f}" for v in entry["at"]))
                )  # fmt: skip
    paragraphs = [
        tr(
            "Uncertainty of compensated force and of tilt from the parameters, over all "
            "directions; the noise of the reading that is compensated comes on top."
        ),
        tr(
            "Lines marked * are beyond what was applied; U there grows with the third-order term "
            "that the budget allows."
        )
        if allowed
        else tr(
            "The calibration holds within what was applied, up to {size} g. Beyond, terms that the "
            "positions cannot show may grow without limit.",
            size=f"{float(np.linalg.norm(c.reference, axis=1).max()):.4g}",
        ),
    ]
    header = ("Quantity", "At", "Unit", "rms u", "worst u", "k", "U", "Worst direction")
    return Section(
        tr("Compensated force and tilt"),
        tuple(paragraphs),
        tables=(Grid(tr("Worst case and rms over the sphere"), tuple(map(tr, header)),
                     tuple(rows), left=3),),
    )  # fmt: skip


def _residuals(c: Calibration, tr: Translator) -> Section:
    def draw(axes: Any) -> None:
        for output, one in zip(c.outputs, axes, strict=True):
            plots.draw_residuals(c, one, output=output)

    rows = [
        (label, *(f"{value:+.3e}" for value in residual))
        for label, residual in zip(labels(c.readings), c.residuals.tolist(), strict=True)
    ]
    rows.append(("s", *(number(value, 3) for value in c.residual_sd.tolist())))
    rows.append((tr("dof"), *(number(value) for value in c.dof.tolist())))
    return Section(
        tr("Residuals"),
        (tr("Residual = reading − model. The bars are ±2 standard deviations of each residual."),),
        (
            Figure(
                tr("Residuals at every position"),
                tr("One panel for each output; the numbers are in the table below."),
                lambda: _svg(tr, len(c.outputs), 1.9, draw),
            ),
        ),
        (
            Grid(
                tr("Residuals at every position"),
                (tr("Position"), *(f"{output} [{c.model.unit}]" for output in c.outputs)),
                tuple(rows),
            ),
        ),
    )


def _errors(c: Calibration, tr: Translator) -> Section:
    before, after = plots.nominal_error(c), plots.compensated_error(c)
    rows = [
        (label, number(b, 3), number(a, 3))
        for label, b, a in zip(labels(c.readings), before.tolist(), after.tolist(), strict=True)
    ]
    for name, size in (("largest", np.max), ("rms", lambda e: np.sqrt(np.mean(e**2)))):
        rows.append((tr(name), number(float(size(before)), 3), number(float(size(after)), 3)))
    lines = [
        (output, number(found["without_model_percent"], 3), number(found["with_model_percent"], 3))
        for output, found in c.linearity.items()
    ]
    return Section(
        tr("Error before and after"),
        (
            tr(
                "Before: readings divided by one nominal scale factor (1 for readings in g, else "
                "the mean of the outputs), without bias. After: compensated. At the same positions "
                "that were fitted."
            ),
            tr(
                "Linearity: the largest distance of a reading from the least-squares line in its "
                "own reference (without the model), and the largest residual of the model (with "
                "it), in percent of the span from −1 g to +1 g. The six-position paper's table 3 "
                "does not follow from its table 2, and its definition is not known."
            ),
        ),
        (
            Figure(
                tr("Size of the error at every position, before and after compensation"),
                tr("Squares before, circles after; the numbers are in the table below."),
                lambda: _svg(tr, 1, 2.4, lambda axes: plots.draw_errors(c, axes[0])),
            ),
        ),
        (
            Grid(tr("Size of the error [g]"), tuple(map(tr, ("Position", "before", "after"))),
                 tuple(rows)),
            Grid(
                tr("Linearity [%]"),
                tuple(map(tr, ("Output", "without the model", "with the model"))),
                tuple(lines),
            ),
        ),
    )  # fmt: skip


def _positions(c: Calibration, tr: Translator) -> Section:
    up = c.reference / np.linalg.norm(c.reference, axis=1)[:, None]
    up = (-up if c.convention == "gravity" else up) + 0.0
    rows = [
        (label, *(f"{value:.4f}" for value in where), *(f"{value:.3f}" for value in leverage))
        for label, where, leverage in zip(
            labels(c.readings), up.tolist(), c.diagnostics.leverage.tolist(), strict=True
        )
    ]
    return Section(
        tr("Positions"),
        (
            tr(
                "The up vector of every position in case axes, and how far each position fixes its "
                "own fit (leverage). At a leverage of 1 the model passes through the reading "
                "whatever it is."
            ),
        ),
        (
            Figure(
                tr("Coverage of the sphere, equal-area"),
                tr("The left disc is the half of the sphere around +z, the right one around −z."),
                lambda: _svg(tr, 1, 3.2, lambda axes: plots.draw_coverage(c, axes[0])),
            ),
            Figure(
                tr("Leverage of every position"),
                tr("Bars, one for each output; the numbers are in the table below."),
                lambda: _svg(tr, 1, 2.4, lambda axes: plots.draw_leverage(c, axes[0])),
            ),
        ),
        (
            Grid(
                tr("Up vector and leverage of every position"),
                (tr("Position"), "x", "y", "z", *(f"h {output}" for output in c.outputs)),
                tuple(rows),
            ),
        ),
    )


def _correlation(c: Calibration, tr: Translator) -> Section:
    names = c.names
    rows = tuple(
        (name, *(number(value, 2) if abs(value) >= 0.005 else "0" for value in row))
        for name, row in zip(names, c.correlation.tolist(), strict=True)
    )
    small = len(names) <= _WIDE
    return Section(
        tr("Correlation"),
        (
            tr(
                "Correlation of the parameters; the whole covariance is in the calibration file. "
                "What is computed from several parameters needs it."
            ),
        ),
        (
            Figure(
                tr("Correlation matrix of the parameters"),
                tr("Blue is positive, orange negative; coefficients from 0.05 are written in."),
                lambda: _svg(tr, 1, 5.4, lambda axes: plots.draw_correlation(c, axes[0])),
            ),
        ),
        (Grid(tr("Correlation coefficients"), ("", *names), rows),) if small else (),
    )


def _checks(c: Calibration, tr: Translator) -> Section:
    rows: list[tuple[str, str]] = [
        (tr("rms of what is left after compensation"), f"{c.rms:.3e} g"),
        (tr("rank and parameters"), f"{c.diagnostics.rank} / {c.diagnostics.parameters}"),
        (tr("condition of the design"), number(c.diagnostics.condition, 3)),
    ]
    if c.cross_check is not None:
        rows.append((tr("closed form against least squares"), f"{c.cross_check:.1e}"))
    for output, test in c.diagnostics.lack_of_fit.items():
        rows.append(
            (tr("lack of fit of {output} against repeats", output=output),
             f"F = {number(_float(test['F']))}, p = {number(_float(test['p']), 3)}")
        )  # fmt: skip
    header = (tr("Check"), tr("Result"))
    return Section(tr("Checks"), tables=(Grid(tr("Checks of the fit"), header, tuple(rows)),))


def _float(value: object) -> float | None:
    return float(value) if isinstance(value, int | float) else None


def _method(c: Calibration, tr: Translator) -> Section:
    gravity = tr("local, one g") if c.gravity is None else (
        f"{c.gravity.value:.10g} m/s^2, u = {c.gravity.u:.3g} m/s^2"
    )  # fmt: skip
    rows: list[tuple[str, str]] = [
        (tr("Readings"), c.readings.source or tr("from memory")),
        (tr("SHA-256 of the readings"), c.readings.sha256 or "-"),
        (tr("Number of readings"), str(len(c.readings))),
        (tr("Outputs and unit"), f"{', '.join(c.outputs)} [{c.model.unit}]"),
        (tr("Model"), c.model.text),
        (tr("Convention"), tr(c.convention)),
        (tr("Gravity"), gravity),
        (tr("Estimator"), tr(c.estimator)),
        (tr("Criterion"), tr(c.criterion)),
        (tr("Computed"), f"{c.created}, multipos {c.version}"),
    ]
    for name, column in c.readings.environment.items():
        if np.isfinite(column).all():
            rows.append((tr(name), f"{column.min():.6g} … {column.max():.6g}"))
    header = (tr("Item"), tr("Value"))
    return Section(
        tr("Method and data"), tables=(Grid(tr("How it was done"), header, tuple(rows), left=2),)
    )


def _statements(c: Calibration, tr: Translator) -> Section:
    said: Sequence[str] = (
        "The results relate only to the item calibrated, as it was and where it was.",
        "Uncertainties are evaluated by JCGM 100 (GUM).",
        "This report should not be reproduced except in full without approval of the laboratory.",
    )
    return Section(tr("Statements"), tuple(map(tr, said)))
