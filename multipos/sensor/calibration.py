"""Calibration: the one result that every estimator returns.

- `parameter_rows` is its table of parameters.
- `force_residuals` are its residuals as forces; `hidden_turn` is the part of errors that the mean
  orientation error explains.
- `has_nominal` tells whether a nominal conversion is known; `nominal_error` and `nominal_errors`
  are the errors before the calibration, `rms_before` their root mean square.

A calibration carries the model, the parameters with their covariance and degrees of freedom,
the readings and the reference they came from, and how they were found, so that everything said
of it can be derived again. It is complete when it is made and never changes.

An expanded uncertainty is ``U = k u`` with k from Student's t at the parameter's effective
degrees of freedom (JCGM 100, 6.2 and annex G), at the coverage probability `confidence`.
"""

import math
from collections.abc import Mapping
from dataclasses import field as declared
from dataclasses import replace
from functools import cached_property
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike

from multipos.errors import MultiposError
from multipos.files import numbers
from multipos.files.records import (
    ANY_NUMBER,
    NOT_NEGATIVE,
    VARIANCES,
    Listed,
    Maybe,
    Numbers,
    Share,
    Text,
)
from multipos.files.schema import NOWHERE, OPTIONAL, As, Saved, Stored, schema_of
from multipos.finding import Findings
from multipos.numerics.arrays import COMPONENTS, LARGEST, SMALLEST, Array, Environment, as_numbers
from multipos.numerics.quantiles import chi2_quantile, coverage_factor
from multipos.numerics.rotations import align, directions, rotation_vector
from multipos.numerics.terms import linear_term
from multipos.positions.attitudes import Convention
from multipos.positions.readings import Readings, diagonal
from multipos.results import Drawn, data_frame, frozen
from multipos.sensor import derived, inverse
from multipos.sensor.calibration_keys import OF_PARTS
from multipos.sensor.fit_diagnostics import Diagnostics, linearity
from multipos.sensor.found import (
    BY_POSITION,
    DOF_OR_NONE,
    Chosen,
    Estimator,
    Excluded,
    FoundOrientations,
    OrientationSpread,
    Parameter,
    StatedBudget,
    Status,
    VarianceComponents,
    add_scatter,
)
from multipos.sensor.gravity import Field
from multipos.sensor.model import Model, paper_symbol
from multipos.sensor.nominal import Nominal, nominal_force, read_nominal
from multipos.units import MICRO_G

_PER_G = 1e6  # readings in these units of 1 g are µg times MICRO_G
_SHOWN = 6  # rows set aside that a sentence names


_TABLE = Numbers(2)
_FACINGS = tuple(f"{sign}{axis}" for sign in ("", "-") for axis in COMPONENTS)


def _divisible(sd: float) -> float:
    """Return a standard deviation, 0 where it is too small to divide by."""
    return 0.0 if sd < SMALLEST else sd


_SD = As(Maybe(NOT_NEGATIVE, math.nan), _divisible)
_CROSS_CHECK = Stored("cross_check.closed_form_max_difference", optional=True)


@frozen
class Calibration(Saved, Drawn):
    """Fitted parameters of one accelerometer, with everything needed to derive them again.

    Attributes
    ----------
    model : Model
    parameters : (p,) array
        In the order of `names`.
    covariance : (p, p) array
    parameter_dof : (p,) array
        Effective degrees of freedom of each parameter; inf when its noise is known beforehand.
    dof : (M,) array
        Degrees of freedom of each output's residual variance; inf when the noise is known.
    residuals : (n, M) array
        Reading minus model, in reading units.
    residual_sd : (M,) array
        Standard deviation of a reading as the residuals show it; NaN without degrees of freedom.
    reference : (n, 3) array [g]
        As used: specific force or gravity, by the convention; estimated where it was unknown.
    readings : Readings
    convention : str
        'specific-force' (the axis that points up reads +1) or 'gravity' (the one that points down).
    estimator : Estimator
    criterion : str
    confidence : float
    diagnostics : Diagnostics
    cross_check : float or None
        Largest difference of the closed form from least squares, relative to the largest reading.
    status : Status
    created, version : str
        Time (ISO 8601, UTC) and the version of multipos.
    variance_components, orientations : VarianceComponents, FoundOrientations, or None
        What was found of the noise and of the positions, where either was to be found.
    robust_weight : (n,) or (n, M) array, or None
        How much each position counts under a robust loss, 0 where it was set aside; of each output
        where these were fitted alone.
    selection : mapping of output to Chosen, or None
        How terms were chosen stepwise.
    budget : StatedBudget or None
        What the covariance follows from beside the readings.
    nominal : Nominal or None
        The conversion before the calibration, where it was stated.
    facing : tuple of M str, or None
        What was said of the axis and sense of each output, as x or -y; None where nothing was.
    excluded : tuple of Excluded
        Rows that were set aside, and are not among the readings.

    Examples
    --------
    >>> import multipos as mp
    >>> cal = mp.demo().calibration
    >>> cal.names[:5]
    ('bias_ax', 'scale_ax', 'cross_ax_y', 'cross_ax_z', 'quad_ax')
    >>> p = cal["ax", "x^2"]
    >>> print(f"{1e3 * p.value:.2f} mg/g^2, u = {1e3 * p.u:.2f}, dof {p.dof:g}")
    0.79 mg/g^2, u = 0.91, dof 1
    >>> cal["quad_ax"] == p
    True
    >>> cal.compensate([[0.5, 0.0, 0.0]])[:, 0].round(3)
    array([0.502])
    """

    schema = "multipos/calibration/1"
    called = "calibration"
    again = "fit again"
    _also = OF_PARTS

    version: Annotated[str, Stored("multipos_version")]
    created: str = declared(compare=False)
    convention: Convention
    estimator: Estimator
    criterion: str
    confidence: Share
    status: Status
    model: Annotated[Model, NOWHERE]
    parameters: Annotated[Array, NOWHERE]
    parameter_dof: Annotated[Array, NOWHERE]
    covariance: Annotated[Array, VARIANCES]
    residuals: Annotated[Array, _TABLE]
    residual_sd: Annotated[Array, _SD, Stored(by="outputs")]
    dof: Annotated[Array, DOF_OR_NONE, Stored(by="outputs")]
    reference: Annotated[Array, Numbers(2, low=-LARGEST, high=LARGEST)]
    readings: Annotated[Readings, NOWHERE]
    diagnostics: Diagnostics
    cross_check: Annotated[float | None, ANY_NUMBER, _CROSS_CHECK] = None
    robust_weight: Annotated[Array | None, BY_POSITION, OPTIONAL] = None
    variance_components: Annotated[VarianceComponents | None, OPTIONAL] = None
    facing: Annotated[tuple[str, ...] | None, Listed(Text(_FACINGS)), OPTIONAL] = None
    selection: Annotated[Mapping[str, Chosen] | None, OPTIONAL] = None
    nominal: Annotated[Nominal | None, As(schema_of(Nominal), read_nominal), OPTIONAL] = None
    excluded: Annotated[tuple[Excluded, ...], OPTIONAL] = ()
    budget: Annotated[StatedBudget | None, OPTIONAL] = None
    orientations: Annotated[FoundOrientations | None, Stored(flat=True)] = None

    def __getitem__(self, key: str | tuple[str, str]) -> Parameter:
        """Return a parameter by (output, term) or by name: ``cal["ax", "x"]``, ``cal["scale_ax"]``.

        Raises
        ------
        KeyError
            The model has no such parameter; the message offers a name that is like it.
        """
        place = self.model.named(key) if isinstance(key, str) else self.model.index(*key)
        return self._parameter(place)

    @property
    def field(self) -> Field:
        """What the sensor senses: gravity, or a magnetic field, and its size where it is known."""
        return self.model.field

    @property
    def gravity(self) -> Field | None:
        """The field where its size is stated; None: one g is the local gravity, or size one."""
        return None if self.field.size is None else self.field

    @property
    def names(self) -> tuple[str, ...]:
        """Parameter names, in the order of `parameters`."""
        return self.model.names

    @property
    def entries(self) -> tuple[Parameter, ...]:
        """Every parameter with its uncertainty, in the order of `names`."""
        return tuple(self._parameter(index) for index in range(len(self.parameters)))

    @property
    def sign(self) -> float:
        """+1 where the axis that points up reads +1, −1 under 'gravity'."""
        return -1.0 if self.convention == "gravity" else 1.0

    @property
    def dof_of_outputs(self) -> Array:
        """Degrees of freedom (p,) of the output of each parameter; of all, for what they share."""
        return self.model.per_parameter(self.dof, self.dof.sum())

    @property
    def findings(self) -> Findings:
        """What was found about the fit, the most serious first."""
        return self.diagnostics.findings

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs."""
        return self.model.outputs

    @cached_property
    def noise(self) -> Array | None:
        """What the readings were weighed by, where they state their uncertainty, else None.

        Variances (n M,), output running fastest, or the covariance (n M, n M) of readings that are
        not independent: what is stated, and the scatter from rest to rest beside it.
        """
        return add_scatter(self.readings.noise, self.variance_components, self.outputs)

    @property
    def weighed(self) -> bool:
        """Whether `noise` is all the scatter there is, so that residuals need not scale it."""
        found = self.variance_components
        scatter = found is not None and found.rest_to_rest is not None
        return self.noise is not None and (scatter or bool(np.isinf(self.dof).all()))

    @property
    def orientation_spread(self) -> OrientationSpread | None:
        """How far positions were off, where it was estimated."""
        found = self.variance_components
        return None if found is None else found.orientation_sd_deg

    @property
    def by_own_axes(self) -> bool:
        """Whether few positions tell neither noise nor orientation errors, but both together."""
        found, sd = self.orientations, self.readings.orientation_sd
        if self.estimator is not Estimator.UNCERTAIN or found is None or sd is None:
            return False
        return bool((sd > 0.0).all()) and not np.any(found.orientation_error_deg)

    @property
    def effective_rows(self) -> Mapping[str, float] | None:
        """Effective number of rows of each output; None where rows are independent."""
        found = self.variance_components
        return None if found is None else found.effective_rows

    @cached_property
    def sd_of_readings(self) -> Array:
        """Standard deviation of every reading (n, M): by `noise`, else as the residuals show it."""
        noise = self.noise
        if noise is None or not self.weighed:
            return np.broadcast_to(self.residual_sd, self.residuals.shape)
        return np.asarray(np.sqrt(diagonal(noise)).reshape(self.residuals.shape))

    @property
    def _reference_environment(self) -> dict[str, float] | None:
        return dict.fromkeys(self.model.environment, 0.0) or None

    @property
    def set_aside(self) -> str:
        """Which rows were set aside and how far off they are, as a sentence; empty for none."""
        if not self.excluded:
            return ""
        off = ", ".join(f"{each.label} ({self._shown(each)})" for each in self.excluded[:_SHOWN])
        if len(self.excluded) > _SHOWN:
            off += f" and {len(self.excluded) - _SHOWN} more"
        rows = "positions" if self.readings.samples is None else "rests"
        count = len(self.excluded)
        return f"{count} of {count + len(self.readings)} {rows} set aside: {off}"

    def _shown(self, each: Excluded) -> str:
        return self.field.shown(each.off, ".3g", "mg")

    @cached_property
    def relative(self) -> "Calibration":
        """The calibration in the field of size one, whatever its size; of gravity itself.

        A coefficient of degree d in the field is d powers of its size larger.
        """
        field = self.field
        if field.size is None or field.relative is field or hasattr(self.model, "functions"):
            return self
        power = np.asarray(field.size ** self.model.force_degrees.astype(np.float64))
        return replace(
            self,
            model=replace(self.model, field=field.relative),
            parameters=self.parameters * power,
            covariance=self.covariance * np.outer(power, power),
            reference=self.reference / field.size,
        )

    @property
    def budget_tables(self) -> Mapping[str, Mapping[str, Any]]:
        """The tables of the budget that it was made with, empty without one."""
        return {} if self.budget is None else self.budget.tables

    @cached_property
    def u(self) -> Array:
        """Standard uncertainties (p,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @cached_property
    def k(self) -> Array:
        """Coverage factors (p,) at `confidence`."""
        dofs = self.parameter_dof.tolist()
        factors = {dof: coverage_factor(self.confidence, dof) for dof in set(dofs)}
        return np.array([factors[dof] for dof in dofs])

    @property
    def relative_residuals(self) -> Array:
        """The largest residual of each position (n,), in standard deviations of its output."""
        estimated = np.isfinite(self.residual_sd) & (self.residual_sd > 0.0)
        sd = np.where(estimated, self.residual_sd, 1.0)
        return np.asarray(np.abs(self.residuals / sd).max(axis=1))

    @property
    def U(self) -> Array:
        """Expanded uncertainties (p,), U = k u."""
        return self.k * self.u

    @cached_property
    def correlation(self) -> Array:
        """Correlation matrix (p, p); NaN where an uncertainty is zero."""
        scale = np.where(self.u > 0.0, self.u, np.nan)
        return np.asarray(self.covariance / np.outer(scale, scale))

    @cached_property
    def rms(self) -> float:
        """Root mean square of what is left after compensation [g].

        Of ``|f| − |reference|`` for unknown orientation, of the vector f − reference otherwise;
        NaN where the parameters give no force.
        """
        try:
            # What no output senses is known here, so that it does not pass for an error.
            force = inverse.invert(
                self.model,
                self.parameters,
                self.readings.values,
                self.readings.environment,
                unseen=self.reference,
            )
        except MultiposError:  # an output does not respond
            return math.nan
        off = self.estimator.off(force, self.reference[:, list(self.model.sensed_axes)])
        return math.sqrt(float(off @ off) / len(off))

    @cached_property
    def sensitivity(self) -> Array:
        """Response of each output to each component (M, 3), about zero force, in reading units."""
        environment = {name: [mean] for name, mean in self.mean_environment.items()}
        jacobian = self.model.force_jacobian(self.parameters, np.zeros((1, 3)), environment)
        return np.asarray(jacobian[0])

    @cached_property
    def linearity(self) -> dict[str, dict[str, float]]:
        """Linearity of each output with and without the model, in percent of the span."""
        return linearity(
            self.model,
            self.reference,
            self.readings.values,
            self.residuals,
            reach=None if self.readings.forced.any() else self.field.full_scale,
        )

    @cached_property
    def intrinsic(self) -> dict[str, dict[str, derived.Value]] | None:
        """Sensitivities, offsets [g], angles between input axes and mounting, of a triad."""
        return derived.intrinsic(
            self.model, self.parameters, self.covariance, self.mean_environment
        )

    @cached_property
    def installation_deg(self) -> dict[str, derived.Value]:
        """How far output i leans to axis j, θ_ij = atan2(M_ij, M_ii), in degrees, with u and U."""
        found = derived.installation_deg(
            self.model, self.parameters, self.covariance, self.mean_environment
        )
        own = dict(zip(self.model.axes, self.dof.tolist(), strict=True))
        for pair, angle in found.items():
            angle["U"] = coverage_factor(self.confidence, own[pair[0]]) * angle["u"]
        return found

    def predict(self, reference: ArrayLike, environment: Environment | None = None) -> Array:
        """Return the readings (n, M) that the model expects at a reference (n, 3) [g]."""
        force = np.atleast_2d(as_numbers(reference, "`reference`"))
        columns = _columns(environment)
        return self.model.predict(self.parameters, force, columns)

    def compensate(self, raw: ArrayLike, environment: Environment | None = None) -> Array:
        """Return the force that explains raw readings.

        Parameters
        ----------
        raw : (n, M) or (M,) array, or (n,) for a single output
            In the unit of the readings. A data frame's outputs are taken by name, where it has
            these names.
        environment : mapping of str to (n,) array, optional
            Columns that the model uses beside the components, such as temperature.

        Returns
        -------
        (n, K) array [g]
            On the K axes that the sensor has, in the calibration's convention; NaN where no
            force explains the reading.
        """
        if set(self.outputs) <= set(getattr(raw, "columns", ())):
            raw = raw[list(self.outputs)]  # type: ignore[index, call-overload]
        values = as_numbers(raw, "`raw`")
        if values.ndim < 2:  # one reading of all outputs, or many of the only one
            values = values.reshape(-1, 1) if len(self.outputs) == 1 else values[None]
        if values.ndim != 2 or values.shape[1] != len(self.outputs):
            raise MultiposError(
                f"`raw` must have shape (n, {len(self.outputs)}), got {np.shape(raw)}; "
                "give one row per reading."
            )
        columns = {
            name: np.broadcast_to(column, len(values))
            for name, column in _columns(environment).items()
            if name in self.model.environment
        }
        self.model.variables(np.zeros((0, 3)), columns)
        return inverse.invert(self.model, self.parameters, values, columns)

    @property
    def of_sensor(self) -> "Calibration":
        """The calibration without the drift of its session, which is no part of the sensor."""
        if self.model.drift_per is None:
            return self
        model = self.model.without_drift()
        kept = np.isin(self.names, model.names)
        return replace(
            self,
            model=model,
            parameters=self.parameters[kept],
            covariance=self.covariance[np.ix_(kept, kept)],
            parameter_dof=self.parameter_dof[kept],
        )

    def __str__(self) -> str:
        return numbers.table(*parameter_rows(self), left=3)

    def to_pandas(self) -> Any:
        """Return the parameters as a data frame: output, term, name, value, u, dof, k, U, unit.

        Raises
        ------
        MultiposError
            pandas is not installed.
        """
        columns = ("output", "term", "name", "value", "u", "dof", "k", "U", "unit")
        return data_frame({key: [getattr(p, key) for p in self.entries] for key in columns})

    def to_ufloats(self) -> dict[str, Any]:
        """Return the parameters by name as numbers of the package uncertainties, correlated.

        Raises
        ------
        MultiposError
            uncertainties is not installed.
        """
        try:
            from uncertainties import correlated_values
        except ImportError:
            raise MultiposError(
                "`to_ufloats` needs the package uncertainties, which is not installed; install it, "
                "or use `parameters` and `covariance`."
            ) from None
        values = correlated_values(self.parameters.tolist(), self.covariance.tolist())
        return dict(zip(self.names, values, strict=True))

    @cached_property
    def mean_environment(self) -> dict[str, float]:
        """The mean of each column of the model over the readings."""
        return {
            name: float(np.mean(self.readings.environment[name])) for name in self.model.environment
        }

    def _parameter(self, index: int) -> Parameter:
        output, term = self.model.keys[index]
        value, u, k = float(self.parameters[index]), float(self.u[index]), float(self.k[index])
        return Parameter(
            output=output,
            term=str(term),
            name=self.names[index],
            value=value,
            u=u,
            dof=float(self.parameter_dof[index]),
            k=k,
            U=k * u,
            unit=self.model.units[index],
            label=self.model.label(index),
            symbol=paper_symbol(self.model, index),
        )


def _columns(environment: Environment | None) -> dict[str, Array]:
    given = environment or {}
    return {name: as_numbers(given[name], f"`environment['{name}']`") for name in given}


def parameter_rows(calibration: Calibration) -> tuple[list[str], list[list[str]]]:
    """Return header and rows of the table of parameters; the paper's symbols where it has them."""
    symbols = paper_symbol(calibration.model, 0) is not None
    header = ["parameter", *(["symbol"] if symbols else []), "unit", "value(u)", "U", "k", "dof"]
    rows = []
    largest = np.abs(calibration.readings.values).max(axis=0).tolist()
    sizes = dict(zip(calibration.outputs, largest, strict=True))
    units = numbers.common_units(
        (p.unit, numbers.most_of(p.value, p.U)) for p in calibration.entries
    )
    for p in calibration.entries:
        size = sizes.get(p.output, max(largest))
        u = numbers.beyond_rounding(p.u, size)
        value = p.value if u else numbers.beyond_rounding(p.value, size)
        factor, unit = units[p.unit]
        rows.append(
            [
                p.name,
                *([p.symbol or ""] if symbols else []),
                unit,
                numbers.uncertain(factor * value, factor * u),
                numbers.beside(factor * value, factor * u, factor * p.U)[1],
                numbers.number(p.k),
                numbers.number(p.dof),
            ]
        )
    return header, rows


def force_residuals(calibration: Calibration) -> tuple[Array, Array]:
    """Return how far each compensated reading is from its reference (n,), and one's u (n,) [g].

    Of unknown orientations it is the difference of the sizes.
    """
    readings, reference = calibration.readings, calibration.reference
    force = calibration.compensate(readings.values, readings.environment)
    if calibration.model.gauge is not None:
        off = np.linalg.norm(force, axis=1) - np.linalg.norm(reference, axis=1)
    else:
        off = np.linalg.norm(force - reference[:, : force.shape[1]], axis=1)
    J = calibration.model.force_jacobian(calibration.parameters, reference, readings.environment)
    scale = np.linalg.norm(J, axis=2)
    with np.errstate(divide="ignore"):  # an output of no slope tells nothing
        u = np.sqrt(np.mean((calibration.sd_of_readings / scale) ** 2, axis=1))
    return np.asarray(off), np.asarray(u)


def nominal_error(calibration: Calibration) -> Array:
    """Return the size (n,) [g] of the error by the nominal conversion of the calibration.

    Where it has none, by one nominal scale factor without bias: 1 for readings in g, else the mean
    own-axis one. Of an unknown orientation it is what lies along up: across, the error is against
    an orientation that the fit itself chose.
    """
    if calibration.estimator is Estimator.UNKNOWN:
        up = directions(calibration.reference)
        return np.asarray(np.abs(np.einsum("ni,ni->n", nominal_errors(calibration), up)))
    off, errors = _nominal_off(calibration), nominal_errors(calibration)
    turn = hidden_turn(calibration, errors)
    return np.asarray(np.linalg.norm(off if turn is None else errors - turn, axis=1))


def rms_before(calibration: Calibration) -> float | None:
    """Return the rms of that error [g] by the stated conversion, or by the unit where it is one.

    None where neither says what a reading is in g.
    """
    if calibration.field.unit != "g" or not has_nominal(calibration):
        return None
    if calibration.nominal is None:
        nominal = Nominal(0.0, _PER_G / MICRO_G[calibration.model.unit])
        calibration = replace(calibration, nominal=nominal)
    error = nominal_error(calibration)
    return math.sqrt(float(error @ error) / len(error))


def has_nominal(calibration: Calibration) -> bool:
    """Tell whether a conversion or the unit says what a reading was before it was compensated.

    Of volts about a zero of 2.5 V neither does: an error before would be that zero.
    """
    c = calibration
    return c.field.unit != "g" or c.nominal is not None or c.model.unit in MICRO_G


def hidden_turn(calibration: Calibration, errors: Array) -> Array | None:
    """Return the part of errors (n, 3) [g] on x, y, z that the mean orientation error explains.

    Where positions are uncertain, the full model is turned with their mean orientation error: by
    1.5 σ²/n about each axis. A common rotation of the errors that is no larger, at 99 %, is the
    mean error of the hand and no misalignment that is known. None where there is none such.
    """
    if calibration.estimator is not Estimator.UNCERTAIN:
        return None
    sd = calibration.readings.orientation_sd
    if sd is None:
        return None
    if sorted(calibration.model.axes) != list(COMPONENTS) or not np.isfinite(sd).all():
        return None
    force = calibration.reference
    rotation = align(force, force + errors)
    turn = rotation_vector(rotation)
    variance = 1.5 * float(np.mean(sd**2)) / len(sd)
    if float(turn @ turn) > chi2_quantile(0.99, float(len(turn))) * variance:
        return None
    return np.asarray(force @ rotation.T - force)


def nominal_errors(calibration: Calibration) -> Array:
    """Return that error (n, 3) [g] by case axis; the mean of the outputs that sense an axis."""
    off, axes = _nominal_off(calibration), calibration.model.axes
    if calibration.nominal is not None:
        axes = tuple(axis for axis in COMPONENTS if axis in axes)
    error = np.zeros(calibration.reference.shape)
    for i, axis in enumerate(COMPONENTS):
        columns = [place for place, one in enumerate(axes) if one == axis]
        if columns:
            error[:, i] = off[:, columns].mean(axis=1)
    return error


def _nominal_off(c: Calibration) -> Array:
    """Return the nominal error of every output, or of every axis that a nominal conversion has."""
    if c.nominal is not None:
        sensed = [i for i, axis in enumerate(COMPONENTS) if axis in c.model.axes]
        return np.asarray(
            nominal_force(c.model, c.readings.values, c.nominal) - c.reference[:, sensed]
        )
    own = [
        c.parameters[c.model.keys.index((output, linear_term(axis)))]
        for output, axis in zip(c.outputs, c.model.axes, strict=True)
        if (output, linear_term(axis)) in c.model.keys
    ]
    scale = 1.0 if c.model.unit == c.field.unit or not own else float(np.mean(own))
    axes = [COMPONENTS.index(axis) for axis in c.model.axes]
    return np.asarray(c.readings.values / scale - c.reference[:, axes])
