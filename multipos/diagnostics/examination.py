"""Every finding about a finished calibration, in the order in which they are asked.

A finding is a function from a calibration to at most one finding, a `Finding`, and a line in one of
the lists below. Cautions about what the residuals say are asked only where nothing wrong
was found: rows interchanged look like a missing term, an outlier and a rejected noise as well, and
are none of these.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

from multipos.diagnostics.absurdities import explained
from multipos.diagnostics.columns import (
    counter_column,
    dead_output,
    quantized,
    repeated_rows,
    saturated,
    temperature_kelvin,
)
from multipos.diagnostics.competition import RIVALS, compete
from multipos.diagnostics.magnetic import disturbance, field_size, moving_iron, sphere_gap
from multipos.diagnostics.model_error import hidden_terms, missing_term, zero_per_soak
from multipos.diagnostics.redundancy import drift_absorbed, no_redundancy, poorly_determined
from multipos.diagnostics.residuals import (
    effective_number,
    lack_of_fit,
    orientation_error,
    outlier,
    rejected_noise,
    unequal_noise,
)
from multipos.diagnostics.scales import gravity
from multipos.diagnostics.score_tests import judge_model
from multipos.finding import Finding, Findings, errors_of, in_order
from multipos.sensor.calibration import Calibration
from multipos.sensor.gravity import MAGNETIC, worded

Question = Callable[[Calibration], Finding | None]

# Implausible whatever the fit says; where a column is no output at all, no more is asked of it.
OF_COLUMNS: tuple[Question, ...] = (dead_output, counter_column, saturated)
OF_OPTIONS: tuple[Question, ...] = (gravity,)
# Of a magnetic field alone.
OF_FIELD: tuple[Question, ...] = (field_size, sphere_gap, disturbance, moving_iron)
# Cautions about what was given and what the positions can show.
CAUTIONS: tuple[Question, ...] = (quantized, no_redundancy, repeated_rows, temperature_kelvin)
# Cautions about what the residuals show, and cannot show.
OF_RESIDUALS: tuple[Question, ...] = (
    poorly_determined,
    hidden_terms,
    drift_absorbed,
    zero_per_soak,
    missing_term,
    outlier,
    lack_of_fit,
    rejected_noise,
    orientation_error,
    unequal_noise,
    effective_number,
)
# What a finding explains is not said beside it: rows alike because of a soak are no drift.
_BY_ROWS = ("denied-noise", "placement", "unequal-noise")
_EXPLAINED = {
    "zero-per-soak": ("time-correlated",),
    "no-redundancy": ("no-dof",),
    "no-residuals": ("no-dof",),
    "no-signal": ("convention",),
    "outlier": _BY_ROWS,
    "disturbance": ("missing-term", "scale-bias"),
    "moving-iron": ("replaced", "drift", "time-correlated"),
    "flipped-row": _BY_ROWS,
    "missing-term": ("denied-noise",),
}
_SLOW_NOISE = 3.0  # times the noise within rests, that noise from rest to rest may well be


def examine(calibration: Calibration) -> Calibration:
    """Return a calibration with what does not look right about it.

    Beside the findings stand the tests of the terms that the model lacks. Of a magnetometer they
    are asked of the relative field, and said in its words.
    """
    if not calibration.field.magnetic:
        return _examined(calibration)
    found = _examined(calibration.relative).diagnostics
    own = tuple(ask(calibration) for ask in OF_FIELD)
    said = (replace(f, text=in_words(f.text), action=in_words(f.action)) for f in found.findings)
    findings = without_explained((*(each for each in own if each is not None), *said))
    return replace(calibration, diagnostics=replace(found, findings=findings))


def in_words(text: str) -> str:
    """Return a sentence in the words of a magnetometer."""
    return worded(text, MAGNETIC)


def _examined(calibration: Calibration) -> Calibration:
    tested = judge_model(calibration)
    of_model = replace(calibration.diagnostics, model_tests=tested.tests, hidden=tested.hidden)
    calibration = replace(calibration, diagnostics=of_model)
    found = _answers(OF_COLUMNS, calibration)
    if not found:
        found += explained(calibration)
    found += _answers(OF_OPTIONS, calibration) + _answers(CAUTIONS, calibration)
    if not errors_of(found):
        of_rows = _answers(OF_RESIDUALS, calibration)
        if any(each.code == "quantized" for each in found):  # roundings follow no law
            found += [each for each in of_rows if each.code not in RIVALS]
        else:
            found += compete(calibration, of_rows)
    before = calibration.diagnostics
    every = (*found, *before.findings)
    if calibration.readings.dof is not None:  # nobody stated this noise
        every = tuple(
            replace(each, level="note") if _is_allowed_for(calibration, each.code) else each
            for each in every
        )
    return replace(calibration, diagnostics=replace(before, findings=without_explained(every)))


def without_explained(every: Sequence[Finding]) -> Findings:
    """Return findings in order, less those that another of them explains."""
    explained_too = {code for each in every for code in _EXPLAINED.get(each.code, ())}
    return in_order(each for each in every if each.code not in explained_too)


def _is_allowed_for(c: Calibration, code: str) -> bool:
    """Tell whether a finding about noise that the rests gave leaves nothing to decide.

    Too large is the safe side, and what slow noise adds from rest to rest is in U.
    """
    claim = c.diagnostics.claim
    of_rests = claim is not None and claim.chi2 < _SLOW_NOISE**2 * claim.dof
    return code == "overstated-noise" or (code == "denied-noise" and of_rests)


def _answers(questions: Sequence[Question], calibration: Calibration) -> list[Finding]:
    answers = (ask(calibration) for ask in questions)
    return [finding for finding in answers if finding is not None]
