"""The axis and sense of outputs: by their names, and by a minus before an axis.

`note_names` says where names give another order than x, y, z, and `face` turns a calibration to
what was stated of its outputs, or warns of the other convention.

Where the orientations are unknown the fit leaves every reflection free,
y = b + K f = b + (K D)(D f) with D of signs, and takes own-axis scale factors positive. An output
that is stated to face down its axis has a negative one: the reflection that makes it so is applied
to what was fitted. Where every output falls as what it is stated to sense rises, the other
convention is the likely one.
"""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from multipos.errors import UsageError
from multipos.finding import Finding
from multipos.fitting.completion import add_findings
from multipos.numerics.arrays import COMPONENTS
from multipos.numerics.rotations import rotation_matrix, rotation_vector
from multipos.numerics.terms import Term
from multipos.positions import orientations
from multipos.positions.attitudes import CONVENTIONS
from multipos.positions.readings import Readings
from multipos.sensor.calibration import Calibration
from multipos.sensor.model import Model


def note_names(readings: Readings, model: Model) -> Readings:
    """Return readings that say where their outputs stand in another order than x, y, z."""
    if model.axes == COMPONENTS[: len(model.axes)]:
        return readings
    pairs = zip(model.outputs, model.axes, strict=True)
    said = ", ".join(f"{output} senses {axis}" for output, axis in pairs)
    found = Finding("axes-by-name", "note", f"by their names {said}", "State others with --axes.")
    return replace(readings, findings=(*readings.findings, found))


def face(calibration: Calibration, facing: tuple[str, ...] | None) -> Calibration:
    """Return a calibration that knows what was said of its outputs, reflected where it is free.

    Where nothing was said every output is taken to face along its axis. One that says of all its
    outputs that they face the other way has that as a finding.

    Raises
    ------
    UsageError
        A symmetric gauge, which no reflection leaves.
    """
    if facing is None:
        return _with_convention(calibration, calibration.model.axes)
    down = {axis.removeprefix("-") for axis in facing if axis.startswith("-")}
    if down and (reversed_axes := _other_way_round(calibration, down)):
        calibration = _reflected(calibration, reversed_axes)
    return _with_convention(replace(calibration, facing=facing), facing)


def _with_convention(calibration: Calibration, facing: tuple[str, ...]) -> Calibration:
    """Return a calibration that warns where the readings look like the other convention."""
    c = calibration
    down = {o for o, axis in zip(c.outputs, facing, strict=True) if axis.startswith("-")}
    along = [-scale if output in down else scale for output, scale in _own_slopes(c)]
    if not along or max(along) >= 0.0:
        return c
    other = next(name for name in CONVENTIONS if name != c.convention)
    how = "of the opposite sign to --axes" if down else "negative"
    text = (
        f"every scale factor is {how} under the convention {c.convention}; readings look like "
        f"{other}"
    )
    found = Finding("convention", "warning", text, f"Fit with --convention {other}.")
    return add_findings(c, found)


def _own_slopes(c: Calibration) -> Iterable[tuple[str, float]]:
    """Return how each output responds along its axis, of those that have a scale factor."""
    return c.model.own_slopes(c.parameters, c.reference, c.readings.environment).items()


def _other_way_round(c: Calibration, down: set[str]) -> set[str]:
    """Return the axes to reverse, where nothing listed ties them, so that those said face down.

    Rows of a group determine the handedness, so that only an even number of axes is reversed.
    """
    rolled = c.readings.open_roll is not None
    if c.model.gauge is None and not rolled:
        return set()
    stated = orientations.place(c.readings, 1.0)
    if stated.listed.any():
        return set()
    own = {c.model.axes[c.outputs.index(output)]: scale for output, scale in _own_slopes(c)}
    wrong = {axis for axis, scale in own.items() if (scale < 0.0) != (axis in down)}
    return own.keys() - wrong if stated.groups and len(wrong) % 2 else wrong


def _reflected(calibration: Calibration, down: set[str]) -> Calibration:
    """Return a calibration whose orientation is free with some axes the other way round."""
    gauge = calibration.model.gauge
    terms = [term for _, term in calibration.model.keys]
    if gauge == "symmetric" or not all(isinstance(term, Term) for term in terms):
        raise UsageError(
            "--axes with a minus needs --gauge lower, and a model of terms, where orientations are "
            "unknown."
        )
    # what a term is multiplied by where components change their sign; a modulus is even
    odd = [sum(f.power for f in term.factors if f.variable in down) for term in terms]
    sign = np.where(np.array(odd) % 2 == 1, -1.0, 1.0)
    mirror = np.array([-1.0 if axis in down else 1.0 for axis in COMPONENTS])
    c, found = calibration, calibration.orientations
    if found is not None and found.inclination_deg:
        about = dict(zip(c.readings.group or (), c.readings.open_roll or (), strict=True))
        leans = {
            g: -beta if about[g] in down else beta for g, beta in found.inclination_deg.items()
        }
        found = replace(found, inclination_deg=leans)
    if found is not None and found.group_rotation_deg:
        turned = {
            g: np.degrees(rotation_vector(mirror[:, None] * rotation_matrix(np.radians(vector))))
            for g, vector in found.group_rotation_deg.items()
        }
        found = replace(found, group_rotation_deg=turned)
    return replace(
        calibration,
        orientations=found,
        parameters=sign * calibration.parameters,
        covariance=np.outer(sign, sign) * calibration.covariance,
        reference=calibration.reference * mirror + 0.0,
    )
