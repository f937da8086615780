"""What a tumble prints: coefficients, harmonics, hysteresis and the table.

`tumble_text` prints those of one output, or of several in common tables, and `tumble_sentence` says
scale factor and bias of each.
"""

import math
from collections.abc import Mapping

from multipos.files.numbers import (
    chance,
    number,
    p_in_words,
    plain_number,
    table,
    titled,
    uncertain,
)
from multipos.finding import errors_of
from multipos.positions.harmonics import Harmonic
from multipos.reports.turntable_text import turntable_tables
from multipos.uncertainty.turntable import TableErrors
from multipos.verification.coefficients import COEFFICIENTS, TumbleCoefficient
from multipos.verification.tumbling import Tumble, Tumbles

_Sections = list[tuple[str, str]]
_MILLION = 1e6


def tumble_text(found: Tumble | Tumbles) -> str:
    """Return tumbles as plain text, several outputs in common tables."""
    if isinstance(found, Tumble):
        outputs, beside = {"": found}, {"": found.beside_table}
        sections = [("Tumble", table(*_coefficient_rows(found.coefficients)))]
    else:
        outputs, beside = dict(found.outputs), dict(found.beside_table)
        sections = [("Tumble", _coefficients_of_all(found)), ("Misalignment", _misaligned(found))]
    for name, one in outputs.items():
        of = f": {name}" if name else ""
        both = [*_hidden_section(one), *_harmonics_section(one)]
        sections += [(f"{title}{of}", body) for title, body in both]
    sections += _hysteresis_section(outputs)
    sections += [(each.caption, str(each)) for each in turntable_tables(found.table_errors)]
    sections += _beside_section(beside, found.table_errors)
    return "\n".join(titled(*section) for section in sections)


def _misaligned(found: Tumbles) -> str:
    """Return how the input axes lie to each other."""
    rows = []
    for name, values, us in zip(
        found.outputs, found.misalignment, found.misalignment_u, strict=True
    ):
        cells = [
            "own axis" if u == 0.0 else "-" if value != value else _valued(value, u)
            for value, u in zip((_MILLION * values).tolist(), (_MILLION * us).tolist(), strict=True)
        ]
        rows.append([name, *cells])
    return table(["output", *(f"{axis} [µrad]" for axis in "xyz")], rows)


def _coefficients_of_all(found: Tumbles) -> str:
    """Return one table of all outputs, in the units of a data sheet."""
    header = ["coefficient", "unit"]
    for name in found.outputs:
        header += [name, "U"]
    rows = []
    for name in COEFFICIENTS:
        present = [one.coefficients.get(name) for one in found.outputs.values()]
        if not any(present):
            continue
        unit = next(entry for entry in present if entry).customary["unit"]
        cells = []
        for entry in present:
            cells += _customary_cells(entry)
        rows.append([name, unit, *cells])
    k1 = [one["K1"] for one in found.outputs.values()]
    scale = [
        name for entry in k1 for name in (_valued(entry.value, entry.u), plain_number(entry.U, 2))
    ]
    rows.insert(1, ["K1", k1[0].unit, *scale])
    return table(header, rows)


def _customary_cells(entry: TumbleCoefficient | None) -> list[str]:
    if entry is None:
        return ["-", "-"]
    custom = entry.customary
    value = _valued(custom["value"], custom["u"]) if "value" in custom else "-"
    return [value, plain_number(custom["U"], 2)]


def _valued(value: float, u: float) -> str:
    """Return value(u), of a coefficient that leans on the table the value alone."""
    return number(value, 4) if math.isnan(u) else uncertain(value, u)


def _coefficient_rows(
    coefficients: Mapping[str, TumbleCoefficient],
) -> tuple[list[str], list[list[str]]]:
    rows = []
    for name, c in coefficients.items():
        shown = [*_customary_cells(c), c.customary["unit"]]
        rows.append([name, _valued(c.value, c.u), c.unit, *shown, number(c.k), number(c.dof)])
    header = ["coefficient", "value(u)", "unit", "value(u)", "U", "unit", "k", "dof"]
    return header, rows


def _hidden_section(found: Tumble) -> _Sections:
    hidden = [*found.unidentifiable]
    hidden += [each.text for each in found.findings if each.code == "hidden-table"]
    if found.taken_as_zero:
        hidden.append(f"taken as zero: {', '.join(found.taken_as_zero)}")
    if hidden:
        text = "\n".join(f"- {line}" for line in hidden)
        return [("Not identifiable from these points", text)]
    return []


def _harmonics_section(found: Tumble) -> _Sections:
    unit = found.calibration.model.unit
    residual = {(h.plane, h.order): h for h in found.residual_harmonics}
    rows = []
    for h in found.harmonics:
        left = residual[h.plane, h.order]
        # What the model explains whatever it is leaves the rounding of the arithmetic alone.
        amplitude = "-" if left.p is None else f"{left.amplitude:.2g}"
        rows.append([h.plane, str(h.order), *_harmonic_cells(h), amplitude, chance(left.p)])
    if rows:
        header = ["plane", "order", f"cos [{unit}]", "sin", "amplitude", "left by the model", "p"]
        return [("Harmonics", table(header, rows))]
    return []


def _hysteresis_section(outputs: Mapping[str, Tumble]) -> _Sections:
    """Return what passes forward and backward differ by."""
    rows = [
        [
            name,
            plane,
            uncertain(_MILLION * h.value, _MILLION * h.u),
            plain_number(_MILLION * h.U, 2),
            str(h.angles),
        ]
        for name, found in outputs.items()
        for plane, h in found.hysteresis.items()
    ]
    header = ["output", "plane", "forward - backward [µg]", "U", "angles"]
    return [("Hysteresis", _by_output(header, rows))] if rows else []


def _by_output(header: list[str], rows: list[list[str]]) -> str:
    """Return a table with the name of the output first, where there are several."""
    several = any(row[0] for row in rows)
    return table(header, rows) if several else table(header[1:], [row[1:] for row in rows])


def _beside_section(
    outputs: Mapping[str, Mapping[str, TumbleCoefficient]], found: TableErrors
) -> _Sections:
    """Return what the sensor is beside a table whose errors are beyond chance."""
    if found.beside is None or not found.beside.off:
        return []
    rows = [
        [name, which, *_customary_cells(entry), entry.customary["unit"]]
        for name, entries in outputs.items()
        for which, entry in entries.items()
    ]
    text = f"errors of the table are beyond chance ({p_in_words(found.beside.p)}); in addition\n"
    if not rows:
        text += "no coefficient is identifiable: state the bench (state_bench)"
        return [("Beside the table", text)]
    text += _by_output(["output", "coefficient", "value(u)", "U", "unit"], rows)
    leaning = "what is not listed is correlated with table errors and has no U: state the bench"
    return [("Beside the table", f"{text}\n{leaning}")]


def _harmonic_cells(h: Harmonic) -> list[str]:
    """Return cosine, sine and amplitude, to the digits that the noise leaves of them."""
    if h.u_cos is None or h.u_sin is None:
        return [number(value, 6) for value in (h.cos, h.sin, h.amplitude)]
    larger = max(h.u_cos, h.u_sin)  # the u of an amplitude lies between the two
    return [uncertain(h.cos, h.u_cos), uncertain(h.sin, h.u_sin), uncertain(h.amplitude, larger)]


def tumble_sentence(found: Tumble | Tumbles) -> str:
    """Return scale factor and bias of every output."""
    outputs = {found.calibration.outputs[0]: found} if isinstance(found, Tumble) else found.outputs
    said = []
    for name, one in outputs.items():
        held = [k for k in ("K1", "K0") if k in one.coefficients]
        values = (f"{k} = {uncertain(one[k].value, one[k].u)} {one[k].unit}" for k in held)
        said.append(f"{name}: {', '.join(values)}")
    errors = errors_of(found.findings)
    return f"{'Not fit for use: ' if errors else ''}{'; '.join(said)}."
