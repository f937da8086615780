"""The section of a report on tests of the fit: repeats, terms, influence, harmonics, Monte Carlo.

Each doubt about a finished calibration is a table of it.
"""

import numpy as np

from multipos.doubts.criticism import find_influence, fourier_residuals, judge_terms
from multipos.doubts.joint_tests import judge_terms_jointly
from multipos.files.numbers import number
from multipos.reports.page import PageTable, Section, largest_positions
from multipos.reports.translations import Translator
from multipos.sensor.calibration import Calibration
from multipos.sensor.expressions import ExpressionModel
from multipos.uncertainty.monte_carlo import MonteCarlo


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
    tables = [PageTable(tr("Checks of the fit"), (tr("Check"), tr("Result")), tuple(rows))]
    paragraphs: list[str] = []
    tests = _joint_tests(c, tr)
    if c.estimator.exact:
        tests += _criticism(c, tr)
    if tests:
        tables += tests
        paragraphs.append(
            tr(
                "A small p says that chance alone would rarely do the same: that a term is needed, "
                "or that residuals follow the angle of the roll. With many tests in a table a few "
                "small p are expected."
            )
        )
    if simulated is not None:
        tables.append(_simulated(simulated, tr))
        paragraphs.append(
            tr(
                "Monte Carlo draws every input quantity from its law, lets it act in full and "
                "estimates again (JCGM 101). U is valid where the ends of both intervals agree "
                "within the tolerance."
            )
        )
    return Section(tr("Checks"), tuple(paragraphs), tables=tuple(tables))


def _joint_tests(c: Calibration, tr: Translator) -> list[PageTable]:
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
    return (
        [PageTable(tr("Tests of terms over all outputs"), header, tuple(rows), 2)] if rows else []
    )


def _simulated(found: MonteCarlo, tr: Translator) -> PageTable:
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
    return PageTable(
        tr("Monte Carlo, {trials} trials", trials=str(found.trials)),
        tuple(map(tr, header)),
        tuple(rows),
    )


def _criticism(c: Calibration, tr: Translator) -> list[PageTable]:
    """Return tests of terms, influence of the positions and harmonics of the residuals."""
    return [*_single_terms(c, tr), _influence(c, tr), *_waves(c, tr)]


def _single_terms(c: Calibration, tr: Translator) -> list[PageTable]:
    rows = [
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
    header = tuple(map(tr, ("Output", "Term", "Status", "F", "dof", "p", "AICc if changed")))
    return [PageTable(tr("Tests of single terms"), header, tuple(rows), 3)] if rows else []


def _influence(c: Calibration, tr: Translator) -> PageTable:
    found = find_influence(c)
    names = c.readings.labels
    shown, suffix = largest_positions(tr, np.abs(found.studentised).max(axis=1))
    # r, D and e of an output stand side by side: (n, 3 M)
    figures = np.stack([found.studentised, found.cook, found.left_out], axis=2)
    cells = figures.reshape(len(names), -1)
    rows = [(names[row], *(number(value, 3) for value in cells[row].tolist())) for row in shown]
    columns = [f"{name} {output}" for output in c.outputs for name in ("r", "D", "e")]
    return PageTable(
        tr("Influence of each position: studentised residual r, Cook's D, leave-one-out error e")
        + suffix,
        (tr("Position"), *columns),
        tuple(rows),
    )


def _waves(c: Calibration, tr: Translator) -> list[PageTable]:
    rows = [
        (
            entry["roll"],
            entry["output"],
            *(f"{number(w['amplitude'], 2)} ({number(w['p'], 2)})" for w in entry["harmonics"]),
        )
        for entry in fourier_residuals(c)
    ]
    if not rows:
        return []
    orders = [tr("order {n}", n=str(i)) for i in range(1, max(map(len, rows)) - 1)]
    return [
        PageTable(
            tr("Residuals along each roll: amplitude (p)"),
            (tr("Roll about"), tr("Output"), *orders),
            tuple(rows),
            2,
        )
    ]


def _float(value: object) -> float | None:
    return float(value) if isinstance(value, int | float) else None
