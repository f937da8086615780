"""Calibration: the one result that every estimator returns, and its file.

A calibration carries the model, the parameters with their covariance and degrees of freedom,
the readings and the reference they came from, and how they were found, so that everything said
of it can be derived again. It is complete when it is made and never changes.

An expanded uncertainty is ``U = k u`` with k from Student's t at the parameter's effective
degrees of freedom (JCGM 100, 6.2 and annex G), at the coverage probability `confidence`.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from multipos.errors import MultiposError
from multipos.files.formats import CALIBRATION
from multipos.files.numbers import number, table, uncertain
from multipos.files.records import require, require_covariance
from multipos.files.tables import read_json, to_json, write_text
from multipos.numerics.arrays import Array
from multipos.numerics.quantiles import coverage_factor
from multipos.numerics.terms import COMPONENTS
from multipos.positions.attitudes import Convention
from multipos.positions.readings import Readings
from multipos.results import Result, plain
from multipos.sensor import derived, inverse
from multipos.sensor.diagnostics import Diagnostics, linearity
from multipos.sensor.expressions import expression_dict, load_expression
from multipos.sensor.model import Model, build_model, paper_symbol
from multipos.sensor.names import parameter_label

SCHEMA = "multipos/calibration/1"
_EXTRA = (
    "variance_components",
    "robust_weight",
    "orientation_error_deg",
    "group_rotation_deg",
    "level_sd_deg",
    "level_tilt_deg",
    "selection",
    "budget",
)  # what some estimators and budgets add


class Parameter(NamedTuple):
    """One parameter with its uncertainty; U = k u at the calibration's confidence."""

    output: str
    term: str
    name: str
    value: float
    u: float
    dof: float
    k: float
    U: float
    unit: str
    label: str
    symbol: str | None


class Gravity(NamedTuple):
    """Local gravity and its standard uncertainty [m/s²]."""

    value: float
    u: float


class Status(NamedTuple):
    """How the estimator ended; the last step is relative, the gradient in units of u."""

    converged: bool
    iterations: int
    message: str
    last_step: float = 0.0
    gradient: float = 0.0


@dataclass(frozen=True, eq=False)
class Calibration(Result):
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
    gravity : Gravity or None
        None: one g is the local gravity.
    estimator, criterion : str
    confidence : float
    diagnostics : Diagnostics
    cross_check : float or None
        Largest difference of the closed form from least squares, relative to the largest reading.
    status : Status
    created, version : str
        Time (ISO 8601, UTC) and the version of multipos.
    """

    model: Model
    parameters: Array
    covariance: Array
    parameter_dof: Array
    dof: Array
    residuals: Array
    residual_sd: Array
    reference: Array
    readings: Readings
    convention: Convention
    gravity: Gravity | None
    estimator: str
    criterion: str
    confidence: float
    diagnostics: Diagnostics
    status: Status
    created: str = field(compare=False)
    version: str
    cross_check: float | None = None
    extra: Mapping[str, Any] = field(default_factory=dict)

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
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs."""
        return self.model.outputs

    @cached_property
    def u(self) -> Array:
        """Standard uncertainties (p,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @cached_property
    def k(self) -> Array:
        """Coverage factors (p,) at `confidence`."""
        factors = {dof: coverage_factor(self.confidence, dof) for dof in set(self.parameter_dof)}
        return np.array([factors[dof] for dof in self.parameter_dof])

    @property
    def relative_residuals(self) -> Array:
        """The largest residual of each position (n,), in standard deviations of its output."""
        told = np.isfinite(self.residual_sd) & (self.residual_sd > 0.0)
        sd = np.where(told, self.residual_sd, 1.0)
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

        Of ``|f| − |reference|`` for unknown orientation, of the vector f − reference otherwise.
        """
        # What no output senses is known here, so that it does not pass for an error.
        force = inverse.invert(
            self.model,
            self.parameters,
            self.readings.values,
            self.readings.environment,
            unseen=self.reference,
        )
        if self.estimator == "unknown-orientation":
            size = np.linalg.norm(self.reference, axis=1)
            return float(np.sqrt(np.mean((np.linalg.norm(force, axis=1) - size) ** 2)))
        left = force - self.reference[:, list(inverse.sensed_axes(self.model))]
        return float(np.sqrt(np.mean(np.sum(left**2, axis=1))))

    @cached_property
    def linearity(self) -> dict[str, dict[str, float]]:
        """Linearity of each output with and without the model, in percent of ±1 g."""
        return linearity(self.model, self.reference, self.readings.values, self.residuals)

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

    def predict(
        self, reference: ArrayLike, environment: Mapping[str, ArrayLike] | None = None
    ) -> Array:
        """Return the readings (n, M) that the model expects at a reference (n, 3) [g]."""
        force = np.array(reference, dtype=np.float64, ndmin=2)
        return self.model.predict(self.parameters, force, environment or {})

    def compensate(
        self, raw: ArrayLike, environment: Mapping[str, ArrayLike] | None = None
    ) -> Array:
        """Return the force that explains raw readings.

        Parameters
        ----------
        raw : (n, M) or (M,) array, or (n,) for a single output
            In the unit of the readings.
        environment : mapping of str to (n,) array, optional
            Columns that the model uses beside the components, such as temperature.

        Returns
        -------
        (n, K) array [g]
            On the K axes that the sensor has, in the calibration's convention; NaN where no
            force explains the reading.
        """
        values = np.array(raw, dtype=np.float64)
        if values.ndim < 2:  # one reading of all outputs, or many of the only one
            values = values.reshape(-1, 1) if len(self.outputs) == 1 else values[None]
        if values.ndim != 2 or values.shape[1] != len(self.outputs):
            raise MultiposError(
                f"`raw` must have shape (n, {len(self.outputs)}), got {np.shape(raw)}; "
                "give one row per reading."
            )
        columns = {
            name: np.broadcast_to(np.asarray(column, dtype=np.float64), len(values))
            for name, column in (environment or {}).items()
            if name in self.model.environment
        }
        self.model.variables(np.zeros((0, 3)), columns)
        return inverse.invert(self.model, self.parameters, values, columns)

    def to_dict(self) -> dict[str, Any]:
        """Return everything as what JSON can carry, keys as in the formats reference."""
        found = self.diagnostics
        readings = self.readings
        optional = {
            "reading_u": readings.u,
            "reading_covariance": readings.covariance,
            "reading_sd": readings.sd,
            "samples": readings.samples,
            "orientation_sd_deg": None
            if readings.orientation_sd is None
            else np.degrees(readings.orientation_sd),
            "group": readings.group,
            "environment": dict(readings.environment) or None,
            "attitude": readings.rotation,
            "up": readings.up,
        }
        content = {
            "schema": SCHEMA,
            "multipos_version": self.version,
            "created": self.created,
            "input": {"file": readings.source, "sha256": readings.sha256},
            "convention": self.convention,
            "gravity": None if self.gravity is None else self.gravity._asdict(),
            "estimator": self.estimator,
            "criterion": self.criterion,
            "gauge": self.model.gauge,
            "model": self.model.text,
            "outputs": self.outputs,
            "axes": self.model.axes,
            "inputs": self.model.inputs,
            "unit": self.model.unit,
            "confidence": self.confidence,
            "status": self.status._asdict(),
            "positions": readings.labels,
            "parameters": [entry._asdict() for entry in self.entries],
            "covariance": self.covariance,
            "residuals": self.residuals,
            "residual_sd": dict(zip(self.outputs, self.residual_sd, strict=True)),
            "dof": dict(zip(self.outputs, self.dof, strict=True)),
            "readings": readings.values,
            "reference": self.reference,
            "reference_environment": dict.fromkeys(self.model.environment, 0.0) or None,
            **{name: value for name, value in optional.items() if value is not None},
            "rms": self.rms,
            "linearity": self.linearity,
            "diagnostics": {
                "rank": found.rank,
                "parameters": found.parameters,
                "condition": found.condition,
                "lack_of_fit": found.lack_of_fit,
                "outliers": found.outliers,
                "unidentifiable": found.unidentifiable,
                "warnings": found.warnings,
                "leverage": found.leverage,
            },
            "cross_check": None
            if self.cross_check is None
            else {"closed_form_max_difference": self.cross_check},
            "intrinsic": self.intrinsic,
            "installation_deg": self.installation_deg,
            **expression_dict(self.model),
            **self.extra,
        }
        result: dict[str, Any] = plain(content)
        return result

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the calibration as JSON, whole or not at all."""
        write_text(path, to_json(self.to_dict()))

    def __str__(self) -> str:
        return table(*parameter_rows(self), left=3)

    @cached_property
    def mean_environment(self) -> dict[str, float]:
        """The mean of each column of the model over the readings."""
        return {
            name: float(np.mean(self.readings.environment[name])) for name in self.model.environment
        }

    def _parameter(self, index: int) -> Parameter:
        output, term = self.model.keys[index]
        axis = self.model.axes[self.outputs.index(output)]
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
            label=parameter_label(output, axis, term),
            symbol=paper_symbol(self.model, index),
        )


def parameter_rows(calibration: Calibration) -> tuple[list[str], list[list[str]]]:
    """Return header and rows of the table of parameters; the paper's symbols where it has them."""
    symbols = paper_symbol(calibration.model, 0) is not None
    header = ["parameter", *(["symbol"] if symbols else []), "unit", "value(u)", "U", "k", "dof"]
    rows = []
    for p in calibration.entries:
        rows.append(
            [
                p.name,
                *([p.symbol or ""] if symbols else []),
                p.unit,
                uncertain(p.value, p.u),
                number(p.U, 2),
                number(p.k),
                number(p.dof),
            ]
        )
    return header, rows


def load(path: str | os.PathLike[str]) -> Calibration:
    """Read a calibration written by `Calibration.save`.

    Raises
    ------
    MultiposError
        The file is missing, truncated, of another schema, or holds what no calibration does.
    """
    return from_dict(read_json(path, SCHEMA), str(path))


def from_dict(content: Mapping[str, Any], where: str = "the calibration") -> Calibration:
    """Return the calibration that `Calibration.to_dict` described.

    Raises
    ------
    MultiposError
        A key is missing or not as `multipos.files.formats` has it, or the parts contradict each
        other.
    """
    require(content, CALIBRATION, where, "fit again")
    try:
        _check_shapes(content)
        calibration = _from_dict(content)
        _check_consistency(calibration, content["parameters"])
    except ValueError as error:
        said = str(error).rstrip(".")
        raise MultiposError(f"{where}: not a calibration: {said}; fit again.") from None
    return calibration


def _from_dict(content: Mapping[str, Any]) -> Calibration:
    outputs = tuple(content["outputs"])
    environment = {
        name: _numbers(column) for name, column in content.get("environment", {}).items()
    }
    model: Model = (
        load_expression(content)
        if "expression" in content
        else build_model(
            content["model"],
            outputs,
            tuple(content["axes"]),
            tuple(content["inputs"]),
            str(content["unit"]),
        )
    )
    if content["gauge"] is not None:
        model = model.with_gauge(content["gauge"])
    selection = content.get("selection")
    if selection is not None:
        terms = [(output, term) for output in outputs for term in selection[output]["terms"]]
        model = model.keeping(terms)
    convention = content["convention"]
    reference = _numbers(content["reference"])
    size = np.linalg.norm(reference, axis=1)
    if not (np.isfinite(size) & (size > 0.0)).all():
        raise ValueError("its reference is zero or not finite")
    up = reference / size[:, None] * (-1.0 if convention == "gravity" else 1.0) + 0.0
    sd_deg = content.get("orientation_sd_deg")
    readings = Readings(
        values=_numbers(content["readings"]),
        outputs=outputs,
        positions=tuple(content["positions"]),
        up=_numbers(content["up"]) if "up" in content else up,
        rotation=_numbers(content.get("attitude")),
        u=_numbers(content.get("reading_u")),
        covariance=_numbers(content.get("reading_covariance")),
        sd=_numbers(content.get("reading_sd")),
        samples=_numbers(content.get("samples")),
        orientation_sd=None if sd_deg is None else np.radians(_numbers(sd_deg)),
        group=content.get("group"),
        environment=environment,
        unit=model.unit,
        source=content["input"]["file"],
        sha256=content["input"]["sha256"],
    )
    found, parameters = content["diagnostics"], content["parameters"]
    keys = [(entry["output"], entry["term"]) for entry in parameters]
    if keys != [(output, str(term)) for output, term in model.keys]:
        raise ValueError("its parameters are not those of its model")
    cross_check, status, gravity = content["cross_check"], content["status"], content["gravity"]
    return Calibration(
        model=model,
        parameters=_numbers([entry["value"] for entry in parameters]),
        covariance=_numbers(content["covariance"]),
        parameter_dof=_dof([entry["dof"] for entry in parameters], parameters),
        dof=_dof([content["dof"][output] for output in outputs]),
        residuals=_numbers(content["residuals"]),
        residual_sd=_numbers([content["residual_sd"][output] for output in outputs]),
        reference=reference,
        readings=readings,
        convention=convention,
        gravity=None if gravity is None else Gravity(gravity["value"], gravity["u"]),
        estimator=content["estimator"],
        criterion=content["criterion"],
        confidence=float(content["confidence"]),
        diagnostics=Diagnostics(
            rank=found["rank"],
            parameters=found["parameters"],
            condition=float(_numbers([found["condition"]])[0]),
            leverage=_numbers(found["leverage"]),
            lack_of_fit={
                output: {key: test[key] for key in ("F", "dof", "p")}
                for output, test in found["lack_of_fit"].items()
            },
            outliers=tuple(found["outliers"]),
            unidentifiable=tuple(found["unidentifiable"]),
            warnings=tuple(found["warnings"]),
        ),
        status=Status(
            status["converged"],
            status["iterations"],
            status["message"],
            status.get("last_step", 0.0),
            status.get("gradient", 0.0),
        ),
        created=content["created"],
        version=content["multipos_version"],
        cross_check=None
        if cross_check is None
        else float(cross_check["closed_form_max_difference"]),
        extra={key: content[key] for key in _EXTRA if key in content},
    )


def _check_shapes(c: Mapping[str, Any]) -> None:
    """Hold the lists of a file to the numbers of its readings, outputs and parameters."""
    outputs, p, n = c["outputs"], len(c["parameters"]), len(c["readings"])
    m = len(outputs)
    known: dict[str, tuple[int, ...]] = {
        "covariance": (p, p),
        "readings": (n, m),
        "residuals": (n, m),
        "reference": (n, 3),
        "positions": (n,),
        "reading_u": (n, m),
        "reading_covariance": (n * m, n * m),
        "reading_sd": (n, m),
        "samples": (n,),
        "orientation_sd_deg": (n,),
        "group": (n,),
        "attitude": (n, 3, 3),
        "up": (n, 3),
    }
    shapes = [(key, c[key], shape) for key, shape in known.items() if key in c]
    shapes.append(("diagnostics.leverage", c["diagnostics"]["leverage"], (n, m)))
    for name, column in c.get("environment", {}).items():
        shapes.append((f"environment.{name}", column, (n,)))
    if "scatter" in c.get("budget", {}):
        shapes.append(("budget.scatter", c["budget"]["scatter"], (p, p)))
    for key in ("robust_weight", "orientation_error_deg"):
        if key in c:
            shapes.append((key, c[key], (n, m) if np.ndim(c[key]) > 1 else (n,)))
    for key, value, shape in shapes:
        if np.shape(value) != shape:
            raise ValueError(f"'{key}' has shape {np.shape(value)}, but {shape} fits its others")
    for key in ("residual_sd", "dof", "selection"):
        if key in c and set(c[key]) != set(outputs):
            raise ValueError(f"'{key}' names {', '.join(c[key])}, not its outputs")


def _check_consistency(c: Calibration, parameters: list[dict[str, Any]]) -> None:
    """Hold the numbers of a file to each other: what it says must follow from what it says."""
    columns = [c.readings.environment.get(name, np.nan) for name in c.model.environment]
    if not all(np.isfinite(column).all() for column in columns):
        raise ValueError("its readings lack a column of its model, or a number in it")
    if c.model.gauge is not None and sorted(c.model.axes) != list(COMPONENTS):
        raise ValueError(f"its gauge is for outputs on x, y and z, not on {c.model.axes}")
    # NaN is right where nothing was left to estimate an uncertainty from.
    require_covariance(c.covariance, _numbers([entry["u"] for entry in parameters]))


def _numbers(value: Any) -> Any:
    """Return nested lists as an array, null as NaN; None stays None."""
    return None if value is None else np.array(value, dtype=np.float64)


def _dof(values: list[float | None], parameters: list[dict[str, Any]] | None = None) -> Array:
    """Return degrees of freedom; null is infinite where there is a k, else unknown."""
    dof = [np.inf if value is None else value for value in values]
    if parameters is not None:
        dof = [
            0.0 if entry["k"] is None else value
            for entry, value in zip(parameters, dof, strict=True)
        ]
    return np.array(dof, dtype=np.float64)
