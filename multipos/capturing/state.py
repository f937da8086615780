"""What is shown of a session: the same by the page, the text screen, JSON lines and ``/state``.

A pose in words, which axis points up, how far the case leans; and what is said, in Chinese.

Of the direction up, u in case axes, the largest component names the axis to point up. What is left
is a lean by acos|u_largest| towards the axes that rise with it.
"""

import math
from functools import lru_cache
from typing import Any

import numpy as np

from multipos.capturing.session import Session
from multipos.numerics.arrays import Array
from multipos.reports.page import Translator
from multipos.results import plain

_LEVEL_DEG = 3.0  # nothing a hand can tell
_SMALL_SHARE = 0.35  # of the lean, below which an axis is not named


def pose_words(up: Array) -> dict[str, str]:
    """Return the words for a pose, by language: "+z up, leaning 35° towards −x"."""
    main = max(range(3), key=lambda i: abs(round(float(up[i]), 9)))
    lean = math.degrees(math.acos(min(1.0, abs(float(up[main])))))
    axis = _axis(main, float(up[main]))
    if lean < _LEVEL_DEG:
        return {"en": f"{axis} straight up", "zh": f"{axis} 轴竖直向上"}
    rest = [i for i in range(3) if i != main]
    size = math.hypot(*(float(up[i]) for i in rest))
    named = [i for i in rest if abs(float(up[i])) >= _SMALL_SHARE * size]
    named.sort(key=lambda i: -abs(round(float(up[i]), 9)))
    risen = [_axis(i, float(up[i])) for i in named]
    return {
        "en": f"{axis} up, leaning {lean:.0f}° so that {' and '.join(risen)} rises"
        if len(risen) == 1
        else f"{axis} up, leaning {lean:.0f}° so that {' and '.join(risen)} rise",
        "zh": f"{axis} 轴向上，倾斜 {lean:.0f}°，使 {'、'.join(risen)} 抬高",
    }


@lru_cache(1024)
def chinese(text: str) -> str:
    """Return what a session says of poses and of the fit, in Chinese."""
    return Translator("zh").message(text)


def _axis(i: int, value: float) -> str:
    return f"{'+' if value >= 0.0 else '−'}{'xyz'[i]}"


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
            "rows": 0 if rows is None else rows.rows,
            "bad_rows": 0 if rows is None else rows.bad,
            "gaps": 0 if rows is None else rows.gaps,
            "rate": session.rate,
            "threshold": session.threshold,
            "connected": session.connected,
            "positions": session.plan.positions,
            "targets": session.plan.targets,
            "problem": found.problem,
            "problem_zh": _chinese(found.problem),
            "doubts": [{**doubt, "text_zh": chinese(doubt["text"])} for doubt in found.doubts],
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
            "refused_zh": _chinese(refused),
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
            "threshold": session.threshold,
            "rate": session.rate,
        }
    )
    return line


def _chinese(text: str | None) -> str | None:
    return None if text is None else chinese(text)


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
                "accepted": pose.accepted,
                "reason": pose.reason,
                "reason_zh": _chinese(pose.reason),
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
    readings = calibration.readings
    force = calibration.compensate(readings.values, readings.environment)
    reference = calibration.reference
    if calibration.model.gauge is not None:
        off = np.linalg.norm(force, axis=1) - np.linalg.norm(reference, axis=1)
    else:
        off = np.linalg.norm(force - reference[:, : force.shape[1]], axis=1)
    J = calibration.model.force_jacobian(calibration.parameters, reference, readings.environment)
    scale = np.linalg.norm(J, axis=2)
    u = np.sqrt(np.mean((calibration.sd_of_readings / scale) ** 2, axis=1))
    keys = [session.key(pose) for pose in session.accepted]
    return dict(zip(keys, zip(off.tolist(), u.tolist(), strict=True), strict=True))


def _next(session: Session) -> dict[str, Any] | None:
    found = session.next
    if found is None or session.finished:
        return None
    return {
        "direction": found.direction,
        "gain": found.gain,
        "label": found.label or None,
        "words": pose_words(found.direction),
    }


def _unit(session: Session) -> str | None:
    calibration = session.evaluation.calibration
    if calibration is not None:
        return calibration.model.unit
    return None if session.model is None else session.model.unit
