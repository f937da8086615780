"""Every doubt about a finished calibration, in the order in which they are asked.

A doubt is a function from a calibration to at most one finding, a `Doubt`, and a line in one of
the lists below. Cautions about what the residuals say are asked only where nothing implausible
was found: rows interchanged look like a missing term, an outlier and a denied noise as well, and
are none of these.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

from multipos.diagnostics.absurdities import explained
from multipos.diagnostics.columns import (
    counter_column,
    dead_output,
    repeated_rows,
    saturated,
    temperature_kelvin,
)
from multipos.diagnostics.model_error import hidden_terms, missing_term, zero_per_soak
from multipos.diagnostics.redundancy import hardly_told, no_redundancy
from multipos.diagnostics.residuals import (
    denied_noise,
    lack_of_fit,
    outlier,
    placement,
    time_correlated,
    unequal_noise,
)
from multipos.diagnostics.scales import gravity
from multipos.diagnostics.score_tests import judge_model
from multipos.doubt import Doubt, besides, implausible
from multipos.sensor.calibration import Calibration

Question = Callable[[Calibration], Doubt | None]

# Implausible whatever the fit says; where a column is no output at all, no more is asked of it.
OF_COLUMNS: tuple[Question, ...] = (dead_output, counter_column, saturated)
OF_OPTIONS: tuple[Question, ...] = (gravity,)
# Cautions about what was given and what the positions can show.
CAUTIONS: tuple[Question, ...] = (no_redundancy, repeated_rows, temperature_kelvin)
# Cautions about what the residuals show, and cannot show.
OF_RESIDUALS: tuple[Question, ...] = (
    hardly_told,
    hidden_terms,
    zero_per_soak,
    missing_term,
    outlier,
    lack_of_fit,
    denied_noise,
    placement,
    unequal_noise,
    time_correlated,
)
# What is alike from row to row because of these is no drift.
_EXPLAINING = frozenset({"zero-per-soak", "missing-term"})


def examine(calibration: Calibration) -> Calibration:
    """Return a calibration with what does not look right about it.

    The doubts stand in `diagnostics.doubts`, the worst first, and their texts are the first of
    `diagnostics.warnings`; beside them stand the tests of the terms that the model lacks.
    """
    tested = judge_model(calibration)
    of_model = replace(calibration.diagnostics, model_tests=tested.tests, hidden=tested.hidden)
    calibration = replace(calibration, diagnostics=of_model)
    found = _answers(OF_COLUMNS, calibration)
    if not found:
        found += explained(calibration)
    found += _answers(OF_OPTIONS, calibration) + _answers(CAUTIONS, calibration)
    if not implausible(found):
        found += _answers(OF_RESIDUALS, calibration)
        if not _EXPLAINING.isdisjoint(doubt.code for doubt in found):
            found = [doubt for doubt in found if doubt.code != "time-correlated"]
    if not found:
        return calibration
    doubts = tuple(sorted(found, key=lambda doubt: not doubt.implausible))
    before = calibration.diagnostics
    warnings = (*(doubt.text for doubt in doubts), *besides(before.warnings, doubts))
    return replace(calibration, diagnostics=replace(before, doubts=doubts, warnings=warnings))


def _answers(questions: Sequence[Question], calibration: Calibration) -> list[Doubt]:
    answers = (ask(calibration) for ask in questions)
    return [doubt for doubt in answers if doubt is not None]
