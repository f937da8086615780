"""What no sensor gives, and the one repair that would explain it.

The cheap question comes first: are the residuals and the directions of the outputs those of a
sensor? Only where they are not, the linear view of the readings is made (`linear_view`), repairs
are tried on it (`repairs`), and where none explains the data, it is asked whether there is a
signal at all: residuals as large as what the outputs respond to one g, or an output that does
not respond to its own axis. A sensor that has a signal is then asked for its directions and units.
"""

import math

import numpy as np

from multipos.doubt import Doubt
from multipos.doubts.belief import ABSURD, as_good_as_best, explains, is_absurd
from multipos.doubts.directions import (
    CLEAR,
    cosines,
    expected_directions,
    is_triad,
    reversed_or_permuted,
    turned,
)
from multipos.doubts.linear_view import View, look
from multipos.doubts.repairs import Repair, candidates
from multipos.doubts.scales import are_of_unit, factor_in_words, output_unit, unit
from multipos.files.lists import quoted
from multipos.numerics.arrays import Array
from multipos.numerics.medians import median
from multipos.numerics.terms import COMPONENTS
from multipos.sensor.calibration import Calibration
from multipos.sensor.found import Estimator

_SUSPICIOUS = 0.02  # residual sd as a share of the signal, or terms beyond the linear ones
_ROUNDING = 1e-12  # likewise, where readings are exact
_CALM = 0.94  # cosine of an output with its own axis, 20°
_NO_RESPONSE = 0.2  # of an output to its own axis, as a share of its whole response
_FEW = 2.0  # standard deviations of a reading, as small as a response may be to be none
_SILENT = 0.02  # of what the other outputs respond
_QUIET = 0.2  # likewise, as scatter
_SKEW = 0.5  # cosine between two outputs of a triad, which should be at right angles


def explained(c: Calibration) -> tuple[Doubt, ...]:
    """Return what is absurd about the fit as a whole: the repair, or what it says as it is."""
    if _is_calm(c):
        return ()
    silent = _silent(c)
    if silent is not None:
        return (silent,)
    view = look(c)
    sensitivity = c.sensitivity
    if view is not None and view.dof > 0:
        if not c.model.has_all_linear:
            sensitivity = view.sensitivity
        repaired = _repair(c, view)
        if repaired is not None:
            return (repaired,)
        lost = _no_signal(c, view)
        if lost is not None:
            return (lost,)
    found = [ask(c, sensitivity) for ask in (_no_response, output_unit, unit)]
    if found[0] is None:
        found.append(reversed_or_permuted(c, sensitivity))
    if found[0] is found[-1] is None:
        found.append(turned(c, sensitivity))
    return tuple(doubt for doubt in found if doubt is not None)


def _is_calm(c: Calibration) -> bool:
    """Tell, from what the fit has found, that a closer look is not worth its time.

    Nearly every fit ends here, so it goes by plain numbers: arrays of three cost more.
    """
    sizes = []
    faces = c.facing or c.model.axes
    for row, axis, sd in zip(c.sensitivity.tolist(), faces, c.residual_sd.tolist(), strict=True):
        size = math.hypot(*row)
        sizes.append(size)
        along = row[COMPONENTS.index(axis[-1])] * (-1.0 if axis.startswith("-") else 1.0)
        if not sd < _SUSPICIOUS * size or along < _CALM * size:
            return False  # a NaN too, where nothing is left over
        if c.diagnostics.outliers and sd > _ROUNDING * size:
            return False
    if not are_of_unit(sizes, c.model.unit):
        return False
    if not c.estimator.exact:
        return c.estimator == Estimator.UNKNOWN or c.rms < _SUSPICIOUS
    return c.model.is_linear or not _bends(c, dict(zip(c.outputs, sizes, strict=True)))


def _bends(c: Calibration, sizes: dict[str, float]) -> bool:
    """Tell whether terms beyond the linear ones are large, or a formula is far from linear."""
    if not c.model.has_all_linear:
        view = look(c)
        return view is None or not view.misfit < _SUSPICIOUS
    return any(
        term.force_degree > 1 and abs(value) > 10.0 * _SUSPICIOUS * sizes[output]
        for (output, term), value in zip(c.model.keys, c.parameters.tolist(), strict=True)
    )


def _silent(c: Calibration) -> Doubt | None:
    """Find outputs that only scatter, and as the others do; in another unit they would do less."""
    response = np.linalg.norm(c.sensitivity, axis=1)
    middle, scatter = float(median(response)), float(median(c.residual_sd))
    if not (response < _SILENT * middle).any() or not scatter > 0.0:
        return None
    alike = c.residual_sd / scatter > np.sqrt(response / middle)
    alike &= c.residual_sd < _QUIET * middle  # else a row may be upside down, say
    found = (response < _SILENT * middle) & alike
    silent = [output for output, each in zip(c.outputs, found.tolist(), strict=True) if each]
    if not silent:
        return None
    return Doubt(
        "no-signal",
        "implausible",
        f"{quoted(silent)} does not respond to gravity along any axis: the output is not "
        "connected, or the column is another one; mend it, or leave it out with --outputs",
        outputs=tuple(silent),
    )


def _placement_sd(c: Calibration) -> float:
    sd = c.readings.orientation_sd
    return 0.0 if sd is None or c.estimator.exact else float(np.max(sd))


def _repair(c: Calibration, view: View) -> Doubt | None:
    """Return what one repair explains, the one after which the outputs face their own axes."""
    expected = expected_directions(c)
    found, tried = candidates(view, expected)
    absurd = is_absurd(view, _placement_sd(c))
    sound = [
        repair
        for repair in found
        if explains(repair, view, tried, absurd=absurd)
        and (  # an output that wrapped at both ends looks reversed beside one that did at one
            repair.code == "wrapped" or reversed_or_permuted(c, repair.view.sensitivity) is None
        )
    ]
    if not sound:
        return None
    best = max(as_good_as_best(sound, view), key=lambda each: _faces(each.view, expected))
    return _in_words(c, best)


def _faces(view: View, expected: Array) -> float:
    """Return how well outputs face their own axes, the worst of them."""
    return float(np.round(cosines(view.sensitivity, expected).min(), 2))


def _in_words(c: Calibration, repair: Repair) -> Doubt:
    labels = c.readings.labels
    rows = tuple(labels[row] for row in repair.rows)
    named = _positions(rows)
    outputs = tuple(c.outputs[i] for i in repair.outputs)
    before = "of no use" if np.isnan(c.rms) else f"{c.rms:.3g} g"
    after = f"the rms falls from {before} to {repair.view.left_over:.3g} g"
    count = "is" if len(rows) == 1 else "are"
    texts = {
        "interchanged-rows": f"{named} look interchanged: with their readings exchanged {after}; "
        "exchange them, or measure both again",
        "flipped-row": f"{named} {count} upside down: with the other side up {after}; turn the "
        "direction round in the list, or measure again",
        "row-unit": f"{named} {count} in another unit, {factor_in_words(repair.size)}: with the "
        f"factor taken out {after}; bring all rows to one unit",
        "wrapped": f"{quoted(outputs)} ran over one end of the range at {named} and came out "
        f"at the other: with {repair.size:.6g} put back {after}; add it, or measure again in a "
        "wider range",
        "angles-in-radians": "the angles look like radians under a name that ends in _deg: taken "
        f"as such {after}; convert them to degrees",
    }
    everywhere = repair.code == "angles-in-radians"
    text = texts[repair.code]
    return Doubt(repair.code, "implausible", text, () if everywhere else rows, outputs)


def _positions(rows: tuple[str, ...]) -> str:
    named = f"{', '.join(rows[:12])}" + (f" and {len(rows) - 12} more" if len(rows) > 12 else "")
    return f"position {named}" if len(rows) == 1 else f"positions {named}"


def _no_signal(c: Calibration, view: View) -> Doubt | None:
    """Find residuals as large as the signal, or outputs of a triad that are not three."""
    own = c.residual_sd / np.maximum(np.linalg.norm(c.sensitivity, axis=1), np.finfo(float).tiny)
    poor = np.isnan(own) | (own > _SUSPICIOUS)
    if not is_absurd(view, _placement_sd(c)) or not poor.any():
        return None
    share = np.sqrt(np.sum(view.residuals**2, axis=0) / view.dof) / view.response
    loud = [output for output, own in zip(c.outputs, share.tolist(), strict=True) if own > ABSURD]
    outputs = tuple(loud) if len(loud) < len(c.outputs) else ()
    return Doubt(
        "no-signal",
        "implausible",
        f"the residuals{f' of {quoted(outputs)}' if outputs else ''} are "
        f"{100.0 * float(share.max()):.0f} % of what one g does to the output: the readings do not "
        "follow the positions; the order of the rows, the scheme and the columns are where to look",
        outputs=outputs,
    )


def _no_response(c: Calibration, sensitivity: Array) -> Doubt | None:
    """Find outputs that do not respond to their own axis, in a sensor that is not turned."""
    size = np.linalg.norm(sensitivity, axis=1)
    expected = expected_directions(c)
    within = size <= _known_to(c)
    skew = not is_triad(c) or not size.all() or _is_skew(sensitivity / size[:, None])
    if not within.any() and not skew:
        return None  # a triad: turned, if anything
    own = np.abs(cosines(sensitivity, expected))
    least = CLEAR if is_triad(c) else _NO_RESPONSE
    silent = [
        output
        for output, cosine, lost in zip(c.outputs, own.tolist(), within.tolist(), strict=True)
        if cosine < least or lost
    ]
    if not silent:
        return None
    axes = dict(zip(c.outputs, c.model.axes, strict=True))
    named = ", ".join(f"{output} to {axes[output]}" for output in silent)
    return Doubt(
        "no-signal",
        "implausible",
        f"an output does not respond to its own axis: {named}; look at the columns and the wiring, "
        "or say with --axes which axis each output senses",
        outputs=tuple(silent),
    )


def _known_to(c: Calibration) -> Array:
    """Return how well the response of each output is known (M,), as its own scale factor is."""
    scales = list(c.model.own_scales)
    if len(scales) != len(c.outputs):
        return np.zeros(len(c.outputs))
    return np.fmin(c.U[scales], _FEW * c.residual_sd)  # U of one degree of freedom says little


def _is_skew(unit: Array) -> bool:
    """Tell whether outputs of a triad are far from right angles to each other."""
    between = np.abs(unit @ unit.T - np.eye(3))
    return bool(between.max() > _SKEW)
