"""Every doubt about a finished calibration, in the order in which they are asked.

A doubt is a function from a calibration to at most one finding, a `Doubt`, and a line in one of
the lists below. Cautions about what the residuals say are asked only where nothing implausible
was found: rows interchanged look like a missing term, an outlier and a denied noise as well, and
are none of these.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

from multipos.doubts.claims import denied_noise, placement, unequal_noise
from multipos.doubts.columns import dead_output, temperature_kelvin
from multipos.doubts.model_error import hidden_terms, missing_term
from multipos.doubts.over_temperature import zero_per_soak
from multipos.doubts.score_tests import judge_model
from multipos.sensor.calibration import Calibration
from multipos.sensor.doubt import Doubt, implausible

Question = Callable[[Calibration], Doubt | None]

# Implausible whatever the fit says, then what explains a fit that is no good: the first answer
# of either counts, the rest would speak of its traces.
IMPLAUSIBLE: tuple[Question, ...] = (dead_output,)
# Cautions about what was given and what the positions can show.
CAUTIONS: tuple[Question, ...] = (temperature_kelvin,)
# Cautions about what the residuals show, and cannot show.
OF_RESIDUALS: tuple[Question, ...] = (
    hidden_terms,
    zero_per_soak,
    missing_term,
    denied_noise,
    placement,
    unequal_noise,
)


def examine(calibration: Calibration) -> Calibration:
    """Return a calibration with what does not look right about it.

    The doubts stand in `diagnostics.doubts`, the worst first, and their texts are the first of
    `diagnostics.warnings`; beside them stand the tests of the terms that the model lacks.
    """
    tested = judge_model(calibration)
    of_model = replace(calibration.diagnostics, model_tests=tested.tests, hidden=tested.hidden)
    calibration = replace(calibration, diagnostics=of_model)
    found = _answers(IMPLAUSIBLE, calibration)
    found += _answers(CAUTIONS, calibration)
    if not implausible(found):
        found += _answers(OF_RESIDUALS, calibration)
    if not found:
        return calibration
    before = calibration.diagnostics
    warnings = (*(doubt.text for doubt in found), *before.warnings)
    return replace(calibration, diagnostics=replace(before, doubts=tuple(found), warnings=warnings))


def _answers(questions: Sequence[Question], calibration: Calibration) -> list[Doubt]:
    answers = (ask(calibration) for ask in questions)
    return [doubt for doubt in answers if doubt is not None]
