"""A finding: what a result has to say about itself, and what to do about it.

`in_order` puts findings in their order, `about` says what they are about, `errors_of` and `serious`
pick those that matter, `short_text` shortens one. `warn` raises them as Python warnings,
`refuse_unfit` refuses a calibration with errors and `forced` says that one was passed on in spite
of them. `read_findings` reads those of a file, `findings_upgraded` those of version 0.1, and
`repeated_files` finds files given twice.

`error` means that nobody should use the result: no sensor gives such readings at such positions,
or what is given contradicts itself. A `warning` is about these data: U may not hold, or something
is to be decided. A `note` leaves nothing to decide: it is so of the method, the positions or the
scheme, or it is in the data and already in U.
"""

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import replace
from typing import Annotated, Any, Literal, TypeAlias

from multipos.errors import MultiposError, warn_of
from multipos.files.records import P_VALUE, Kind, Listed
from multipos.files.schema import schema_of
from multipos.files.spelling import visible
from multipos.results import Keyed, frozen

NOT_FIT = "This calibration is not fit for use."
Level = Literal["error", "warning", "note"]
LEVELS: tuple[Level, ...] = ("error", "warning", "note")
_SHOWN = 5  # copies that a message lists
LONGEST = 160  # characters of a text


@frozen
class Finding(Keyed):
    """One finding.

    Attributes
    ----------
    code : str
        As in `docs/reference/messages.md`.
    level : str
        'error', 'warning' or 'note'.
    text : str
        The fact with its number, then the consequence.
    action : str
        What to do, in one imperative sentence; empty where nothing is.
    rows, outputs : tuples of str
        The positions and outputs that it is about; empty where it is about all.
    p : float or None
        How often chance alone does the same; None where there was no test.

    Examples
    --------
    >>> import multipos as mp
    >>> finding, *_ = mp.demo().calibration.findings
    >>> finding.code, finding.level
    ('hidden-terms', 'note')
    """

    code: str
    level: Level
    text: str
    action: str = ""
    rows: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    p: Annotated[float | None, P_VALUE] = None

    def __post_init__(self) -> None:
        """Keep its sentences on one line, and short: some quote a file, or its name."""
        super().__post_init__()
        text = visible(self.text)
        short = text if len(text) <= LONGEST else f"{text[: LONGEST - 1]}…"
        object.__setattr__(self, "text", short)
        object.__setattr__(self, "action", visible(self.action))

    def __str__(self) -> str:
        if not self.action:
            return self.text
        return f"{self.text}{'' if self.text[-1] in '.?!' else '.'} {self.action}"


Findings: TypeAlias = tuple[Finding, ...]


def short_text(text_of: Callable[[int], str], most: int) -> str:
    """Return a text of so many parts as there is room for, at least one."""
    texts = map(text_of, range(most, 0, -1))
    return next((text for text in texts if len(text) <= LONGEST), text_of(1))


# Of version 0.1.
_OLD: dict[Any, Level] = {"implausible": "error", "caution": "warning"}


def findings_upgraded(content: Any) -> Any:
    """Return the content of a file with findings: version 0.1 wrote doubts and warnings.

    The texts of its doubts are among its warnings as well.
    """
    if not isinstance(content, Mapping) or "findings" in content:
        return content
    doubts, warnings = content.get("doubts", []), content.get("warnings", [])
    if not (_are(Mapping, doubts) and _are(str, warnings)):
        return content
    found = list(map(_of_doubt, doubts))
    known = [each["text"] for each in found]
    others = (text for text in warnings if text not in known)
    found += [Finding("earlier-warning", "warning", text).to_dict() for text in others]
    return {**content, "findings": found}


def _are(kind: type, entries: Any) -> bool:
    return isinstance(entries, list) and all(isinstance(each, kind) for each in entries)


def _of_doubt(doubt: Mapping[str, Any]) -> dict[str, Any]:
    level = _OLD.get(doubt.get("severity"))
    kept = {key: doubt.get(key) for key in ("code", "text", "rows", "outputs")}
    return {**kept, "level": level, "action": "", "p": None}


_FINDINGS = Listed(schema_of(Finding))
FINDINGS: dict[str, Kind] = {"findings": _FINDINGS}


def read_findings(content: Mapping[str, Any]) -> Findings:
    """Return the findings that a content has, once it is as `findings_upgraded` has it."""
    found: Findings = _FINDINGS.read(content.get("findings", ()))
    return found


def in_order(findings: Iterable[Finding]) -> Findings:
    """Return findings, each once, the most serious first."""
    each = {(found.code, found.text): found for found in findings}
    return tuple(sorted(each.values(), key=lambda found: LEVELS.index(found.level)))


def about(name: str, findings: Iterable[Finding]) -> Findings:
    """Return findings with what they are about before their texts."""
    return tuple(replace(found, text=f"{name}: {found.text}") for found in findings)


def errors_of(findings: Iterable[Finding]) -> Findings:
    """Return the findings that make a result unfit for use."""
    return tuple(found for found in findings if found.level == "error")


def serious(findings: Iterable[Finding]) -> Findings:
    """Return errors and warnings."""
    return tuple(found for found in findings if found.level != "note")


def warn(findings: Iterable[Finding]) -> None:
    """Raise errors and warnings as Python warnings of the line that called this package."""
    warn_of(map(str, serious(findings)))


def refuse_unfit(findings: Iterable[Finding], what: str) -> None:
    """Refuse to pass on a calibration that is not fit for use.

    Raises
    ------
    MultiposError
        It has findings of level error; the first is named.
    """
    found = errors_of(findings)
    if found:
        more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
        raise MultiposError(
            f"{what} is refused, as the calibration is not fit for use: {found[0].text}{more}; "
            "or export it as it is with --force, and the file states it."
        )


def forced(findings: Iterable[Finding]) -> list[str]:
    """Return what a file says that passes on a calibration in spite of its errors, as lines."""
    found = errors_of(findings)
    head = [f"EXPORTED WITH --force. {NOT_FIT}"] if found else []
    return head + [f"{finding.code}: {finding.text}" for finding in found]


def repeated_files(copies: Collection[str]) -> Findings:
    """Find files that were given twice: which, and as what."""
    if not copies:
        return ()
    said = list(copies)
    more = f" and {len(said) - _SHOWN} more" if len(said) > _SHOWN else ""
    text = f"identical files were counted once; omitted: {', '.join(said[:_SHOWN])}{more}"
    return (Finding("repeated-file", "warning", text, "Give each file once."),)
