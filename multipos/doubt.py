"""A doubt: something in a finished calibration, or another result, that does not look right.

`implausible` means that no sensor on earth gives such readings at such positions, or that what is
given contradicts itself: the calibration is not fit for use. A `caution` is for who knows better.
What is looked for stands in `multipos.diagnostics`; here is what a finding is, and its form in
files.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from multipos.errors import MultiposError
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

    Examples
    --------
    >>> import multipos as mp
    >>> (doubt,) = mp.demo().calibration.diagnostics.doubts
    >>> doubt.code, doubt.severity
    ('hidden-terms', 'caution')
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


def read_doubt(content: Mapping[str, Any]) -> Doubt:
    """Return a doubt as a file holds it."""
    rows, outputs = tuple(content["rows"]), tuple(content["outputs"])
    return Doubt(content["code"], content["severity"], content["text"], rows, outputs)


def implausible(doubts: Iterable[Doubt]) -> tuple[Doubt, ...]:
    """Return the doubts that make a calibration unfit for use."""
    return tuple(doubt for doubt in doubts if doubt.implausible)


def refuse_implausible(doubts: Iterable[Doubt], what: str) -> None:
    """Refuse to pass on a calibration that is not fit for use.

    Raises
    ------
    MultiposError
        It has implausible doubts; the first is told.
    """
    found = implausible(doubts)
    if found:
        more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
        raise MultiposError(
            f"{what} is refused, as the calibration is not fit for use: {found[0].text}{more}; "
            "or accept it as it is with --accept-doubts, and the file says so."
        )


def accepted(doubts: Iterable[Doubt]) -> list[str]:
    """Return what a file says that passes on a calibration in spite of its doubts, as lines."""
    found = implausible(doubts)
    head = [f"ACCEPTED IN SPITE OF DOUBTS. {NOT_FIT}"] if found else []
    return head + [f"{doubt.code}: {doubt.text}" for doubt in found]


def besides(said: Iterable[str], doubts: Sequence[Doubt]) -> tuple[str, ...]:
    """Return what is said beside the texts of the doubts."""
    texts = {doubt.text for doubt in doubts}
    return tuple(text for text in said if text not in texts)
