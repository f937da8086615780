"""What a report of a calibration says: its sections, tables and figures, in English or Chinese.

The sections are what a calibration certificate contains by clause 7.8 of ISO/IEC 17025:2017, as
far as the data know it; what only the laboratory knows comes from its TOML file, and where that
is silent a field stays open, marked as such. `documents` writes the content as HTML, Markdown or
plain text.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import field
from functools import cached_property
from typing import Any

import numpy as np

from multipos.errors import MultiposError
from multipos.files.numbers import in_unit
from multipos.files.spelling import StrPath
from multipos.files.trees import read_toml
from multipos.finding import Findings, errors_of, in_order, serious
from multipos.reports import check_text, evidence, summary
from multipos.reports.findings import (
    EQUIPMENT,
    budget_section,
    equipment_section,
    parameters_section,
    result_section,
    sessions_section,
    signature_section,
    sphere_section,
)
from multipos.reports.sections import Language, Section, Translator, method_section, with_annex
from multipos.results import frozen
from multipos.sensor.calibration import Calibration
from multipos.uncertainty.monte_carlo import MonteCarlo
from multipos.uncertainty.propagation import evaluate_budget
from multipos.uncertainty.turntable import has_rolls
from multipos.verification.verdicts import Check

LAB_FIELDS = {
    "report": {
        "number": "Report number",
        "issued": "Date of issue",
        "authorised_by": "Authorised by",
    },
    "laboratory": {
        "name": "Laboratory",
        "address": "Address",
        "country": "Country (ISO 3166-1)",
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
        "decision_rule": "Decision rule",
        "remarks": "Remarks",
    },
}


_WORDS = (
    "Findings",
    "Administrative data",
    "page",
    "end of the report",
)


@frozen(eq=True)
class Content:
    """A whole report.

    Attributes
    ----------
    language, title, subtitle : str
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

    language: Language
    title: str
    subtitle: str
    sentence: str
    unfit: bool
    findings: tuple[str, ...]
    fields: tuple[tuple[str, str], ...]
    sections: tuple[Section, ...]
    lab: Mapping[str, str] = field(default_factory=dict)
    result: Section | None = None

    @cached_property
    def words(self) -> dict[str, str]:
        """The template's own words, translated."""
        tr = Translator(self.language)
        return {text: tr(text) for text in _WORDS}


def read_lab(source: "StrPath | Mapping[str, Any] | None") -> dict[str, str]:
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
    said: dict[str, str] = {}
    for section, table in tables.items():
        if section == "equipment":
            said |= _read_equipment(table, where)
            continue
        if section not in LAB_FIELDS or not isinstance(table, Mapping):
            raise MultiposError(
                f"{where}: unknown section [{section}]; a report has {', '.join(LAB_FIELDS)} "
                "and [[equipment]]."
            )
        for key, value in table.items():
            if key not in LAB_FIELDS[section]:
                raise MultiposError(
                    f"{where}, [{section}]: unknown key '{key}'; it takes "
                    f"{', '.join(LAB_FIELDS[section])}."
                )
            if str(value).strip():
                said[f"{section}.{key}"] = str(value)
    return said


def _read_equipment(entries: Any, where: str) -> dict[str, str]:
    """Return what is said of each piece of equipment, by ``equipment.1.name``."""
    said: dict[str, str] = {}
    for place, entry in enumerate(entries if isinstance(entries, list) else [entries], start=1):
        unknown = (
            [key for key in entry if key not in EQUIPMENT] if isinstance(entry, Mapping) else [""]
        )
        if unknown or not isinstance(entry, Mapping):
            raise MultiposError(
                f"{where}, [[equipment]]: unknown key '{unknown[0]}'; each entry takes "
                f"{', '.join(EQUIPMENT)}."
            )
        said |= {f"equipment.{place}.{key}": str(value) for key, value in entry.items()}
    return said


def lab_fields(said: Mapping[str, str], tr: Translator) -> tuple[tuple[str, str], ...]:
    """Return the fields of the laboratory that it has stated."""
    return tuple(
        (tr(label), said[f"{section}.{key}"])
        for section, keys in LAB_FIELDS.items()
        for key, label in keys.items()
        if f"{section}.{key}" in said
    )


def build_content(
    calibration: Calibration,
    *,
    lab: "StrPath | Mapping[str, Any] | None" = None,
    language: Language = "en",
    simulated: MonteCarlo | None = None,
    check: Check | None = None,
) -> Content:
    """Return what the report of a calibration says.

    Parameters
    ----------
    calibration : Calibration
    lab : path or mapping, optional
        What only the laboratory knows.
    language : str
        'en' or 'zh'.
    simulated : MonteCarlo, optional
        What `multipos.uncertainty.monte_carlo` found, for the checks.
    check : Check, optional
        Of this calibration on an independent run.

    Raises
    ------
    MultiposError
        The lab file is at fault, or the check is of another calibration.
    """
    tr = Translator(language, calibration.field)
    said = read_lab(lab)
    c = calibration
    budget = evaluate_budget(c)
    equipment = equipment_section(said, tr)
    findings = in_order((*c.findings, *(() if check is None else check.findings)))
    forces = math.isfinite(c.rms)  # else an output does not respond, as a finding says
    return Content(
        language=language,
        title=tr("Calibration report"),
        subtitle=tr(
            "Accelerometer with outputs {outputs}, model {model}",
            outputs=", ".join(c.outputs),
            model=c.model.text,
        ),
        sentence=_answer(c, check, tr),
        unfit=bool(errors_of(findings)) or (check is not None and check.verdict == "fail"),
        findings=tuple(tr.message(found.text) for found in serious(findings)),
        fields=lab_fields(said, tr),
        result=result_section(c, budget, tr, forces=forces),
        sections=with_annex(
            (
                parameters_section(c, tr),
                *(() if c.sessions is None else (sessions_section(c, c.sessions, tr),)),
                budget_section(c, budget, tr),
                *((sphere_section(c, tr),) if forces else ()),
                *(() if check is None else (evidence.check_section(c, check, tr),)),
                evidence.residuals_section(c, tr),
                *evidence.temperature_sections(c, tr),
                evidence.positions_section(c, tr),
                *((evidence.rolls_section(c, tr),) if has_rolls(c) else ()),
                evidence.correlation_section(c, tr),
                evidence.checks_section(c, tr, simulated),
                _method(c, tr),
                *((equipment,) if equipment is not None else ()),
                *_validity(findings, tr),
                _statements(c, check, tr),
                *((signature_section(said, tr),) if said else ()),
            ),
            tr,
        ),
        lab=said,
    )


def _answer(c: Calibration, check: Check | None, tr: Translator) -> str:
    """Return the answer: of an independent run first, which has a verdict against its limit."""
    said = summary.calibration_sentence(c, tr)
    return said if check is None else f"{tr.message(check_text.check_sentence(check))} {said}"


def _method(c: Calibration, tr: Translator) -> Section:
    size = tr(c.field.text)
    if c.gravity is not None:
        unit = c.gravity.size_unit
        size = f"{c.gravity.value:.10g} {unit}, u = {in_unit(c.gravity.u, unit)}"
    rows: list[tuple[str, str]] = [
        (tr("Readings"), c.readings.source or tr("from memory")),
        (tr("SHA-256 of the readings"), c.readings.sha256 or "-"),
        (tr("Number of readings"), str(len(c.readings))),
        (tr("Outputs and unit"), f"{', '.join(c.outputs)} [{c.model.unit}]"),
        (tr("Model"), c.model.text),
        *(() if c.field.magnetic else ((tr("Convention"), tr(c.convention)),)),
        (tr("Gravity"), size),
        (tr("Estimator"), tr(c.estimator)),
        (tr("Criterion"), tr.message(c.criterion)),
        (tr("Computed"), f"{c.created}, multipos {c.version}"),
    ]
    for name, column in c.readings.environment.items():
        if np.isfinite(column).all():
            rows.append((tr(name), f"{column.min():.6g} … {column.max():.6g}"))
    return method_section(rows, tr)


def _validity(findings: Findings, tr: Translator) -> tuple[Section, ...]:
    """Return the notes: what holds of the method, the positions and the data, and is in U."""
    notes = tuple(tr.message(found.text) for found in findings if found.level == "note")
    return (Section(tr("Validity"), notes),) if notes else ()


def _statements(c: Calibration, check: Check | None, tr: Translator) -> Section:
    said: Sequence[str] = (
        "The results relate only to the item calibrated, as it was and where it was.",
        "Uncertainties are evaluated by JCGM 100 (GUM).",
        "This report should not be reproduced except in full without approval of the laboratory.",
    )
    paragraphs = list(map(tr, said))
    if check is not None and check.limit is not None:
        paragraphs.append(
            tr(
                "Decision rule: a position conforms where error and U together stay within the "
                "limit, and does not where the error less U is beyond it (JCGM 106, guard band U); "
                "the run does not where that is so with the U of all its errors together."
            )
        )
    return Section(tr("Statements"), tuple(paragraphs))
