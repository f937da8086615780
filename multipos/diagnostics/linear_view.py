"""The readings as a linear sensor at the listed positions would have given them.

Gross errors are looked for in the plainest picture there is, whatever model was fitted and however
uncertain the positions were: least squares of

    y_k = b + K u_k,                                                                        (1)

with u the reference as listed [g], y (M,) the readings, b and K (M, 3), and terms of other
columns beside them where the model has any. What no linear sensor explains is measured by

    rho = sqrt(mean over outputs of  s_i² / |K_i|²),                                        (2)

s_i the residual standard deviation of output i and |K_i| its response to one g: the residual
as a share of the signal. Misplacement by two degrees makes it .035, noise alone about 1.
Sensor models of second and third order change it by their own size, a percent or so.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from multipos.numerics.arrays import Array
from multipos.numerics.terms import COMPONENTS
from multipos.sensor.calibration import Calibration

_RANK = 1e-9  # of the largest singular value: columns of a roll that stays in one plane


@dataclass(frozen=True, eq=False)
class View:
    """Readings under eq. (1).

    Attributes
    ----------
    even, odd : (n, a), (n, b) arrays
        Columns that keep and that change their sign with the reference; the first three of `odd`
        are the reference [g].
    values : (n, M) array
    """

    even: Array
    odd: Array
    values: Array

    @cached_property
    def _decomposed(self) -> tuple[Array, Array, Array]:
        design = np.hstack([self.even, self.odd])
        left, size, right = np.linalg.svd(design, full_matrices=False)
        kept = size > _RANK * size[0]
        return left[:, kept], size[kept], right[kept]

    @property
    def basis(self) -> Array:
        """An orthonormal basis (n, r) of what eq. (1) can give."""
        return self._decomposed[0]

    @cached_property
    def residuals(self) -> Array:
        """What eq. (1) leaves (n, M)."""
        basis = self.basis
        return np.asarray(self.values - basis @ (basis.T @ self.values))

    @cached_property
    def sensitivity(self) -> Array:
        """K (M, 3); zero along what the positions do not show."""
        left, size, right = self._decomposed
        coefficients = right.T @ ((left.T @ self.values) / size[:, None])
        first = self.even.shape[1]
        return np.asarray(coefficients[first : first + 3].T)

    @property
    def dof(self) -> int:
        """Degrees of freedom of one output."""
        return len(self.values) - len(self._decomposed[1])

    @cached_property
    def response(self) -> Array:
        """|K_i| (M,), never quite zero."""
        least_norm = 1e-12 * float(np.abs(self.values).max()) + np.finfo(float).tiny
        return np.asarray(np.maximum(np.linalg.norm(self.sensitivity, axis=1), least_norm))

    @cached_property
    def misfit(self) -> float:
        """rho of eq. (2); NaN without degrees of freedom."""
        if self.dof <= 0:
            return float("nan")
        squares = np.sum((self.residuals / self.response) ** 2, axis=0)
        return float(np.sqrt(squares.mean() / self.dof))

    @cached_property
    def misfit_but_one(self) -> float:
        """The smallest rho that leaving out one position gives; one outlier does not move it."""
        if self.dof <= 1:
            return self.misfit
        left = 1.0 - np.sum(self.basis**2, axis=1)
        scaled = self.residuals / self.response
        explained = np.sum(scaled**2, axis=1) / np.maximum(left, _RANK)
        rest = np.sum(scaled**2) - float(explained[left > _RANK].max(initial=0.0))
        return float(np.sqrt(max(rest, 0.0) / self.values.shape[1] / (self.dof - 1)))

    @cached_property
    def left_over(self) -> float:
        """Root mean square of the residuals as force [g]; NaN where K gives none."""
        if np.linalg.matrix_rank(self.sensitivity / self.response[:, None], tol=1e-3) < 1:
            return float("nan")
        force = self.residuals @ np.linalg.pinv(self.sensitivity, rcond=1e-3).T
        return float(np.sqrt(np.mean(np.sum(force**2, axis=1))))

    def with_values(self, values: Array) -> "View":
        """Return other readings at the same positions."""
        other = View(self.even, self.odd, values)
        other.__dict__["_decomposed"] = self._decomposed  # of the positions alone
        return other

    def turned(self, rows: NDArray[np.intp]) -> "View":
        """Return the same readings with the reference turned over in some rows."""
        sign = np.ones((len(self.odd), 1))
        sign[rows] = -1.0
        return View(self.even, sign * self.odd, self.values)

    def at(self, reference: Array) -> "View":
        """Return the same readings at other references (n, 3) [g]; other columns are left out."""
        return View(self.even[:, :1], reference, self.values)


def look(c: Calibration) -> View | None:
    """Return the linear view of a calibration; None where it does not know its positions."""
    reference = listed_reference(c)
    if reference is None:
        return None
    even, odd = [np.ones(len(reference))], list(reference.T)
    for term in c.model.basis_terms if c.model.environment else ():
        if not term.environment or term.force_degree > 1:
            continue
        variables = c.model.variables(reference, c.readings.environment)
        column = np.broadcast_to(term.evaluate(variables), len(reference))
        if term.along is None:
            even.append(column - column.mean())
        else:  # K shall be the response at the temperature of the day, not at zero
            own = reference[:, COMPONENTS.index(term.along)]
            square = max(float(own @ own), np.finfo(float).tiny)
            odd.append(column - float(column @ own) / square * own)
    return View(np.column_stack(even), np.column_stack(odd), c.readings.values)


def listed_reference(c: Calibration) -> Array | None:
    """Return the reference as listed (n, 3) [g]; None where a position is not listed."""
    if c.estimator.exact:
        return c.reference
    up, sd = c.readings.up, c.readings.orientation_sd
    if up is None or np.isnan(up).any() or c.readings.group is not None:
        return None
    if sd is not None and not np.isfinite(sd).all():
        return None
    size = np.linalg.norm(c.reference, axis=1, keepdims=True)
    return np.asarray(c.sign * size * up)
