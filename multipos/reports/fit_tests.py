"""The section of a report on tests of the fit: repeats, terms, influence, harmonics, Monte Carlo.

`checks_section` gives it, `checks_table` what is one number each; every other finding about a
finished calibration is a table of its own.
"""

from collections.abc import Sequence

import numpy as np

from multipos.diagnostics.criticism import find_influence, fourier_residuals, judge_terms
from multipos.diagnostics.score_tests import judge_included
from multipos.files import numbers
from multipos.reports.quantities import column
from multipos.reports.sections import PageTable, Section, chosen_rows
from multipos.sensor.calibration import Calibration
from multipos.uncertainty.monte_carlo import MonteCarlo


def checks_table(c: Calibration) -> PageTable:
    """Return how well the fit is conditioned, and the tests that are one number."""
    rows: list[tuple[str, str]] = [
        ("rms of what is left after compensation", c.field.shown(c.rms)),
        ("rank and parameters", f"{c.diagnostics.rank} / {c.diagnostics.parameters}"),
        ("condition of the design", numbers.number(c.diagnostics.condition, 3)),
    ]
    if c.orientation_spread is not None:
        rows.append(("orientation errors (1 sigma)", c.orientation_spread.in_words))
    if c.cross_check is not None:
        rows.append(("closed form against least squares", f"{c.cross_check:.1e}"))
    for output, test in c.diagnostics.lack_of_fit.items():
        rows.append(
            (
                f"lack of fit of {output} against repeats",
                f"F = {numbers.number(_float(test['F']))}, {numbers.p_in_words(_float(test['p']))}",
            )
        )
    return PageTable("Checks of the fit", ("Check", "Result"), tuple(rows), left=2)


def checks_section(c: Calibration, simulated: MonteCarlo | None) -> Section:
    """Return the checks of the fit."""
    tables = [checks_table(c)]
    paragraphs: list[str] = []
    tests = [_tests_of_terms(c), *(_OUTPUT_TESTS[name](c) for name in c.estimator.output_tests)]
    tests = [table for table in tests if table.rows]
    if tests:
        tables += tests
        paragraphs.append(
            "A small p means that chance alone would rarely do the same: that a term is needed, "
            "or that residuals follow the angle of the roll. With many tests in a table a few "
            "small p are expected."
        )
    if simulated is not None:
        tables.append(_simulated(c, simulated))
        paragraphs.append(
            "Monte Carlo draws every input quantity from its law, lets it act in full and "
            "estimates again (JCGM 101). U is valid where the ends of both intervals agree "
            "within the tolerance."
        )
    return Section("Checks", tuple(paragraphs), tables=tuple(tables))


def _tests_of_terms(c: Calibration) -> PageTable:
    """Return the tests of terms that the model has, and of those that it could have."""
    tests = [(test, "in the model") for test in judge_included(c)]
    tests += [(test, "not in the model") for test in c.diagnostics.model_tests]
    rows = [(test.term, status, str(test), numbers.chance(test.p)) for test, status in tests]
    header = ("Terms", "Status", "Statistic", "p")
    return PageTable("Tests of terms over all outputs", header, tuple(rows), 2)


def _simulated(c: Calibration, found: MonteCarlo) -> PageTable:
    units = numbers.common_units(
        zip(c.model.units, np.abs(found.symmetric).max(axis=1).tolist(), strict=True)
    )
    arrays = (found.u, found.symmetric, found.shortest, found.tolerance, found.valid)
    columns = [array.tolist() for array in arrays]
    rows = [
        (
            name,
            *_simulated_cells(u, (symmetric, shortest), tolerance, units[unit]),
            "yes" if valid else "no",
        )
        for name, unit, u, symmetric, shortest, tolerance, valid in zip(
            found.names, c.model.units, *columns, strict=True
        )
    ]
    header = (
        *("Parameter", "u", "Symmetric interval", "Shortest interval", "Tolerance", "Unit"),
        "U valid",
    )
    return PageTable(f"Monte Carlo, {found.trials} trials", header, tuple(rows))


def _simulated_cells(
    u: float, intervals: Sequence[Sequence[float]], tolerance: float, unit: tuple[float, str]
) -> tuple[str, ...]:
    """Return u, both intervals and the tolerance in one unit, and it."""
    factor, shown = unit
    decimals = numbers.decimals_of(factor * u)
    form = ".7g" if decimals is None else f".{decimals}f"
    cells = [f"[{factor * low:{form}}, {factor * high:{form}}]" for low, high in intervals]
    return (
        numbers.plain_number(factor * u),
        *cells,
        numbers.plain_number(factor * tolerance, 2),
        shown,
    )


def _single_terms(c: Calibration) -> PageTable:
    rows = [
        (
            t.output,
            t.term,
            "in the model" if t.inside else "not in the model",
            numbers.number(t.f),
            numbers.number(t.dof[1]),
            numbers.chance(t.p),
            numbers.number(t.aicc),
        )
        for t in judge_terms(c)
    ]
    header = ("Output", "Term", "Status", "F", "dof", "p", "AICc if changed")
    # On paper the tests over all outputs speak for them.
    return PageTable("Tests of single terms", header, tuple(rows), 3, on_paper=False)


def _influence(c: Calibration) -> PageTable:
    found = find_influence(c)
    names = c.readings.labels
    shown, kept, suffix = chosen_rows(np.abs(found.studentised).max(axis=1))
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
        "Influence of each position: studentised residual r, Cook's D, leave-one-out error e"
        + suffix,
        ("Position", *columns),
        tuple(rows),
        on_paper=False,  # residuals, s and leverage stand there, and it follows from them
        kept=kept,
    )


def _two_decimals(size: float) -> str:
    return f"{size:.2f}" if np.isfinite(size) else numbers.number(size)


def _waves(c: Calibration) -> PageTable:
    found = fourier_residuals(c)
    sizes = [w["amplitude"] for entry in found for w in entry["harmonics"]]
    factor, unit = numbers.readable_unit(max(sizes, default=0.0), c.model.unit)
    rows = [
        (
            entry["roll"],
            entry["output"],
            *(
                f"{numbers.plain_number(factor * w['amplitude'], 2)} ({numbers.chance(w['p'])})"
                for w in entry["harmonics"]
            ),
        )
        for entry in found
    ]
    orders = [f"order {i}" for i in range(1, max(map(len, rows), default=0) - 1)]
    return PageTable(
        "Residuals along each roll: amplitude (p)" + f" [{unit}]",
        ("Roll about", "Output", *orders),
        tuple(rows),
        2,
        on_paper=False,  # it follows from the residuals, and a figure shows it
    )


_OUTPUT_TESTS = {"terms": _single_terms, "influence": _influence, "harmonics": _waves}


def _float(value: object) -> float | None:
    return float(value) if isinstance(value, int | float) else None
