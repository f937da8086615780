"""Parameters as functions of temperature: bias, scale factors and cross terms with their bands.

- `over_temperature` returns a `Curve` of each.
- `soaks_of`, `find_soaks` and `runs_of` say which rows share a zero, `zeros_in` which of them a fit
  has, `has_zeros` whether any may; `zeros_of_soaks` returns what
  these `Zeros` do to a run or to single readings.

In a model with temperature terms the bias of an output is b_1 + b_T T + b_TT T² + …, and its scale
factor b_x + b_Tx T + …: sums of parameters with weights that T sets. With w(T) those weights and C
the covariance of the parameters,

    value = w' p,    u² = w' C w,    U = k u,    W = u sqrt(m F_{1−α}(m, ν)).               (1)

U holds at one temperature, with the stated confidence; W, for m parameters in the sum, holds at all
temperatures at once (Scheffé), which is what a drawn band is read as. The parameters themselves
are the values at temperature 0.

**Soaks.** A soak is a stay at one temperature in which several positions are read. Its rows share
what the zero did there beside the model (hysteresis, a chamber that tilts), y = X p + Z a + e,
a ~ N(0, σ_a²), Z one column a soak. With Δ what Z explains of the residuals beyond X on q degrees
of freedom, and s² what is left,

    σ_a² = (Δ − q s²)/tr Z'(I − P_X)Z                                                        (2)

if it is above zero. The covariance of the parameters has what these do to them
(`multipos.estimation.run_zeros`); the zero of a further soak, of variance σ_a² on q degrees of
freedom, is added where readings are compensated or checked. With no more soaks than the model has
terms of temperature there is no q, and `soak_sd` is not known. How the zero repeats is in U once:
σ_a is at least half of a hysteresis beyond its U, eq. (3), and of it and ``[stability]`` in the
budget, which state the same, the larger is taken.

**Runs.** Where no term takes temperature, rows of one label of a column `run` share a zero as well,
and are treated as soaks are.

**Hysteresis.** Where levels of temperature are read both when it rises and when it falls, the mean
of zero, falling less rising, over such levels, with the scatter of these differences,

    value = mean d,    u² = Σ (d − mean d)²/m(m − 1),    or 2 σ_a²/m² Σ 1 with one level.    (3)

Sources: H. Scheffé, The Analysis of Variance, Wiley 1959, section 3.5.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from multipos.errors import UsageError
from multipos.numerics.arrays import COMPONENTS, Array, Places, as_numbers
from multipos.numerics.quantiles import coverage_factor, f_quantile
from multipos.numerics.terms import CONSTANT, linear_term
from multipos.positions.headers import RUN, SOAKS, TEMPERATURE
from multipos.positions.readings import Readings
from multipos.results import Drawn, Result, Tabular, frozen, require
from multipos.sensor.calibration import Calibration
from multipos.sensor.model import Model, parameter_name

_POINTS = 101
_SOAK = 2.0  # [degC], by which neighbouring rows of one soak may differ
_FEWEST = 3  # soaks
SEEN = 0.2  # of the length of a soak's column, which must be left beyond the model's terms


@frozen
class Curve(Result, Drawn, Tabular):
    """One parameter over temperature.

    Attributes
    ----------
    output, name, unit : str
        As of a parameter: `bias_ax`, `scale_ax`, `cross_ax_y`.
    temperature : (n,) array
    value, u, U, band : (n,) arrays
        U at one temperature, band at all of them together, eq. (1).
    soak_sd : float or None
        σ_a of eq. (2), of a bias; None where the readings cannot tell.
    hysteresis : mapping or None
        value, u, U and unit of eq. (3), of a bias.
    """

    output: str
    name: str
    unit: str
    temperature: Array
    value: Array
    u: Array
    U: Array
    band: Array
    soak_sd: float | None = None
    hysteresis: Mapping[str, Any] | None = None

    def columns(self) -> dict[str, Any]:
        """Return temperature, value, u, U and band."""
        names = ("temperature", "value", "u", "U", "band")
        return {name: getattr(self, name) for name in names}


def over_temperature(
    calibration: Calibration,
    temperature: ArrayLike | None = None,
    *,
    column: str = "temperature",
    others: Mapping[str, float] | None = None,
) -> tuple[Curve, ...]:
    """Return bias, scale factors and cross terms of every output as functions of temperature.

    Parameters
    ----------
    calibration : Calibration
    temperature : (n,) array, optional
        Where to evaluate; over the readings' range if not given.
    column : str
        The column of the readings that is the temperature.
    others : mapping of str to float, optional
        Values of the model's other columns; their means if not given.

    Returns
    -------
    tuple of Curve

    Raises
    ------
    UsageError
        The model has no term with the column.

    Examples
    --------
    >>> import numpy as np
    >>> import multipos as mp
    >>> up = np.tile(mp.read_scheme("faces-6").up, (2, 1))
    >>> T = np.repeat([0.0, 40.0], 6)
    >>> values = up * (1.0 + 1e-4 * T[:, None]) + 1e-5 * np.sin(np.arange(36.0)).reshape(12, 3)
    >>> names, warm = ("ax", "ay", "az"), {"temperature": T}
    >>> readings = mp.Readings(values, outputs=names, up=up, environment=warm)
    >>> cal = mp.fit(readings, model="1 + x + y + z + temperature*own")
    >>> scale = mp.over_temperature(cal, [0.0, 20.0, 40.0])[1]
    >>> scale.name, scale.value.round(3).tolist()
    ('scale_ax', [1.0, 1.002, 1.004])
    """
    require(calibration, Calibration)
    model = calibration.model
    if column not in model.environment:
        raise UsageError(
            f"the model '{model.text}' has no term with '{column}'; its columns are "
            f"{', '.join(model.environment) or 'none'}."
        )
    seen = calibration.readings.environment
    if temperature is None:
        temperature = np.linspace(seen[column].min(), seen[column].max(), _POINTS)
    T = np.atleast_1d(as_numbers(temperature, "`temperature`"))
    fixed = calibration.mean_environment | dict(others or {})
    weights = np.array([model.linear_map({**fixed, column: float(t)}) for t in T])  # (n, M, 4, p)
    curves = []
    for i, (output, axis) in enumerate(zip(model.outputs, model.axes, strict=True)):
        soaks = _soaks(calibration, i) if column == TEMPERATURE else None
        for place, term in enumerate((CONSTANT, *map(linear_term, COMPONENTS))):
            w = weights[:, i, place]
            if not w.any():
                continue
            name = parameter_name(output, axis, term)
            curves.append(_curve(calibration, output, name, place, T, w, soaks))
    return tuple(curves)


class _Soaks(NamedTuple):
    """What soaks differ by in one output, eq. (2)."""

    sd: float  # σ_a
    dof: float  # q
    within: float  # s² over that of all residuals
    hysteresis: Mapping[str, Any] | None


def _curve(
    calibration: Calibration,
    output: str,
    name: str,
    place: int,
    T: Array,
    w: Array,
    soaks: _Soaks | None,
) -> Curve:
    used = np.flatnonzero(w.any(axis=0))
    C = calibration.covariance[np.ix_(used, used)]
    own = np.einsum("ni,ij,nj->n", w[:, used], C, w[:, used])
    dof, confidence = float(calibration.parameter_dof[used].min()), calibration.confidence
    m = len(used)
    unit = calibration.model.unit
    per_g = "1" if unit == "g" else f"{unit}/g"
    k = coverage_factor(confidence, dof)
    return Curve(
        output=output,
        name=name,
        unit=per_g if place else unit,
        temperature=T,
        value=w @ calibration.parameters,
        u=np.sqrt(own),
        U=k * np.sqrt(own),
        band=np.sqrt(m * f_quantile(confidence, m, dof) * own),
        soak_sd=None if soaks is None or place else soaks.sd,
        hysteresis=None if soaks is None or place else soaks.hysteresis,
    )


def _spread(soaks: _Soaks) -> float:
    """Return the larger of what soaks differ by and half of a hysteresis that is beyond its U."""
    found = soaks.hysteresis
    if found is None or abs(found["value"]) <= found["U"]:
        return soaks.sd
    return max(soaks.sd, abs(float(found["value"])) / 2.0)


class Zeros(NamedTuple):
    """What zeros of soaks do to a run of n readings.

    Attributes
    ----------
    columns : (n, M, k) array
        One standard deviation of the zero of every soak of the run; without soaks no column.
    dof : (M,) array
        q of eq. (2), infinite without soaks.
    contained : (n, M) array
        Their variance that the residuals have brought into that of a prediction, 1 − s²/s_0² of it.
    """

    columns: Array
    dof: Array
    contained: Array


def zeros_of_soaks(c: Calibration, X: Array, run: Readings | None, estimated: Array) -> Zeros:
    """Return what zeros of soaks do to a run, or to single readings.

    Parameters
    ----------
    c : Calibration
    X : (n, M, p) array
        Derivatives of the run's readings by the parameters.
    run : Readings or None
        None of single readings, whose budget holds what ``[stability]`` states.
    estimated : (n, M) array
        The part of the noise of the run's readings that was estimated with the calibration.
    """
    parts, dof = [np.zeros((*X.shape[:2], 0))], np.full(X.shape[1], np.inf)
    contained = np.zeros(X.shape[:2])
    if not has_zeros(c):
        return Zeros(parts[0], dof, contained)
    numbers = np.zeros(len(X), dtype=np.intp)
    if run is not None:
        numbers = _zeros_in_run(c, run)
    for i, output in enumerate(c.outputs):
        soaks = _soaks(c, i)
        if soaks is None or not soaks.sd > 0.0:
            continue
        spread, stated = _spread(soaks), _stated_zero(c, output)
        own = np.zeros((*X.shape[:2], int(np.max(numbers)) + 1))
        beyond = np.sqrt(max(spread**2 - stated**2, 0.0))
        own[np.arange(len(X)), i, numbers] = beyond if run is None else spread
        parts.append(own)
        dof[i] = soaks.dof
        contained[:, i] = max(1.0 - soaks.within, 0.0) * estimated[:, i] ** 2
    return Zeros(np.concatenate(parts, axis=2), dof, contained)


def has_zeros(c: Calibration) -> bool:
    """Tell whether rows of a calibration may have shared zeros, of soaks or of runs."""
    return TEMPERATURE in c.model.environment or runs_of(c.readings, c.model) is not None


def runs_of(readings: Readings, model: Model) -> Places | None:
    """Return the run of each reading; None where there is one, or temperature makes them soaks."""
    labels = readings.environment.get(RUN)
    if labels is None or {RUN, TEMPERATURE} & {*model.environment}:
        return None
    runs = np.unique(labels, return_inverse=True)[1].astype(np.intp)
    return runs if runs.any() else None


def zeros_in(readings: Readings, model: Model) -> Places | None:
    """Return which zero each reading of a fit has, that of its run or soak; None of one zero."""
    runs = runs_of(readings, model)
    return soaks_of(readings) if runs is None and TEMPERATURE in model.environment else runs


def _zeros_in_run(c: Calibration, data: Readings) -> Places:
    """Return which zero each reading of other data has."""
    if TEMPERATURE not in c.model.environment:
        runs = runs_of(data, c.model)
        return np.zeros(len(data), dtype=np.intp) if runs is None else runs
    found = soaks_of(data)  # None: fewer than a calibration is judged by
    return _soaks_in_order(data.environment[TEMPERATURE]) if found is None else found


def _stated_zero(c: Calibration, output: str) -> float:
    """Return the standard deviation of an output's zero that ``[stability]`` states."""
    table = c.budget_tables.get("stability", {})
    scale = float(np.abs(c.sensitivity[c.outputs.index(output)]).max())
    axis = c.model.axes[c.outputs.index(output)]
    return float(np.hypot(table.get(f"u_{output}", 0.0), scale * table.get(f"u_f_{axis}", 0.0)))


def soaks_of(readings: Readings) -> Places | None:
    """Return the number of the soak of each reading; None where there are none.

    By a column that is a label, else by temperature (`find_soaks`).
    """
    for name in SOAKS:
        if name in readings.environment:
            numbers = np.unique(readings.environment[name], return_inverse=True)[1]
            return _enough(numbers.astype(np.intp))
    if TEMPERATURE not in readings.environment:
        return None
    return find_soaks(readings.environment[TEMPERATURE])


def find_soaks(temperature: Array) -> Places | None:
    """Return the number of the soak of each row, None where temperatures do not stand in levels.

    Neighbouring rows of one soak are within 2 °C; a level that is left and come back to is another
    soak, where rows stand in order.
    """
    if not np.isfinite(temperature).all() or not np.ptp(temperature) > 0.0:
        return None
    runs = _soaks_in_order(temperature)
    if runs[-1] + 1 <= len(runs) / 3.0:
        return _enough(runs)
    order = np.argsort(temperature, kind="stable")
    level = np.empty(len(order), dtype=np.intp)
    level[order] = _soaks_in_order(temperature[order])
    return _enough(level)


def _soaks_in_order(temperature: Array) -> Places:
    changes = np.abs(np.diff(temperature, prepend=temperature[:1])) > _SOAK
    return np.cumsum(changes, dtype=np.intp)


def _enough(soak: Places) -> Places | None:
    counts = np.bincount(soak)
    return soak if len(counts) >= _FEWEST and counts.min() >= 2 else None


def _soaks(c: Calibration, output: int) -> _Soaks | None:
    """Return what soaks differ by in an output; None where the readings cannot tell."""
    soak = runs_of(c.readings, c.model)
    by_run = soak is not None
    if soak is None:
        soak = soaks_of(c.readings)
    if soak is None or not c.estimator.exact or not c.model.has_terms:
        return None
    mine = list(c.model.columns[output])
    X = c.model.basis(c.reference, c.readings.environment)[:, mine]
    Z = (soak[:, None] == np.unique(soak)).astype(np.float64)
    Q = np.linalg.qr(X)[0]
    left = Z - Q @ (Q.T @ Z)
    U, d, _ = np.linalg.svd(left, full_matrices=False)
    basis = U[:, d > SEEN * np.sqrt(len(Z) / Z.shape[1])]
    q, nu = basis.shape[1], len(Z) - X.shape[1] - basis.shape[1]
    e = c.residuals[:, output]
    explained = float(np.sum((basis.T @ e) ** 2))
    within = (float(e @ e) - explained) / max(nu, 1)
    if q < 1 or nu < 1 or not within > 0.0:
        return None
    variance = max((explained - q * within) / float(np.sum((basis.T @ Z) ** 2)), 0.0)
    s_0 = float(e @ e) / (len(Z) - X.shape[1])
    sd = float(np.sqrt(variance))
    means = np.array([e[soak == s].mean() for s in np.unique(soak)])
    found = None if by_run else _hysteresis(c, soak, means, sd)
    return _Soaks(sd, float(q), within / s_0, found)


def _hysteresis(c: Calibration, soak: Places, means: Array, sd: float) -> Mapping[str, Any] | None:
    """Return eq. (3) of what soaks leave of the zero, in order; None without levels read twice."""
    warm = c.readings.environment.get(TEMPERATURE)
    if warm is None:
        return None
    at = np.array([warm[soak == s].mean() for s in np.unique(soak)])
    rising = np.concatenate([[np.diff(at)[0]], np.diff(at)]) > 0.0
    pairs = [
        means[j] - means[i]
        for i in np.flatnonzero(rising)
        for j in np.flatnonzero(~rising)
        if abs(at[i] - at[j]) <= _SOAK
    ]
    if not pairs:
        return None
    d, m = np.array(pairs), len(pairs)
    u = float(d.std(ddof=1) / np.sqrt(m)) if m > 1 else float(np.sqrt(2.0) * sd)
    k = coverage_factor(c.confidence, max(m - 1.0, 1.0))
    return {"value": float(d.mean()), "u": u, "U": k * u, "unit": c.model.unit}
