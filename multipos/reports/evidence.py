"""The sections of a report on why it may be believed: residuals, errors, positions, checks."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from multipos.doubts.criticism import find_influence, fourier_residuals, judge_terms
from multipos.doubts.joint_tests import judge_terms_jointly
from multipos.files.numbers import largest_rows, number
from multipos.plots.calibration import (
    compensated_error,
    draw_correlation,
    draw_coverage,
    draw_errors,
    draw_leverage,
    draw_residuals,
    nominal_error,
)
from multipos.reports.findings import Figure, Grid, Section, draw_svg
from multipos.reports.translations import Translator
from multipos.sensor.calibration import Calibration
from multipos.sensor.expressions import ExpressionModel
from multipos.uncertainty.monte_carlo import MonteCarlo

_SHOWN = " (the {shown} largest of {count}; the calibration file has all)"
_WIDE = 16  # parameters beyond which the correlation matrix is only a figure


def residuals_section(c: Calibration, tr: Translator) -> Section:
    """Return the residuals of every position."""

    def draw(axes: Any) -> None:
        for output, one in zip(c.outputs, axes, strict=True):
            draw_residuals(c, one, output=output)

    shown, suffix = _largest(tr, c.relative_residuals)
    names = c.readings.labels
    rows = [
        (names[row], *(f"{value:+.3e}" for value in c.residuals[row].tolist())) for row in shown
    ]
    paragraphs = [
        tr("Residual = reading − model. The bars are ±2 standard deviations of each residual.")
    ]
    if c.estimator.endswith("orientation"):
        paragraphs.append(
            tr(
                "The orientations were estimated with the parameters, so a residual shows only "
                "what no turn of its position explains."
            )
        )
    rows.append(("s", *(number(value, 3) for value in c.residual_sd.tolist())))
    rows.append((tr("dof"), *(number(value) for value in c.dof.tolist())))
    return Section(
        tr("Residuals"),
        tuple(paragraphs),
        (
            Figure(
                tr("Residuals at every position"),
                tr("One panel for each output; the numbers are in the table below."),
                lambda: draw_svg(tr, len(c.outputs), 1.9, draw),
            ),
        ),
        (
            Grid(
                tr("Residuals at every position") + suffix,
                (tr("Position"), *(f"{output} [{c.model.unit}]" for output in c.outputs)),
                tuple(rows),
            ),
        ),
    )


def errors_section(c: Calibration, tr: Translator) -> Section:
    """Return the errors before and after compensation, and linearity."""
    before, after = nominal_error(c), compensated_error(c)
    shown, suffix = _largest(tr, after)
    names = c.readings.labels
    rows = [
        (names[row], number(float(before[row]), 3), number(float(after[row]), 3)) for row in shown
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
                lambda: draw_svg(tr, 1, 2.4, lambda axes: draw_errors(c, axes[0])),
            ),
        ),
        (
            Grid(
                tr("Size of the error [g]") + suffix,
                tuple(map(tr, ("Position", "before", "after"))),
                tuple(rows),
            ),
            Grid(
                tr("Linearity [%]"),
                tuple(map(tr, ("Output", "without the model", "with the model"))),
                tuple(lines),
            ),
        ),
    )


def positions_section(c: Calibration, tr: Translator) -> Section:
    """Return where the positions were and what each decides."""
    up = c.reference / np.linalg.norm(c.reference, axis=1)[:, None]
    up = (-up if c.convention == "gravity" else up) + 0.0
    leverage, names = c.diagnostics.leverage, c.readings.labels
    shown, suffix = _largest(tr, leverage.max(axis=1))
    rows = [
        (
            names[row],
            *(f"{value:.4f}" for value in up[row].tolist()),
            *(f"{value:.3f}" for value in leverage[row].tolist()),
        )
        for row in shown
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
                lambda: draw_svg(tr, 1, 3.2, lambda axes: draw_coverage(c, axes[0])),
            ),
            Figure(
                tr("Leverage of every position"),
                tr("Bars, one for each output; the numbers are in the table below."),
                lambda: draw_svg(tr, 1, 2.4, lambda axes: draw_leverage(c, axes[0])),
            ),
        ),
        (
            Grid(
                tr("Up vector and leverage of every position") + suffix,
                (tr("Position"), "x", "y", "z", *(f"h {output}" for output in c.outputs)),
                tuple(rows),
            ),
        ),
    )


def correlation_section(c: Calibration, tr: Translator) -> Section:
    """Return the correlation of the parameters."""
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
                lambda: draw_svg(tr, 1, 5.4, lambda axes: draw_correlation(c, axes[0])),
            ),
        ),
        (Grid(tr("Correlation coefficients"), ("", *names), rows),) if small else (),
    )


def checks_section(c: Calibration, tr: Translator, simulated: MonteCarlo | None) -> Section:
    """Return the checks of the fit."""
    rows: list[tuple[str, str]] = [
        (tr("rms of what is left after compensation"), f"{c.rms:.3e} g"),
        (tr("rank and parameters"), f"{c.diagnostics.rank} / {c.diagnostics.parameters}"),
        (tr("condition of the design"), number(c.diagnostics.condition, 3)),
    ]
    if c.cross_check is not None:
        rows.append((tr("closed form against least squares"), f"{c.cross_check:.1e}"))
    for output, test in c.diagnostics.lack_of_fit.items():
        rows.append(
            (
                tr("lack of fit of {output} against repeats", output=output),
                f"F = {number(_float(test['F']))}, p = {number(_float(test['p']), 3)}",
            )
        )
    grids = [Grid(tr("Checks of the fit"), (tr("Check"), tr("Result")), tuple(rows))]
    paragraphs: list[str] = []
    tests = _joint_tests(c, tr)
    if c.estimator.exact:
        tests += _criticism(c, tr)
    if tests:
        grids += tests
        paragraphs.append(
            tr(
                "A small p says that chance alone would rarely do the same: that a term is needed, "
                "or that residuals follow the angle of the roll. With many tests in a table a few "
                "small p are expected."
            )
        )
    if simulated is not None:
        grids.append(_simulated(simulated, tr))
        paragraphs.append(
            tr(
                "Monte Carlo draws every input quantity from its law, lets it act in full and "
                "estimates again (JCGM 101). U is valid where the ends of both intervals agree "
                "within the tolerance."
            )
        )
    return Section(tr("Checks"), tuple(paragraphs), tables=tuple(grids))


def _joint_tests(c: Calibration, tr: Translator) -> list[Grid]:
    """Return tests of terms over all outputs; none of a robust fit or an expression."""
    if c.robust_weight is not None or isinstance(c.model, ExpressionModel):
        return []
    rows = [
        (
            t.terms,
            tr("in the model") if t.inside else tr("not in the model"),
            str(t),
            number(t.p, 2),
        )
        for t in judge_terms_jointly(c)
    ]
    header = tuple(map(tr, ("Terms", "Status", "Statistic", "p")))
    return [Grid(tr("Tests of terms over all outputs"), header, tuple(rows), 2)] if rows else []


def _simulated(found: MonteCarlo, tr: Translator) -> Grid:
    rows = [
        (
            name,
            number(u, 3),
            f"[{low:.7g}, {high:.7g}]",
            f"[{first:.7g}, {last:.7g}]",
            number(tolerance, 2),
            tr("yes") if valid else tr("no"),
        )
        for name, u, (low, high), (first, last), tolerance, valid in zip(
            found.names,
            found.u.tolist(),
            found.symmetric.tolist(),
            found.shortest.tolist(),
            found.tolerance.tolist(),
            found.valid.tolist(),
            strict=True,
        )
    ]
    header = ("Parameter", "u", "Symmetric interval", "Shortest interval", "Tolerance", "U valid")
    return Grid(
        tr("Monte Carlo, {trials} trials", trials=str(found.trials)),
        tuple(map(tr, header)),
        tuple(rows),
    )


def _criticism(c: Calibration, tr: Translator) -> list[Grid]:
    """Return tests of terms, influence of the positions and harmonics of the residuals."""
    grids = []
    terms = [
        (
            t.output,
            t.term,
            tr("in the model") if t.inside else tr("not in the model"),
            number(t.f),
            number(t.dof[1]),
            number(t.p, 2),
            number(t.aicc),
        )
        for t in judge_terms(c)
    ]
    header = ("Output", "Term", "Status", "F", "dof", "p", "AICc if changed")
    if terms:
        grids.append(Grid(tr("Tests of single terms"), tuple(map(tr, header)), tuple(terms), 3))
    found = find_influence(c)
    names = c.readings.labels
    shown, suffix = _largest(tr, np.abs(found.studentised).max(axis=1))
    influence = [
        (
            names[row],
            *(
                number(value, 3)
                for i in range(len(c.outputs))
                for value in (
                    float(found.studentised[row, i]),
                    float(found.cook[row, i]),
                    float(found.left_out[row, i]),
                )
            ),
        )
        for row in shown
    ]
    columns = [f"{name} {output}" for output in c.outputs for name in ("r", "D", "e")]
    grids.append(
        Grid(
            tr(
                "Influence of each position: studentised residual r, Cook's D, leave-one-out "
                "error e"
            )
            + suffix,
            (tr("Position"), *columns),
            tuple(influence),
        )
    )
    waves = [
        (
            entry["roll"],
            entry["output"],
            *(f"{number(w['amplitude'], 2)} ({number(w['p'], 2)})" for w in entry["harmonics"]),
        )
        for entry in fourier_residuals(c)
    ]
    if waves:
        orders = [tr("order {n}", n=str(i)) for i in range(1, max(map(len, waves)) - 1)]
        grids.append(
            Grid(
                tr("Residuals along each roll: amplitude (p)"),
                (tr("Roll about"), tr("Output"), *orders),
                tuple(waves),
                2,
            )
        )
    return grids


def _largest(tr: Translator, sizes: NDArray[np.float64]) -> tuple[list[int], str]:
    """Return the positions that a table shows, and what its title says where it leaves some out."""
    shown = largest_rows(sizes.tolist())
    if len(shown) == len(sizes):
        return shown, ""
    return shown, tr(_SHOWN, shown=str(len(shown)), count=str(len(sizes)))


def _float(value: object) -> float | None:
    return float(value) if isinstance(value, int | float) else None
