"""What is shown of a session: the same by page, text screen, JSON lines and ``/state``."""

from functools import lru_cache
from typing import Any

import numpy as np

from multipos.capturing.session import Session
from multipos.diagnostics.magnetic import missing_directions
from multipos.numerics.arrays import Array
from multipos.positions.attitudes import pose_words
from multipos.reports.sections import Translator
from multipos.results import plain
from multipos.sensor.calibration import force_residuals
from multipos.sensor.gravity import GRAVITY, Field


@lru_cache(1024)
def chinese(text: str, field: Field = GRAVITY) -> str:
    """Return what a session says of poses and of the fit, in Chinese."""
    return Translator("zh", field).message(text)


_UNKNOWN: dict[str, Any] = {
    "values": None,
    "direction": None,
    "still": False,
    "seconds_left": None,
    "motion": None,
    "threshold": None,
    "enough": False,
    "refused": None,
    "refused_zh": None,
    "rows": 0,
    "bad_rows": 0,
    "gaps": 0,
}


def state_of(session: Session) -> dict[str, Any]:
    """Return what there is to show, as JSON can carry it; keys as in the reference."""
    rows, found = session.rows, session.evaluation
    shown: dict[str, Any] = plain(
        {
            "live": live_of(session),
            "taken": _entries(session),
            "next": _next(session),
            "parameters": _parameters(session),
            "finished": session.finished,
            "enough": session.is_enough,
            "outputs": () if rows is None else rows.outputs,
            "unit": _unit(session),
            "field": session.field.kind,
            "missing": _missing(session),
            "rows": 0 if rows is None else rows.rows,
            "bad_rows": 0 if rows is None else rows.bad,
            "gaps": 0 if rows is None else rows.gaps,
            "rate": session.rate,
            "threshold": session.threshold,
            "connected": session.connected,
            "positions": session.plan.positions,
            "targets": session.plan.targets,
            "problem": found.problem,
            "problem_zh": _chinese(found.problem, session.field),
            "findings": [
                {**each.to_dict(), "text_zh": chinese(each.text, session.field)}
                for each in found.findings
            ],
        }
    )
    return shown


def live_of(session: Session) -> dict[str, Any]:
    """Return what the sensor reads now, where it points, and whether it is still."""
    rows = session.rows
    if session.rests is None or rows is None:
        return _UNKNOWN
    motion, under_way = session.rests.motion(), session.under_way
    refused = None if under_way is None else under_way.reason
    live: dict[str, Any] = plain(
        {
            "values": session.newest,
            "direction": session.direction(session.newest),
            "still": motion.still,
            "seconds_left": None if session.rate is None else motion.samples_left / session.rate,
            "motion": motion.size,
            "threshold": session.rests.limit,
            "enough": under_way is not None and refused is None,
            "refused": refused,
            "refused_zh": _chinese(refused, session.field),
            "rows": rows.rows,
            "bad_rows": rows.bad,
            "gaps": rows.gaps,
        }
    )
    return live


def line_of(session: Session) -> dict[str, Any]:
    """Return the newest pose, with what follows from all of them: a line of ``--headless``."""
    line: dict[str, Any] = plain(
        {
            **_entries(session)[-1],
            "next": _next(session),
            "parameters": _parameters(session),
            "missing": _missing(session),
            "threshold": session.threshold,
            "rate": session.rate,
        }
    )
    return line


def _chinese(text: str | None, field: Field) -> str | None:
    return None if text is None else chinese(text, field)


def _missing(session: Session) -> Array | None:
    """Return the directions (k, 3) of a magnetic field that no pose is near, None of gravity."""
    if not session.field.magnetic:
        return None
    shown = [
        up
        for pose, up in zip(session.poses, session.directions(), strict=True)
        if pose.accepted and up is not None
    ]
    return missing_directions(np.array(shown).reshape(-1, 3))[0] + 0.0


def _parameters(session: Session) -> list[dict[str, Any]]:
    return [
        {
            "name": each.name,
            "value": each.value,
            "U": each.U,
            "unit": each.unit,
            "target": each.target,
            "met": each.met,
        }
        for each in session.evaluation.parameters
    ]


def _entries(session: Session) -> list[dict[str, Any]]:
    """Return `taken`."""
    residuals = _residuals(session)
    directions = session.directions()
    entries = []
    for pose, direction in zip(session.poses, directions, strict=True):
        residual, u = residuals.get(session.key(pose), (None, None))
        found = pose.still.found
        entries.append(
            {
                "position": pose.position,
                "direction": direction,
                "residual": residual,
                "residual_u": u,
                "residual_text": None if residual is None else _shown(session, residual),
                "accepted": pose.accepted,
                "reason": pose.reason,
                "reason_zh": _chinese(pose.reason, session.field),
                "provisional": session.threshold is None,
                "mean": found.mean,
                "u": found.u,
                "n": found.n,
                "start": pose.still.rows.start,
                "end": pose.still.rows.end,
            }
        )
    return entries


def _residuals(session: Session) -> dict[str, tuple[float, float]]:
    """Return the residual [g] of each pose that counts, and the standard uncertainty of one."""
    calibration = session.evaluation.calibration
    if calibration is None:
        return {}
    off, u = force_residuals(calibration)
    keys = [session.key(pose) for pose in session.accepted]
    return dict(zip(keys, zip(off.tolist(), u.tolist(), strict=True), strict=True))


def _shown(session: Session, residual: float) -> str:
    """Return a residual as people read it."""
    calibration = session.evaluation.calibration
    if calibration is None or not session.field.magnetic:
        return f"{1e6 * residual:+.0f} µg"
    return calibration.field.shown(residual)


def _next(session: Session) -> dict[str, Any] | None:
    found = session.next
    if found is None or session.finished:
        return None
    return {
        "direction": found.direction,
        "gain": found.gain,
        "label": found.label or None,
        "words": pose_words(found.direction, magnetic=session.field.magnetic),
    }


def _unit(session: Session) -> str | None:
    calibration = session.evaluation.calibration
    if calibration is not None:
        return calibration.model.unit
    return None if session.model is None else session.model.unit
