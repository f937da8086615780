"""What only the laboratory knows of a calibration, from its TOML file.

`read_lab` reads and checks it, `lab_fields` gives the administrative data that it states,
`equipment_section` what was used, and `signature_section` where the report is signed. Where the
laboratory is silent a report has no field.
"""

from collections.abc import Mapping
from typing import Any

from multipos.errors import MultiposError
from multipos.files.spelling import StrPath, packaged_pairs
from multipos.files.trees import read_toml
from multipos.reports.sections import PageTable, Section

_LABELS = packaged_pairs(__file__, "laboratory.csv")


def _labels(section: str) -> dict[str, str]:
    whole = {key.partition(".")[::2]: label for key, label in _LABELS.items()}
    return {key: label for (of, key), label in whole.items() if of == section}


LAB_FIELDS = {s: _labels(s) for s in ("report", "laboratory", "customer", "item", "measurement")}
EQUIPMENT = _labels("equipment")
_LINE = "________________"  # to be written on by hand


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


def lab_fields(said: Mapping[str, str]) -> tuple[tuple[str, str], ...]:
    """Return the fields of the laboratory that it has stated."""
    return tuple(
        (label, said[f"{section}.{key}"])
        for section, keys in LAB_FIELDS.items()
        for key, label in keys.items()
        if f"{section}.{key}" in said
    )


def equipment_section(said: Mapping[str, str]) -> Section | None:
    """Return the equipment that the laboratory names; nothing where it names none."""
    rows: list[tuple[str, ...]] = []
    while any(f"equipment.{len(rows) + 1}.{key}" in said for key in EQUIPMENT):
        rows.append(tuple(said.get(f"equipment.{len(rows) + 1}.{key}", "-") for key in EQUIPMENT))
    if not rows:
        return None
    header = tuple(EQUIPMENT.values())
    table = PageTable("Equipment used", header, tuple(rows), left=len(header))
    return Section("Equipment", tables=(table,))


def signature_section(said: Mapping[str, str]) -> Section:
    """Return where the report is signed."""
    rows = (
        ("Authorised by", said.get("report.authorised_by", _LINE)),
        ("Date", said.get("report.issued", _LINE)),
        ("Signature", _LINE),
    )
    table = PageTable("Signed by", ("Item", "Value"), rows, left=2)
    return Section("Signature", tables=(table,))
