"""Parameters as functions of temperature: bias, scale factors and cross terms with their bands.

In a model with temperature terms the bias of an output is b_1 + b_T T + b_TT T² + …, and its scale
factor b_x + b_Tx T + …: sums of parameters with weights that T sets. With w(T) those weights and C
the covariance of the parameters,

    value = w' p,    u² = w' C w,    U = k u,    W = u sqrt(m F_{1−α}(m, ν)).               (1)

U holds at one temperature, with the stated confidence; W, for m parameters in the sum, holds at all
temperatures at once (Scheffé), which is what a drawn band is read as. The parameters themselves
are the values at temperature 0.

Sources: H. Scheffé, The Analysis of Variance, Wiley 1959, section 3.5.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from multipos.errors import UsageError
from multipos.numerics.arrays import Array
from multipos.numerics.quantiles import coverage_factor, f_quantile
from multipos.numerics.terms import COMPONENTS, CONSTANT, linear_term
from multipos.results import Drawn, Result, Tabular, require
from multipos.sensor.calibration import Calibration
from multipos.sensor.model import parameter_name

_POINTS = 101


@dataclass(frozen=True, eq=False)
class Curve(Result, Drawn, Tabular):
    """One parameter over temperature.

    Attributes
    ----------
    output, name, unit : str
        As of a parameter: `bias_ax`, `scale_ax`, `cross_ax_y`.
    temperature : (n,) array
    value, u, U, band : (n,) arrays
        U at one temperature, band at all of them together, eq. (1).
    """

    output: str
    name: str
    unit: str
    temperature: Array
    value: Array
    u: Array
    U: Array
    band: Array

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
    T = np.array(temperature, dtype=np.float64, ndmin=1)
    fixed = {name: float(np.mean(seen[name])) for name in model.environment} | dict(others or {})
    weights = np.array([model.linear_map({**fixed, column: float(t)}) for t in T])  # (n, M, 4, p)
    curves = []
    for i, (output, axis) in enumerate(zip(model.outputs, model.axes, strict=True)):
        for place, term in enumerate((CONSTANT, *map(linear_term, COMPONENTS))):
            w = weights[:, i, place]
            if not w.any():
                continue
            name = parameter_name(output, axis, term)
            curves.append(_curve(calibration, output, name, place, T, w))
    return tuple(curves)


def _curve(
    calibration: Calibration, output: str, name: str, place: int, T: Array, w: Array
) -> Curve:
    used = np.flatnonzero(w.any(axis=0))
    C = calibration.covariance[np.ix_(used, used)]
    u = np.sqrt(np.einsum("ni,ij,nj->n", w[:, used], C, w[:, used]))
    dof = float(calibration.parameter_dof[used].min())
    m = len(used)
    unit = calibration.model.unit
    per_g = "1" if unit == "g" else f"{unit}/g"
    return Curve(
        output=output,
        name=name,
        unit=per_g if place else unit,
        temperature=T,
        value=w @ calibration.parameters,
        u=u,
        U=coverage_factor(calibration.confidence, dof) * u,
        band=np.sqrt(m * f_quantile(calibration.confidence, m, dof)) * u,
    )
