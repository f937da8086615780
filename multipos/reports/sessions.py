"""The section of a report on a calibration that was combined from sessions."""

from multipos.files.numbers import decimals_of, plain_number, readable_unit
from multipos.reports.page import PageTable, Section
from multipos.reports.quantities import with_u
from multipos.reports.translations import Translator
from multipos.sensor.calibration import Calibration
from multipos.sensor.found import Sessions


def sessions_section(c: Calibration, sessions: Sessions, tr: Translator) -> Section:
    """Return how many sessions there were, how they differ, and what U holds.

    Parameters
    ----------
    c : Calibration
        Combined of the sessions.
    sessions : Sessions
        Its own.
    tr : Translator
    """
    header = ("Parameter", "Value", "u", "U", "Unit", "k", "sd between sessions")
    table = PageTable(
        tr("Parameters of all sessions"),
        tuple(map(tr, header)),
        tuple(_row(c, name, sd) for name, sd in sessions.sd.items()),
    )
    return Section(
        tr("Combined sessions"),
        (
            tr(
                "{count} sessions were combined: {files}.",
                count=str(sessions.runs),
                files=tr.listed(sessions.files),
            ),
            tr(
                "U is that of the next session beside these parameters: it holds how the sessions "
                "differ, mounting and switch-on among it, on {dof} degrees of freedom, and what "
                "all sessions share, such as gravity.",
                dof=str(sessions.runs - 1),
            ),
        ),
        tables=(table,),
    )


def _row(c: Calibration, name: str, sd: float) -> tuple[str, ...]:
    """Return a parameter with its U, and the sd over the sessions in the same unit."""
    p = c[name]
    shown = with_u(p.value, p.u, p.U, p.unit)
    factor, _ = readable_unit(max(abs(p.value), p.U), p.unit)
    decimals = decimals_of(factor * p.u)
    spread = plain_number(factor * sd, 2) if decimals is None else f"{factor * sd:.{decimals}f}"
    return p.name, *shown, plain_number(p.k, 3), spread
