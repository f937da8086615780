"""The next pose: where one more rest lowers the uncertainty most.

`best_pose` chooses it, `gain_at` gives the gain of a direction, `gain_of` that of a direction in a
state that is at hand, and `expected` what a rest there would read. With the information N of the
poses taken and I(u) of one more that points up along u (`multipos.designs.information`),

    C(u) = (N + I(u))⁻¹,      U_j(u) = k(ν + 1) sqrt([C(u)]_jj c_j + f_j),              (1)

where c_j and f_j are what the fit made of C, as in `multipos.designs.prospects`, ν its degrees of
freedom and k Student's factor. Before there is a fit, the sensor is the nominal one, and a weak
prior stands beside N, so that the first poses can be compared too. Without targets T_j the pose
with the smallest log det C(u) is best. With them it is the one with the smallest

    sum_j (U_j(u)/T_j)^8,                                                                   (2)

which is led by the worst parameter, but still separates poses where one pose cannot lower two
that are equally bad; before there are as many poses as parameters the determinant leads. What is
printed of a pose is its gain: the fall of max_j U_j/T_j, or of log det C.

The 26 directions of faces, edges and corners are easy to find by hand. A direction of a fine set is
only taken where it is clearly better than all of them.
"""

import math
from functools import cache
from typing import NamedTuple

import numpy as np

from multipos.designs.information import Setting
from multipos.designs.prospects import information_of, measured
from multipos.errors import MultiposError
from multipos.numerics.arrays import Array
from multipos.numerics.factoring import log_determinant
from multipos.numerics.quantiles import coverage_factor
from multipos.positions.scheme import read_scheme
from multipos.results import Result, frozen
from multipos.sensor.calibration import Calibration
from multipos.sensor.model import Model

_PRIOR_SD = 0.3  # [g], and relative: how much is known of a sensor before anything is measured
_READING_SD = 1e-3  # [g], of a rest, before a fit tells it
_EASIER = 0.98  # of the best score is enough for a direction that is easy to find
_APART_DEG = 20.0  # from every pose taken: a hand misses by ten, and a repeat is refused
_POWER = 8
_FINE = "fibonacci-200"


@frozen
class NextPose(Result):
    """The pose to take next.

    Attributes
    ----------
    direction : (3,) array
        Points up, in case axes.
    gain : float or None
        Fall of the worst U over its target; without targets of log det of the covariance.
    label : str
        Of the position in the scheme, where one is followed, or of the pose to be taken again.
    """

    direction: Array
    gain: float | None
    label: str = ""


class _State(NamedTuple):
    """What is known by now: information, and what makes U of its inverse."""

    setting: Setting
    present: Array
    scale: Array
    fixed: Array
    dof: float


def best_pose(
    model: Model,
    calibration: Calibration | None,
    taken: Array,
    targets: dict[str, float],
    asked: Array | None = None,
) -> NextPose | None:
    """Return the pose to take next, None where no direction is left.

    Parameters
    ----------
    model : Model
        What shall be fitted.
    calibration : Calibration or None
        Of the poses taken, as soon as there is one.
    taken : (n, 3) array
        Up vectors of the poses taken, and of one that is being taken.
    targets : mapping of parameter to U
    asked : (k, 3) array, optional
        Up vectors that are not asked for again.
    """
    state = _state(model, calibration, taken, unknown_orientation=True)
    rivals = [_candidates("all-26"), _candidates(_FINE)]
    closed = taken if asked is None else np.concatenate([taken, asked])
    open_ = [each[_apart(each, closed)] for each in rivals]
    led_by = targets if len(taken) >= len(state.present) else {}  # until a fit can be, by the whole
    scored = [(up, _score(state, up, led_by)) for up in open_ if len(up)]
    if not scored:
        return None
    best = max(float(score.max()) for _, score in scored)
    now = float(_score(state, None, led_by)[0])
    for up, score in scored:
        i = int(np.argmax(np.round(score, 9)))
        if score[i] - now >= _EASIER * (best - now):
            return NextPose(up[i], gain_of(state, up[i], targets))
    return None


def gain_at(
    model: Model,
    calibration: Calibration | None,
    taken: Array,
    targets: dict[str, float],
    up: Array,
) -> float:
    """Return the gain of one more pose that points up along (3,) up, by a scheme."""
    state = _state(model, calibration, taken, unknown_orientation=False)
    return gain_of(state, up, targets)


def expected(
    calibration: Calibration, targets: dict[str, float], further: Array | None = None
) -> tuple[Array, int]:
    """Return U over target (m,) once further poses are taken, eq. (1), and how many these are.

    Parameters
    ----------
    calibration : Calibration
        Of the poses taken; its noise is that of the others.
    targets : mapping of parameter to U
    further : (n, 3) array, optional
        Their up vectors; a fine set all over the sphere where not given.

    Raises
    ------
    MultiposError
        The calibration states no noise, or a model that depends on more than the position.
    """
    state = _known_state(calibration, np.empty((0, 3)))
    up = _candidates(_FINE) if further is None else further
    pieces = information_of(state.setting, up).sum(axis=0)[np.newaxis]
    return _ratios(state, pieces, targets, state.dof + len(up))[0], len(up)


@cache
def _candidates(name: str) -> Array:
    return read_scheme(name).up


def _apart(up: Array, taken: Array) -> Array:
    if not len(taken):
        return np.ones(len(up), dtype=np.bool_)
    return np.asarray((up @ taken.T).max(axis=1) < math.cos(math.radians(_APART_DEG)))


def _state(
    model: Model, calibration: Calibration | None, taken: Array, *, unknown_orientation: bool
) -> _State:
    if calibration is not None and calibration.model.names == model.names:
        try:
            return _known_state(calibration, taken)
        except MultiposError:
            pass  # a model that depends on more than the position, say
    spread = math.inf if unknown_orientation else 0.0
    fitted = model.with_gauge("lower") if unknown_orientation else model
    sd = np.full(len(model.outputs), _READING_SD)
    setting = Setting(fitted, spread, sd)
    p = len(fitted.keys)
    present = np.eye(p) / _PRIOR_SD**2
    if len(taken):
        present = present + information_of(setting, taken).sum(axis=0)
    return _State(setting, present, np.ones(p), np.zeros(p), math.inf)


def _known_state(calibration: Calibration, taken: Array) -> _State:
    setting, present, covered = measured(calibration)
    fixed = np.maximum(calibration.u**2 - np.diag(np.linalg.inv(present)) * covered, 0.0)
    later = taken[len(calibration.reference) :]
    if len(later):
        present = present + information_of(setting, later).sum(axis=0)
    dof = float(np.min(calibration.parameter_dof)) + len(later)
    return _State(setting, present, covered, fixed, dof)


def _score(state: _State, up: Array | None, targets: dict[str, float]) -> Array:
    """Return how good C(u) is, (n,); of what is there already where no direction is given."""
    pieces = (
        np.zeros((1, *state.present.shape)) if up is None else information_of(state.setting, up)
    )
    if not targets:
        return np.asarray(log_determinant(state.present + pieces)[1])
    ratio = _ratios(state, pieces, targets, state.dof)
    return np.asarray(-np.log(np.sum(ratio**_POWER, axis=1)))


def _ratios(state: _State, pieces: Array, targets: dict[str, float], dof: float) -> Array:
    """Return U_j over T_j (n, m) for every target."""
    names = state.setting.model.names
    places = [names.index(name) for name in targets if name in names]
    wanted = np.array([targets[names[i]] for i in places])
    try:
        C = np.linalg.inv(state.present + pieces)
    except np.linalg.LinAlgError:  # one position tells so much that no digit of others is left
        C = np.linalg.pinv(state.present + pieces, hermitian=True)
    variance = np.diagonal(C, axis1=1, axis2=2) * state.scale + state.fixed
    factor = coverage_factor(0.95, dof if dof > 0.0 else 1.0)
    return np.asarray(factor * np.sqrt(variance[:, places]) / wanted)


def gain_of(state: _State, up: Array, targets: dict[str, float]) -> float:
    """Return the gain of one direction (3,)."""
    piece = information_of(state.setting, up[np.newaxis])
    nothing = np.zeros_like(piece)
    if targets:
        now = _ratios(state, nothing, targets, state.dof).max()
        then = _ratios(state, piece, targets, state.dof + 1.0).max()
        return float(now - then)
    now = log_determinant(state.present)[1]
    return float(log_determinant(state.present + piece[0])[1] - now)
