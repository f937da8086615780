"""Which repair of the data is believed, and which of several.

A repair leaves a misfit rho' where there was rho (`linear_view`). It is believed where

    N (rho'/rho)^nu < alpha,    nu = M (n − r),                                              (1)

the chance that one of N repairs, each a point in the nu dimensions of the residuals, comes so near
to residuals that are nothing but large; alpha is 1e-5, and .005 where rho is beyond what any sensor
gives, so that only the name is open; nu is less by one for every number fitted. And what it repairs
must not stick out afterwards, unless no chance brings it so near: an outlier is not an upside-down
row that happens to be near, nor are many rows upside down where leaving out one explains more. A
row that a repair moves by D and leaves d away from the others is an outlier by itself with
the chance (d/D)^M, for repairs of several rows their product.

Of several that are believed the least probable by chance is taken, each output by itself and in
reading units, so that nothing is gained by a unit:

    log N + sum over outputs of nu_i log(s_i'/s_i) + log J,                                  (2)

N of its own kind, s the residual standard deviation on nu_i = n − r degrees of freedom, one fewer
where a step was fitted, and J the product of the factors by which readings were made smaller.
"""

import math

import numpy as np

from multipos.doubts.linear_view import View
from multipos.doubts.repairs import Repair
from multipos.numerics.arrays import Array
from multipos.numerics.quantiles import f_tail

ABSURD = 0.4  # rho that no sensor at listed positions has
ABSURD_BUT_ONE = 0.25  # likewise, when the worst position is left out
_ALPHA, _ALPHA_ABSURD = 1e-5, 0.005
_BETTER = 1.0 / 3.0  # rho'/rho at most
_LEFT = 0.15  # rho' at most
_STICKS_OUT = 1e-4  # chance
# [g], by which one row must be off at least to be absurd and not an outlier; a factor of 9.8 takes
# .9 g less a bias. Rows beside it may be as little off as the other side of the horizon is.
_BY_ROWS = {"flipped-row": 0.8, "wrapped": 0.8, "row-unit": 0.6}
_TIE = 1.5  # repairs whose misfits are within this factor fit as well as each other


def is_absurd(view: View, placement_sd: float) -> bool:
    """Tell whether the misfit is beyond any sensor, placed to so many radians."""
    allowed = 2.5 * placement_sd
    return view.misfit > max(ABSURD, allowed) or view.misfit_but_one > max(ABSURD_BUT_ONE, allowed)


def explains(repair: Repair, view: View, tried: int, *, absurd: bool) -> bool:
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
    alpha = _ALPHA_ABSURD if absurd else _ALPHA
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
    mine = float((square / left)[rows].max())
    rest = max(float(square.sum()) - mine, 1e-30) / (dof - 1)
    return f_tail(mine / rest, float(outputs), float(outputs * (dof - 1))) < _STICKS_OUT
