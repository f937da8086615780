"""What a report of a calibration says: its sections in their order, with the sentence above them.

`build_content` collects them. They are what a calibration certificate contains by clause 7.8 of
ISO/IEC 17025:2017, as far as the data know it; what only the laboratory knows comes from its file
(`multipos.reports.laboratory`). `documents` writes the content as HTML, Markdown or plain text.
"""

import math
from collections.abc import Mapping
from dataclasses import field
from typing import Any

from multipos.files.spelling import StrPath
from multipos.finding import errors_of, in_order, serious
from multipos.reports import check_text, evidence, summary
from multipos.reports.fit_tests import checks_section
from multipos.reports.laboratory import equipment_section, lab_fields, read_lab, signature_section
from multipos.reports.outcome import (
    budget_section,
    parameters_section,
    result_section,
    sphere_section,
)
from multipos.reports.sections import Section, method_section, with_annex, worded_section
from multipos.results import frozen
from multipos.sensor.calibration import Calibration
from multipos.uncertainty.monte_carlo import MonteCarlo
from multipos.uncertainty.propagation import evaluate_budget
from multipos.uncertainty.turntable import has_rolls
from multipos.verification.verdicts import Check


@frozen(eq=True)
class Content:
    """A whole report.

    Attributes
    ----------
    title, subtitle : str
    sentence : str
        The answer: what came out, and whether to trust it.
    unfit : bool
        Whether nobody should use the result.
    findings : tuple of str
        Errors and warnings.
    fields : tuple of (label, text)
        What only the laboratory knows, as far as it has said.
    sections : tuple of Section
    lab : mapping of str to str
        What the laboratory has said, by ``section.key``; equipment as ``equipment.1.name``.
    result : Section or None
        The first screen below sentence and findings, before what the laboratory says.
    """

    title: str
    subtitle: str
    sentence: str
    unfit: bool
    findings: tuple[str, ...]
    fields: tuple[tuple[str, str], ...]
    sections: tuple[Section, ...]
    lab: Mapping[str, str] = field(default_factory=dict)
    result: Section | None = None


def build_content(
    calibration: Calibration,
    *,
    lab: "StrPath | Mapping[str, Any] | None" = None,
    simulated: MonteCarlo | None = None,
    check: Check | None = None,
) -> Content:
    """Return what the report of a calibration says.

    Parameters
    ----------
    calibration : Calibration
    lab : path or mapping, optional
        What only the laboratory knows.
    simulated : MonteCarlo, optional
        What `multipos.uncertainty.monte_carlo` found, for the checks.
    check : Check, optional
        Of this calibration on an independent run.

    Raises
    ------
    MultiposError
        The lab file is at fault, or the check is of another calibration.
    """
    said = read_lab(lab)
    c = calibration
    budget = evaluate_budget(c)
    equipment = equipment_section(said)
    findings = in_order((*c.findings, *(() if check is None else check.findings)))
    notes = tuple(found.text for found in findings if found.level == "note")  # which are in U
    forces = math.isfinite(c.rms)  # else an output does not respond, as a finding says
    return Content(
        title="Calibration report",
        subtitle=f"{c.field.sensor} with outputs {', '.join(c.outputs)}, model {c.model.text}",
        sentence=_answer(c, check),
        unfit=bool(errors_of(findings)) or (check is not None and check.verdict == "fail"),
        findings=tuple(c.field.worded(found.text) for found in serious(findings)),
        fields=lab_fields(said),
        result=worded_section(result_section(c, budget, forces=forces), c.field),
        sections=with_annex(
            (
                worded_section(each, c.field)
                for each in (
                    parameters_section(c),
                    budget_section(c, budget),
                    *((sphere_section(c),) if forces else ()),
                    *(() if check is None else (evidence.check_section(c, check),)),
                    evidence.residuals_section(c),
                    *evidence.temperature_sections(c),
                    evidence.positions_section(c),
                    *((evidence.rolls_section(c),) if has_rolls(c) else ()),
                    evidence.correlation_section(c),
                    checks_section(c, simulated),
                    method_section(summary.method_rows(c)),
                    *((equipment,) if equipment is not None else ()),
                    *((Section("Validity", notes),) if notes else ()),
                    _statements(c, check),
                    *((signature_section(said),) if said else ()),
                )
            ),
            (evidence.covariance_table(c),),
        ),
        lab=said,
    )


def _answer(c: Calibration, check: Check | None) -> str:
    """Return the answer: of an independent run first, which has a verdict against its limit."""
    said = summary.calibration_sentence(c)
    return said if check is None else f"{c.field.worded(check_text.check_sentence(check))} {said}"


def _statements(c: Calibration, check: Check | None) -> Section:
    paragraphs = [
        "The results relate only to the item calibrated, as it was and where it was.",
        "Uncertainties are evaluated by JCGM 100 (GUM).",
        "This report should not be reproduced except in full without approval of the laboratory.",
    ]
    if check is not None and check.limit is not None:
        paragraphs.append(
            "Decision rule: a position conforms where error and U together stay within the "
            "limit, and does not where the error less U is beyond it (JCGM 106, guard band U); "
            "the run does not where that is so with the U of all its errors together."
        )
    return Section("Statements", tuple(paragraphs))
