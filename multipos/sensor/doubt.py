"""A doubt: something in a finished calibration that does not look right.

`implausible` means that no sensor on earth gives such readings at such positions, or that what is
given contradicts itself: the calibration is not fit for use. A `caution` is for who knows better.
What is looked for stands in `multipos.doubts`; here is what a finding is, and its form in files.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

from multipos.files.records import ANY_TEXT, TEXTS, Fields, Listed, Text
from multipos.results import Keyed

NOT_FIT = "This calibration is not fit for use."
Severity = Literal["implausible", "caution"]
DOUBTS = Listed(
    Fields(
        {
            "code": ANY_TEXT,
            "severity": Text(("implausible", "caution")),
            "text": ANY_TEXT,
            "rows": TEXTS,
            "outputs": TEXTS,
        }
    )
)


@dataclass(frozen=True, eq=False)
class Doubt(Keyed):
    """One finding.

    Attributes
    ----------
    code : str
        As in `docs/doubts.md`.
    severity : str
        'implausible' or 'caution'.
    text : str
        What was found, where, and the way out.
    rows, outputs : tuples of str
        The positions and outputs that it is about; empty where it is about all.
    """

    code: str
    severity: Severity
    text: str
    rows: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()

    @property
    def implausible(self) -> bool:
        """Whether the calibration is not fit for use."""
        return self.severity == "implausible"


def implausible(doubts: Iterable[Doubt]) -> tuple[Doubt, ...]:
    """Return the doubts that make a calibration unfit for use."""
    return tuple(doubt for doubt in doubts if doubt.implausible)


def besides(said: Iterable[str], doubts: Sequence[Doubt]) -> tuple[str, ...]:
    """Return what is said beside the texts of the doubts."""
    texts = {doubt.text for doubt in doubts}
    return tuple(text for text in said if text not in texts)
