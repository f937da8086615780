"""Prospects: what one more position would bring to a calibration, and when enough are measured.

`worth` returns how far each candidate lowers the uncertainties; `worth_text` prints it and
`worth_sentence` names the best. `measured` is the information of the readings, `information_of`
that of positions.

With the information N of the positions measured and I(u) of one more at u, both of
`multipos.designs.information` with the sensor's own parameters and reading noise, the covariance

    C = N⁻¹      becomes      C(u) = (N + I(u))⁻¹,      u_j(u)² = [C(u)]_jj + c_j²,          (1)

where c_j² is what the calibration's uncertainty has beyond C and no position lowers, such as that
of gravity. The expected gain of a position is how far the u_j fall; taking the most worthy again
and again until u_j is small enough says how many more are needed.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from multipos.designs.information import Setting
from multipos.errors import MultiposError, UsageError
from multipos.estimation.correlated_rows import order_in_time
from multipos.files.numbers import number, table
from multipos.files.tables import Source
from multipos.finding import Findings, errors_of
from multipos.numerics.arrays import COMPONENTS, SMALLEST, Array
from multipos.positions.readings import diagonal
from multipos.positions.scheme import Scheme, read_bench
from multipos.results import Keyed, data_frame, frozen, require
from multipos.sensor.calibration import Calibration
from multipos.sensor.found import Estimator

_SHOWN = 10  # positions listed as text
_MOST = 1000  # further positions looked ahead for a target
_OPEN = (
    "the positions of this calibration leave a parameter open, so nothing can be predicted from "
    "them; add positions that differ more, and fit again."
)


@frozen
class Candidate(Keyed):
    """A position that could be measured next.

    Attributes
    ----------
    up : (3,) array
    fall : float
        Share by which u of the parameter falls, or u on geometric average.
    u : mapping of 'output:term' to float
        What each would be.
    """

    up: Array
    fall: float
    u: Mapping[str, float]


@frozen
class Worth(Keyed):
    """What one more position would bring to a calibration, and how many a target takes.

    Attributes
    ----------
    parameter : str or None
        'OUTPUT:TERM', or None where all count.
    target : float or None
    u : mapping of 'output:term' to float
        As it is now.
    candidates : tuple of Candidate
        Best first.
    further_positions : int or None
        Until the target; None without one, or beyond reach.
    path : (further_positions, 3) array or None
        Up vectors of these, in the order of their expected gain.
    floor : float or None
        The part of u of the parameter that no position lowers.
    drift_absorbed : float
        Share of the variance of the row number that the model absorbs, as the rows stand.
    findings : tuple of Finding
        Errors of the calibration.
    """

    parameter: str | None
    target: float | None
    u: Mapping[str, float]
    candidates: tuple[Candidate, ...]
    further_positions: int | None
    path: Array | None
    floor: float | None
    drift_absorbed: float
    findings: Findings = ()

    def to_pandas(self) -> Any:
        """Return the candidates as a data frame: up_x, up_y, up_z, fall, u of each parameter.

        Raises
        ------
        MultiposError
            pandas is not installed.
        """
        up = np.array([candidate.up for candidate in self.candidates])
        columns = {f"up_{axis}": up[:, i] for i, axis in enumerate(COMPONENTS)}
        columns["fall"] = np.array([candidate.fall for candidate in self.candidates])
        for key in self.u:
            columns[f"u {key}"] = np.array([candidate.u[key] for candidate in self.candidates])
        return data_frame(columns)


def worth(
    calibration: Calibration,
    *,
    candidates: "Source | Scheme" = "all-26",
    parameter: str | None = None,
    target: float | None = None,
) -> Worth:
    """Return how far each candidate position would lower the uncertainties of a calibration.

    Parameters
    ----------
    calibration : Calibration
    candidates : bench, scheme, path or columns
        Positions that could be measured next (`multipos.positions.scheme`).
    parameter : str, optional
        'OUTPUT:TERM', the one that counts; all of them together (mean of ln u) where not given.
    target : float, optional
        Standard uncertainty that `parameter` shall have.

    Returns
    -------
    Worth

    Raises
    ------
    MultiposError
        The calibration states no noise to predict from, or a model with other columns.
    UsageError
        No such parameter, or a target without one.

    Examples
    --------
    >>> import multipos as mp
    >>> sensor = mp.demo().calibration
    >>> run = mp.simulate(sensor, "fibonacci-12", reading_sd=1e-4, seed=1)
    >>> cal = mp.fit(run, convention="gravity", reading_sd=1e-4)
    >>> found = mp.worth(cal, parameter="ax:1", target=3e-5)
    >>> best = found.candidates[0]
    >>> bool(best.u["ax:1"] < found.u["ax:1"])
    True
    """
    require(calibration, Calibration)
    keys = [f"{output}:{term}" for output, term in calibration.model.keys]
    _check_target(keys, parameter, target)
    index = None if parameter is None else keys.index(parameter)
    setting, present, covered = measured(calibration)
    up = read_bench(candidates)
    pieces = information_of(setting, up)
    now = _variances(present)
    fixed = np.maximum(calibration.u**2 - now * covered, 0.0)
    then = np.sqrt(_variances(present + pieces) * covered + fixed)
    before = np.sqrt(now * covered + fixed)
    fall = 1.0 - (then / before)[:, index] if index is not None else _mean_fall(then, before)
    order = np.argsort(-fall, kind="stable")
    path = None
    if target is not None and index is not None:
        path = _ahead(present, pieces, covered[index], fixed[index], index, target)
    ranked = [
        Candidate(up[row], float(fall[row]), dict(zip(keys, then[row].tolist(), strict=True)))
        for row in order.tolist()
    ]
    return Worth(
        findings=errors_of(calibration.findings),
        parameter=parameter,
        target=target,
        u=dict(zip(keys, before.tolist(), strict=True)),
        candidates=tuple(ranked),
        further_positions=None if path is None else len(path),
        path=None if path is None else up[path],
        floor=None if index is None else math.sqrt(fixed[index]),
        drift_absorbed=setting.drift_absorbed(calibration.reference / calibration.sign),
    )


def _check_target(keys: list[str], parameter: str | None, target: float | None) -> None:
    if parameter is not None and parameter not in keys:
        raise UsageError(f"unknown parameter '{parameter}'; give one of {', '.join(keys)}.")
    if target is not None and (parameter is None or not target > 0.0):
        raise UsageError("a target must be above 0 and name its parameter, as in ax:x=0.001.")


def worth_text(found: Worth, towards: str = "up") -> str:
    """Return `worth` as text: the best next positions, and how many the target takes."""
    parameter = found.parameter
    rows = [
        [*(f"{value:.6f}" for value in entry.up), f"{100.0 * entry.fall:.2f}"]
        + ([] if parameter is None else [number(entry.u[parameter])])
        for entry in found.candidates[:_SHOWN]
    ]
    header = [*(f"{towards} {axis}" for axis in COMPONENTS), "u falls by %"]
    if parameter is not None:
        header.append("to")
    drift = f"the model absorbs {100.0 * found.drift_absorbed:.0f} % of a drift along the rows"
    return "\n\n".join([table(header, rows, left=0), drift, *_way_to_target(found, towards)]) + "\n"


def _way_to_target(found: Worth, towards: str) -> list[str]:
    """Say how many positions the target takes, where there is one."""
    if found.target is None:
        return []
    if found.path is None:
        missed = (
            f"the target of {number(found.target)} is out of reach: u stays above "
            f"{number(found.floor)}, whatever is measured, or falls too slowly"
        )
        return [missed]
    reached = (
        f"{found.further_positions} further positions reach the target; the next ones, "
        "in the order of their gain:"
    )
    steps = [
        [str(i + 1), *(f"{value:.6f}" for value in row)]
        for i, row in enumerate(found.path[:_SHOWN].tolist())
    ]
    header = ["next", *(f"{towards} {axis}" for axis in COMPONENTS)]
    return [reached, table(header, steps)] if steps else [reached]


def measured(calibration: Calibration) -> tuple[Setting, Array, Array]:
    """Return the setting, the information of the readings, and what scales its inverse.

    The scale is 1 but where the fit found the noise other than it was stated, or slow.
    """
    model, readings = calibration.model, calibration.readings
    if model.environment:
        raise MultiposError(
            f"the model has column '{model.environment[0]}', which a position does not set; "
            "the gain of positions is available for models of specific force only."
        )
    unknown = calibration.estimator is Estimator.UNKNOWN
    sd = np.ones(len(model.outputs)) if unknown else calibration.residual_sd
    if calibration.noise is not None:
        variances = diagonal(calibration.noise).reshape(readings.values.shape)
        sd = np.sqrt(np.mean(variances, axis=0))
    if not all(np.all(np.isfinite(each) & (each >= SMALLEST)) for each in (calibration.u, sd)):
        raise MultiposError(
            "the calibration has no reading noise to predict from: as many terms as readings; "
            "fit again with --reading-sd."
        )
    spread = math.inf if unknown else 0.0
    if calibration.estimator is Estimator.UNCERTAIN and readings.orientation_sd is not None:
        stated = readings.orientation_sd[np.isfinite(readings.orientation_sd)]
        spread = float(np.sqrt(np.mean(stated**2)))
    sign = calibration.sign
    size = np.linalg.norm(calibration.reference, axis=1)
    setting = Setting(model, spread, sd, calibration.parameters, sign * float(size.mean()))
    up = sign * calibration.reference / size[:, np.newaxis]
    # A drift ends with its session: one position more would say nothing of it.
    of_session = np.isin([str(term) for _, term in model.keys], model.of_session)
    known = model.beliefs + np.where(of_session, 1.0 / calibration.u**2, 0.0)
    present = np.asarray(information_of(setting, up).sum(axis=0) + np.diag(known))
    ratio = calibration.u**2 / _variances(present)
    covered = np.empty(len(ratio))
    for part in setting.blocks:
        # gravity adds nothing to a bias: the least ratio is that of the noise alone
        covered[part] = ratio[part].min()
    if calibration.budget is None and order_in_time(readings) is not None:
        # what slow noise adds to a bias falls with more readings, as noise does
        biases = [str(term) == "1" for _, term in model.keys]
        covered[biases] = ratio[biases]
    return setting, present, covered


def information_of(setting: Setting, up: Array) -> Array:
    """Return I(u) of each position over all parameters, (n, p, p)."""
    p = len(setting.model.keys)
    pieces = np.zeros((len(up), p, p))
    for part, Z in zip(setting.blocks, setting.rows(up), strict=True):
        pieces[:, part, part] = Z.transpose(0, 2, 1) @ Z
    return pieces


def _variances(information: Array) -> Array:
    """Return the variances (…, p) of parameters, which information (…, p, p) has digits of."""
    try:
        variances = np.diagonal(np.linalg.inv(information), axis1=-2, axis2=-1)
    except np.linalg.LinAlgError:
        raise MultiposError(_OPEN) from None
    if not (variances > 0.0).all():  # a position tells so much more that no digit of others is left
        raise MultiposError(_OPEN)
    return np.asarray(variances)


def _mean_fall(then: Array, before: Array) -> Array:
    return np.asarray(1.0 - np.exp(np.log(then / before).mean(axis=1)))


def _ahead(
    present: Array, pieces: Array, scale: float, fixed: float, index: int, target: float
) -> list[int] | None:
    """Return the candidates to take until u is at most the target, or None beyond reach."""
    path: list[int] = []
    while len(path) < _MOST:
        now = float(_variances(present)[index])
        if math.sqrt(now * scale + fixed) <= target:
            return path
        then = _variances(present + pieces)[:, index]
        best = int(np.round(then / then.min(), 9).argmin())  # the first of equal ones
        path.append(best)
        present = present + pieces[best]
    return None


def worth_sentence(found: Worth, towards: str = "up") -> str:
    """Return the best next position, and what it gains."""
    best = found.candidates[0]
    up = ", ".join(f"{value + 0.0:.3g}" for value in best.up)
    what = found.parameter or "all parameters"
    text = f"Best next position: {towards} ({up}), u of {what} falls by {100.0 * best.fall:.2g} %"
    if found.target is None:
        return f"{text}."
    if found.path is None:
        return f"{text}; the target of {number(found.target)} is out of reach."
    return f"{text}; {found.further_positions} more positions reach {number(found.target)}."
