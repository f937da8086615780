"""The section of a report on tests of the fit: repeats, terms, influence, harmonics, Monte Carlo.

Each finding about a finished calibration is a table of it.
"""

from collections.abc import Sequence

import numpy as np

from multipos.diagnostics.criticism import find_influence, fourier_residuals, judge_terms
from multipos.diagnostics.score_tests import judge_included
from multipos.files.numbers import (
    chance,
    common_units,
    decimals_of,
    number,
    p_in_words,
    plain_number,
    readable_unit,
)
from multipos.reports.quantities import column
from multipos.reports.sections import PageTable, Section, Translator, chosen_rows
from multipos.sensor.calibration import Calibration
from multipos.uncertainty.monte_carlo import MonteCarlo


def checks_section(c: Calibration, tr: Translator, simulated: MonteCarlo | None) -> Section:
    """Return the checks of the fit."""
    rows: list[tuple[str, str]] = [
        (tr("rms of what is left after compensation"), c.field.shown(c.rms)),
        (tr("rank and parameters"), f"{c.diagnostics.rank} / {c.diagnostics.parameters}"),
        (tr("condition of the design"), number(c.diagnostics.condition, 3)),
    ]
    if c.cross_check is not None:
        rows.append((tr("closed form against least squares"), f"{c.cross_check:.1e}"))
    for output, test in c.diagnostics.lack_of_fit.items():
        rows.append(
            (
                tr("lack of fit of {output} against repeats", output=output),
                f"F = {number(_float(test['F']))}, {p_in_words(_float(test['p']))}",
            )
        )
    tables = [PageTable(tr("Checks of the fit"), (tr("Check"), tr("Result")), tuple(rows))]
    paragraphs: list[str] = []
    tests = _tests_of_terms(c, tr)
    if c.estimator.exact:
        tests += _criticism(c, tr)
    if tests:
        tables += tests
        paragraphs.append(
            tr(
                "A small p means that chance alone would rarely do the same: that a term is "
                "needed, "
                "or that residuals follow the angle of the roll. With many tests in a table a few "
                "small p are expected."
            )
        )
    if simulated is not None:
        tables.append(_simulated(c, simulated, tr))
        paragraphs.append(
            tr(
                "Monte Carlo draws every input quantity from its law, lets it act in full and "
                "estimates again (JCGM 101). U is valid where the ends of both intervals agree "
                "within the tolerance."
            )
        )
    return Section(tr("Checks"), tuple(paragraphs), tables=tuple(tables))


def _tests_of_terms(c: Calibration, tr: Translator) -> list[PageTable]:
    """Return the tests of terms that the model has, and of those that it could have."""
    tests = [(test, tr("in the model")) for test in judge_included(c)]
    tests += [(test, tr("not in the model")) for test in c.diagnostics.model_tests]
    rows = [(test.term, status, str(test), chance(test.p)) for test, status in tests]
    header = tuple(map(tr, ("Terms", "Status", "Statistic", "p")))
    return (
        [PageTable(tr("Tests of terms over all outputs"), header, tuple(rows), 2)] if rows else []
    )


def _simulated(c: Calibration, found: MonteCarlo, tr: Translator) -> PageTable:
    units = common_units(
        zip(c.model.units, np.abs(found.symmetric).max(axis=1).tolist(), strict=True)
    )
    rows = [
        (
            name,
            *_simulated_cells(u, (low, high), (first, last), tolerance, units[unit]),
            tr("yes") if valid else tr("no"),
        )
        for name, unit, u, (low, high), (first, last), tolerance, valid in zip(
            found.names,
            c.model.units,
            found.u.tolist(),
            found.symmetric.tolist(),
            found.shortest.tolist(),
            found.tolerance.tolist(),
            found.valid.tolist(),
            strict=True,
        )
    ]
    header = (
        *("Parameter", "u", "Symmetric interval", "Shortest interval", "Tolerance", "Unit"),
        "U valid",
    )
    return PageTable(
        tr("Monte Carlo, {trials} trials", trials=str(found.trials)),
        tuple(map(tr, header)),
        tuple(rows),
    )


def _simulated_cells(
    u: float,
    symmetric: Sequence[float],
    shortest: Sequence[float],
    tolerance: float,
    unit: tuple[float, str],
) -> tuple[str, ...]:
    """Return u, both intervals and the tolerance in one unit, and it."""
    factor, shown = unit
    decimals = decimals_of(factor * u)
    form = ".7g" if decimals is None else f".{decimals}f"
    intervals = [
        f"[{factor * low:{form}}, {factor * high:{form}}]" for low, high in (symmetric, shortest)
    ]
    return plain_number(factor * u), *intervals, plain_number(factor * tolerance, 2), shown


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
            chance(t.p),
            number(t.aicc),
        )
        for t in judge_terms(c)
    ]
    header = tuple(map(tr, ("Output", "Term", "Status", "F", "dof", "p", "AICc if changed")))
    if not rows:
        return []
    # On paper the tests over all outputs speak for them.
    return [PageTable(tr("Tests of single terms"), header, tuple(rows), 3, on_paper=False)]


def _influence(c: Calibration, tr: Translator) -> PageTable:
    found = find_influence(c)
    names = c.readings.labels
    shown, kept, suffix = chosen_rows(tr, np.abs(found.studentised).max(axis=1))
    columns: list[str] = []
    cells: list[list[str]] = []
    for i, output in enumerate(c.outputs):
        left_out = column(
            found.left_out[shown, i],
            c.model.unit,
            float(c.residual_sd[i]),
            scale=float(np.abs(c.readings.values[:, i]).max()),
        )
        columns += [f"r {output}", f"D {output}", f"e {output} [{left_out.unit}]"]
        cells += [
            [_two_decimals(size) for size in found.studentised[shown, i].tolist()],
            [_two_decimals(size) for size in found.cook[shown, i].tolist()],
            left_out.cells,
        ]
    rows = zip([names[row] for row in shown], *cells, strict=True)
    return PageTable(
        tr("Influence of each position: studentised residual r, Cook's D, leave-one-out error e")
        + suffix,
        (tr("Position"), *columns),
        tuple(rows),
        on_paper=False,  # residuals, s and leverage stand there, and it follows from them
        kept=kept,
    )


def _two_decimals(size: float) -> str:
    return f"{size:.2f}" if np.isfinite(size) else number(size)


def _waves(c: Calibration, tr: Translator) -> list[PageTable]:
    found = fourier_residuals(c)
    sizes = [w["amplitude"] for entry in found for w in entry["harmonics"]]
    factor, unit = readable_unit(max(sizes, default=0.0), c.model.unit)
    rows = [
        (
            entry["roll"],
            entry["output"],
            *(
                f"{plain_number(factor * w['amplitude'], 2)} ({chance(w['p'])})"
                for w in entry["harmonics"]
            ),
        )
        for entry in found
    ]
    if not rows:
        return []
    orders = [tr("order {n}", n=str(i)) for i in range(1, max(map(len, rows)) - 1)]
    return [
        PageTable(
            tr("Residuals along each roll: amplitude (p)") + f" [{unit}]",
            (tr("Roll about"), tr("Output"), *orders),
            tuple(rows),
            2,
            on_paper=False,  # it follows from the residuals, and a figure shows it
        )
    ]


def _float(value: object) -> float | None:
    return float(value) if isinstance(value, int | float) else None
