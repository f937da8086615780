"""What is shown of a session, the same by page, text screen, JSON lines and ``/state``.

`state_of` gives all of it, `live_of` what the sensor reads now, and `line_of` the newest pose with
what follows from all of them.
"""

import math
from typing import Any

import numpy as np

from multipos.capturing.live_rests import Motion
from multipos.capturing.session import Session
from multipos.diagnostics.magnetic import missing_directions
from multipos.numerics.arrays import Array
from multipos.positions.attitudes import pose_words
from multipos.results import plain_dict
from multipos.sensor.calibration import force_residuals


def state_of(session: Session) -> dict[str, Any]:
    """Return what there is to show, as JSON can carry it; keys as in the reference."""
    live, found = live_of(session), session.evaluation
    return plain_dict(
        {
            "live": live,
            "taken": _entries(session),
            "next": _next(session),
            "parameters": found.parameters,
            "finished": session.finished,
            "enough": session.is_enough,
            "outputs": () if session.rows is None else session.rows.outputs,
            "unit": _unit(session),
            "field": session.field.kind,
            "missing": _missing(session),
            **{name: live[name] for name in ("rows", "bad_rows", "gaps")},
            "rate": session.rate,
            "threshold": session.threshold,
            "connected": session.connected,
            "positions": session.plan.positions,
            "targets": session.plan.targets,
            "problem": found.problem,
            "findings": [each.to_dict() for each in found.findings],
        }
    )


def live_of(session: Session) -> dict[str, Any]:
    """Return what the sensor reads now, where it points, and whether it is still."""
    rows, rests, under_way = session.rows, session.rests, session.under_way
    motion = Motion(None, False, 0) if rests is None else rests.motion()
    refused = None if under_way is None else under_way.reason
    return plain_dict(
        {
            "values": session.newest,
            "direction": session.direction(session.newest),
            "still": motion.still,
            "seconds_left": None if session.rate is None else motion.samples_left / session.rate,
            "motion": motion.size,
            "threshold": None if rests is None else rests.limit,
            "enough": under_way is not None and refused is None,
            "refused": refused,
            "rows": 0 if rows is None else rows.rows,
            "bad_rows": 0 if rows is None else rows.bad,
            "gaps": 0 if rows is None else rows.gaps,
        }
    )


def line_of(session: Session) -> dict[str, Any]:
    """Return the newest pose, with what follows from all of them: a line of ``--headless``."""
    return plain_dict(
        {
            **_entries(session)[-1],
            "next": _next(session),
            "parameters": session.evaluation.parameters,
            "missing": _missing(session),
            "threshold": session.threshold,
            "rate": session.rate,
        }
    )


def _missing(session: Session) -> Array | None:
    """Return the directions (k, 3) of a magnetic field that no pose is near, None of gravity."""
    if session.field.angle == "tilt":  # which shows by itself where it has been
        return None
    shown = [
        up
        for pose, up in zip(session.poses, session.directions(), strict=True)
        if pose.accepted and up is not None
    ]
    return missing_directions(np.array(shown).reshape(-1, 3))[0]


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
                "residual_text": _shown(session, residual),
                "accepted": pose.accepted,
                "reason": pose.reason,
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


def _shown(session: Session, residual: float | None) -> str | None:
    """Return a residual as people read it, where there is one."""
    if residual is None or not math.isfinite(residual):  # no force is found by such a model
        return None
    calibration = session.evaluation.calibration
    field = session.field if calibration is None else calibration.field
    return field.shown(residual, "+.0f", "µg")


def _next(session: Session) -> dict[str, Any] | None:
    found = session.next
    if found is None or session.finished:
        return None
    return {
        "direction": found.direction,
        "gain": found.gain,
        "label": found.label or None,
        "words": pose_words(found.direction, session.field.towards),
    }


def _unit(session: Session) -> str | None:
    calibration = session.evaluation.calibration
    model = session.model if calibration is None else calibration.model
    return None if model is None else model.unit
