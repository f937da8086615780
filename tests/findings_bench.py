"""What results say of themselves, as texts."""

from typing import Any


def texts(found: Any) -> tuple[str, ...]:
    """Return the texts of the findings of a result, the most serious first."""
    return tuple(str(finding) for finding in found.findings)
