"""What no sensor gives, and the one repair that would explain it.

`explained` returns what is grossly wrong with a fit: a repair that `explains` the data, of several
that which `as_good_as_best` leaves, or the fact. `is_gross` tells whether a misfit is beyond any
sensor.

The cheap question comes first: are the residuals and the directions of the outputs those of a
sensor? Only where they are not, the linear view of the readings is made, repairs
are tried on it (`repairs`), and where none explains the data, it is asked whether there is a
signal at all: residuals as large as what the outputs respond to one g, or an output that does
not respond to its own axis. A sensor that has a signal is then asked for its directions and units.

**Acceptance.** A repair leaves a misfit rho' where there was rho, eq. (5) of `repairs`. It is
accepted where

    N (rho'/rho)^nu < alpha,    nu = M (n − r),                                              (1)

the chance that one of N repairs, each a point in the nu dimensions of the residuals, comes so near
to residuals that are nothing but large; alpha is 1e-5, and .005 where rho is beyond what any sensor
gives, so that only the name is open; nu is less by one for every number fitted. And what it repairs
must not stick out afterwards, unless no chance brings it so near: an outlier is not an upside-down
row that happens to be near, nor are many rows upside down where leaving out one explains more. A
row that a repair moves by D and leaves d away from the others is an outlier by itself with
the chance (d/D)^M, for repairs of several rows their product.

Of several that are accepted the least probable by chance is taken, each output by itself and in
reading units, so that nothing is gained by a unit:

    log N + sum over outputs of nu_i log(s_i'/s_i) + log J,                                  (2)

N of its own kind, s the residual standard deviation on nu_i = n − r degrees of freedom, one fewer
where a step was fitted, and J the product of the factors by which readings were made smaller.
"""

import math
from dataclasses import replace

import numpy as np

from multipos.diagnostics.columns import repeated_rows
from multipos.diagnostics.repairs import Repair, View, candidates, look
from multipos.diagnostics.scales import (
    CLEAR,
    are_of_unit,
    cosines,
    expected_directions,
    factor_in_words,
    is_triad,
    output_unit,
    reversed_or_permuted,
    turned,
    unit,
)
from multipos.files.spelling import listed, quoted
from multipos.finding import Finding
from multipos.numerics.arrays import COMPONENTS, SMALLEST, Array, median
from multipos.numerics.quantiles import f_tail
from multipos.sensor.calibration import Calibration
from multipos.sensor.found import Estimator

GROSS = 0.4  # rho that no sensor at listed positions has
GROSS_BUT_ONE = 0.25  # likewise, when the worst position is left out
_ALPHA, _ALPHA_GROSS = 1e-5, 0.005
_BETTER = 1.0 / 3.0  # rho'/rho at most
_LEFT = 0.15  # rho' at most
_STICKS_OUT = 1e-4  # chance
# [g], by which one row must be off at least to be a gross error and not an outlier; a factor of 9.8
# takes .9 g less a bias. Rows beside it may be as little off as the other side of the horizon is.
_BY_ROWS = {"flipped-row": 0.8, "flipped-direction": 0.6, "wrapped": 0.8, "row-unit": 0.6}
_TIE = 1.5  # repairs whose misfits are within this factor fit as well as each other


def is_gross(view: View, typical_orientation_sd: float) -> bool:
    """Tell whether the misfit is beyond any sensor whose axes are uncertain by so many radians."""
    allowed = 2.5 * typical_orientation_sd
    return view.misfit > max(GROSS, allowed) or view.misfit_but_one > max(GROSS_BUT_ONE, allowed)


def explains(repair: Repair, view: View, tried: int, *, gross: bool) -> bool:
    """Tell whether a repair explains the data, by eq. (1) and without a row that sticks out."""
    before, after = view.misfit, repair.view.misfit
    if repair.code == "angles-in-radians":  # in reading units: |K| was as wrong as the angles
        before *= float(view.response.mean() / repair.view.response.mean())
    if repair.code in _BY_ROWS and _changes(repair, view).max(initial=0.0) < _BY_ROWS[repair.code]:
        return False
    if not after <= min(_BETTER * before, _LEFT):
        return False
    several = repair.code == "flipped-row" and len(repair.rows) > 1
    if several and _TIE * view.misfit_but_one < after:
        return False  # one outlier explains more
    nu = view.dof * view.values.shape[1] - (len(repair.outputs) if repair.fitted else 0)
    alpha = _ALPHA_GROSS if gross else _ALPHA
    if math.log(tried) + nu * math.log(max(after / before, 1e-300)) > math.log(alpha):
        return False
    return not _sticks_out(repair, view)


def as_good_as_best(repairs: list[Repair], view: View) -> list[Repair]:
    """Return the repairs that explain as much as the best of them, by eq. (2)."""
    chances = [_chance(repair, view) for repair in repairs]
    least = min(chances) + view.dof * view.values.shape[1] * math.log(_TIE)
    return [each for each, chance in zip(repairs, chances, strict=True) if chance <= least]


def _chance(repair: Repair, view: View) -> float:
    """Return the logarithm of eq. (2)."""
    dof = np.full(view.values.shape[1], float(view.dof))
    if repair.fitted:
        dof[list(repair.outputs)] -= 1.0
    least = 1e-24 * np.sum(view.values**2, axis=0) + np.finfo(float).tiny
    before, after = (
        np.maximum(np.sum(each.residuals**2, axis=0), least) for each in (view, repair.view)
    )
    ratio = np.log(after / np.maximum(dof, 1.0) * view.dof / before)
    return math.log(repair.tried) + 0.5 * float(dof @ ratio) + repair.shrunk


def _changes(repair: Repair, view: View) -> Array:
    """Return by how much each row is moved by its repair, in g."""
    rows, after = list(repair.rows), repair.view
    turned = (view.odd[rows, :3] - after.odd[rows, :3]) @ after.sensitivity.T
    expected = after.values[rows] - after.residuals[rows] + turned  # where it is listed
    return np.asarray(np.linalg.norm((view.values[rows] - expected) / after.response, axis=1))


def _sticks_out(repair: Repair, before: View) -> bool:
    """Tell whether a row that was changed is an outlier among the others even so.

    Its misfit, over what the others leave, follows F on M and M (dof − 1) degrees of freedom.
    """
    view, rows = repair.view, np.array(repair.rows)
    outputs, dof = view.values.shape[1], view.dof
    if len(rows) >= dof or dof <= 1:
        return False
    left = np.maximum(1.0 - np.sum(view.basis**2, axis=1), 1e-9)
    square = np.sum((view.residuals / view.response) ** 2, axis=1)
    share = np.sqrt((square / left)[rows]) / np.maximum(_changes(repair, before), 1e-12)
    by_chance = outputs * float(np.sum(np.log(np.clip(share, 1e-12, 1.0))))
    if math.log(repair.tried) + by_chance < math.log(_ALPHA):
        return False
    if repair.code == "flipped-row" and len(rows) == 1 and float(share[0]) < _NEGATED:
        return False  # a reading that lost its sign lost that of its bias too
    mine = float((square / left)[rows].max())
    rest = max(float(square.sum()) - mine, 1e-30) / (dof - 1)
    return f_tail(mine / rest, float(outputs), float(outputs * (dof - 1))) < _STICKS_OUT


_NEGATED = 0.05  # twice the bias, over the 2 g by which a negated reading is off
_OF_USE = 10.0  # [g], rms of a fit beyond which its size says nothing
_SUSPICIOUS = 0.02  # residual sd as a share of the signal, or terms beyond the linear ones
_ROUNDING = 1e-12  # likewise, where readings are exact
_CALM = 0.94  # cosine of an output with its own axis, 20°
_NO_RESPONSE = 0.2  # of an output to its own axis, as a share of its whole response
_FEW = 2.0  # standard deviations of a reading, as small as a response may be to be none
_SILENT = 0.02  # of what the other outputs respond
_QUIET = 0.2  # likewise, as scatter
_SKEW = 0.5  # cosine between two outputs of a triad, which should be at right angles


def explained(c: Calibration) -> tuple[Finding, ...]:
    """Return what is grossly wrong with the fit as a whole: the repair, or the fact as it is."""
    if _is_calm(c):
        return ()
    copied = _copied(c)
    if copied is not None:
        return (copied,)
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
    return tuple(finding for finding in found if finding is not None)


def _is_calm(c: Calibration) -> bool:
    """Tell, from what the fit has found, that a closer look is not needed.

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


def _copied(c: Calibration) -> Finding | None:
    """Find a row that is the copy of another and fits worst of all."""
    found = repeated_rows(c)
    if found is None or not c.estimator.exact:
        return None
    size = np.linalg.norm(c.residuals, axis=1)
    worst = c.readings.labels[int(np.argmax(size))]
    return replace(found, rows=(worst,)) if worst in found.rows else None


def _silent(c: Calibration) -> Finding | None:
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
    return Finding(
        "no-signal",
        "error",
        f"{quoted(silent)} does not respond to gravity along any axis",
        "Check the wiring and the column, or omit the output with --outputs.",
        outputs=tuple(silent),
    )


def _orientation_sd(c: Calibration) -> float:
    sd = c.readings.orientation_sd
    return 0.0 if sd is None or c.estimator.exact else float(np.max(sd))


def _repair(c: Calibration, view: View) -> Finding | None:
    """Return what one repair explains, the one after which the outputs face their own axes."""
    if not (view.misfit > 0.0 and np.ptp(view.values, axis=0).any()):
        return None  # nothing is left to explain, or all outputs stand still
    expected = expected_directions(c)
    found, tried = candidates(view, expected, slight=_is_slight(c))
    gross = is_gross(view, _orientation_sd(c))
    sound = [
        repair
        for repair in found
        if explains(repair, view, tried, gross=gross)
        and (  # an output that wrapped at both ends looks reversed beside one that did at one
            repair.code == "wrapped" or reversed_or_permuted(c, repair.view.sensitivity) is None
        )
    ]
    if not sound:
        return None
    as_good = as_good_as_best(sound, view)
    own = [np.round(cosines(each.view.sensitivity, expected).min(), 2) for each in as_good]
    best = as_good[int(np.argmax(own))]
    return _in_words(c, best)


_CELLS = 4  # rows that are named of each output


def _is_slight(c: Calibration) -> bool:
    """Return whether residuals are small, and no row alone is off by half of what `_BY_ROWS` asks.

    A row that is left out is off by its residual over one less its leverage.
    """
    if not c.estimator.exact or c.robust_weight is not None:
        return False
    size = np.linalg.norm(c.sensitivity, axis=1)
    left = 1.0 - c.diagnostics.leverage
    if not (c.residual_sd < _SUSPICIOUS * size).all() or not left.min() > _ROUNDING:
        return False
    return bool((np.abs(c.residuals) / left < 0.5 * min(_BY_ROWS.values()) * size).all())


def _in_words(c: Calibration, repair: Repair) -> Finding:
    labels = c.readings.labels
    rows = tuple(labels[row] for row in repair.rows)
    named = _positions(rows)
    outputs = tuple(c.outputs[i] for i in repair.outputs)
    after = f"rms is {repair.view.left_over:.2g} g"
    if c.rms < _OF_USE:
        after = f"rms falls from {c.rms:.2g} g to {repair.view.left_over:.2g} g"
    count = "is" if len(rows) == 1 else "are"
    if repair.code == "interchanged-rows" and len(rows) == len(labels):
        text = f"rows follow the positions in the order 'spread': matched so, {after}"
        return Finding("interchanged-rows", "error", text, "Fit with --order spread.")
    if repair.code == "flipped-row" and outputs:
        text = f"{quoted(outputs)} of {named} has the wrong sign: reversed, {after}"
        return Finding("flipped-row", "error", text, "Correct the sign.", rows, outputs)
    texts = {
        "flipped-direction": f"the direction of {named} has the wrong sign along "
        f"{COMPONENTS[repair.component]}: reversed, {after}",
        "interchanged-rows": f"{named} are probably interchanged: with readings exchanged, {after}",
        "flipped-row": f"{named} {count} listed upside down: with the direction reversed, {after}",
        "row-unit": f"{named} {count} in another unit, {factor_in_words(repair.size)}: converted, "
        f"{after}",
        "wrapped": f"readings overflowed the range at {_cells(c, repair)}: with {repair.size:.6g} "
        f"put back, {after}",
        "angles-in-radians": f"angles in columns named _deg are probably radians: read so, {after}",
    }
    actions = {
        "flipped-direction": "Correct the sign in the list.",
        "interchanged-rows": "Exchange their readings, or measure both again.",
        "flipped-row": "Reverse the direction in the list, or measure again.",
        "row-unit": "Convert all rows to one unit.",
        "wrapped": _unwrap(c, repair),
        "angles-in-radians": "Convert the angles to degrees.",
    }
    rows = () if repair.code == "angles-in-radians" else rows
    text, action = texts[repair.code], actions[repair.code]
    return Finding(repair.code, "error", text, action, rows=rows, outputs=outputs)


def _added(c: Calibration, repair: Repair) -> Array:
    """Return what a repair adds to the readings (n, M); `size` has its step."""
    return np.asarray(repair.view.values - c.readings.values)


def _cells(c: Calibration, repair: Repair) -> str:
    """Return the readings that a repair changes, by output."""
    added, named = _added(c, repair), []
    for i in repair.outputs:
        rows = [c.readings.labels[row] for row in np.flatnonzero(added[:, i])]
        named.append(f"{listed(rows, _CELLS)} of {c.outputs[i]}")
    return "; ".join(named)


def _unwrap(c: Calibration, repair: Repair) -> str:
    """Return what is added to readings that are too low, and taken from those that are too high."""
    added, step = _added(c, repair), f"{repair.size:.6g}"
    ways = {
        (True, False): f"Add {step} to these readings",
        (False, True): f"Subtract {step} from these readings",
        (True, True): f"Add {step} to the low ones of these readings and subtract it from the high",
    }
    way = ways.get((bool((added > 0.0).any()), bool((added < 0.0).any())))
    return f"{way}, or measure again in a wider range."


def _positions(rows: tuple[str, ...]) -> str:
    named = listed(rows, 12)
    return f"position {named}" if len(rows) == 1 else f"positions {named}"


def _no_signal(c: Calibration, view: View) -> Finding | None:
    """Find residuals as large as the signal, or outputs of a triad that are not three."""
    own = c.residual_sd / np.maximum(np.linalg.norm(c.sensitivity, axis=1), SMALLEST)
    poor = np.isnan(own) | (own > _SUSPICIOUS)
    if not is_gross(view, _orientation_sd(c)) or not poor.any():
        return None
    share = np.sqrt(np.sum(view.residuals**2, axis=0) / view.dof) / view.response
    loud = [output for output, own in zip(c.outputs, share.tolist(), strict=True) if own > GROSS]
    outputs = tuple(loud) if len(loud) < len(c.outputs) else ()
    return Finding(
        "no-signal",
        "error",
        (
            "readings do not match the listed positions: "
            f"residuals{f' of {quoted(outputs)}' if outputs else ''} are "
            f"{100.0 * float(share.max()):.0f} % of one g"
        ),
        "Check the order of the rows, the scheme and the columns.",
        outputs=outputs,
    )


def _no_response(c: Calibration, sensitivity: Array) -> Finding | None:
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
    return Finding(
        "no-signal",
        "error",
        f"outputs do not respond to the axes listed for them: {named}",
        "Check columns and wiring, or name the axis of each output with --axes.",
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
