"""What results say of themselves, as texts."""

from typing import Any

EXACT: dict[str, Any] = {"orientation_sd": 0, "exclude": "none"}  # least squares of all rows


def texts(found: Any) -> tuple[str, ...]:
    """Return the texts of the findings of a result, the most serious first."""
    return tuple(str(finding) for finding in found.findings)


def warned(found: Any) -> list[str]:
    """Return the codes of the findings of a result that are no notes."""
    return [finding.code for finding in found.findings if finding.level != "note"]
