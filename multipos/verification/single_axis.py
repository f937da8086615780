"""Single-axis tumble: an accelerometer with input, pendulous and output axis turned in gravity.

With a = (a_i, a_p, a_o) the specific force [g] on the three axes, the output E is modelled by

    E/K1 = K0 + a_i + K2 a_i² + K3 a_i³ + Koq a_i|a_i|
           + Kip a_i a_p + Kio a_i a_o + delta_o a_p − delta_p a_o,                         (1)

eq. (1) of docs/theory/tumble.md: bias K0 [g], scale factor K1 [reading/g], second and third order
K2 [g/g²], K3 [g/g³], odd second order Koq [g/g²], cross-couplings Kip, Kio [g/g²] and the
misalignments delta_o, delta_p [rad] of the input axis about the output and pendulous axes. It is
linear in K1 times each coefficient and fitted by least squares; the ratios to K1 carry

    u²(p/K1) = [u²(p) − 2 r u(p, K1) + r² u²(K1)]/K1²,    r = p/K1.                         (2)

The Fourier view (`multipos.positions.harmonics`) of the same readings gives the same coefficients
where the points are even steps of a turn, and its residual harmonics are the test of table and
model: what no term of (1) explains. The axes i, p, o are x, y, z in cyclic order from the output's
own axis.

Source: the model equation of IEEE Std 1293 as the project's formats reference writes it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from multipos.errors import MultiposError, RankError, UsageError
from multipos.estimation.known import FLOOR
from multipos.files.lists import Names
from multipos.files.tables import Source
from multipos.fitting.readings import fit
from multipos.numerics.arrays import Array
from multipos.numerics.least_squares import name_combinations, separability, solve
from multipos.numerics.terms import COMPONENTS
from multipos.positions.attitudes import Convention
from multipos.positions.harmonics import (
    Harmonic,
    Roll,
    find_rolls,
    power,
    residual_series,
    series,
    strange_harmonics,
    transform,
)
from multipos.positions.placement import orient
from multipos.positions.reading_tables import read_readings
from multipos.positions.readings import Readings
from multipos.positions.scheme import Scheme
from multipos.results import Result
from multipos.sensor.calibration import Calibration
from multipos.sensor.model import Model, build_model, default_axes
from multipos.sensor.tilt import reading_noise
from multipos.uncertainty.turntable import TableErrors, table_errors

SCHEMA = "multipos/tumble/1"
# Coefficient: its term of eq. (1), sign, unit, and the customary unit, a millionth of it.
COEFFICIENTS = {
    "K0": ("1", 1.0, "g", "µg"),
    "K1": ("i", 1.0, "", "ppm"),
    "delta_o": ("p", 1.0, "rad", "µrad"),
    "delta_p": ("o", -1.0, "rad", "µrad"),
    "K2": ("i^2", 1.0, "g/g^2", "µg/g^2"),
    "K3": ("i^3", 1.0, "g/g^3", "µg/g^3"),
    "Kip": ("i*p", 1.0, "g/g^2", "µg/g^2"),
    "Kio": ("i*o", 1.0, "g/g^2", "µg/g^2"),
    "Koq": ("i*|i|", 1.0, "g/g^2", "µg/g^2"),
    "Kpp": ("p^2", 1.0, "g/g^2", "µg/g^2"),
    "Koo": ("o^2", 1.0, "g/g^2", "µg/g^2"),
    "Kpo": ("p*o", 1.0, "g/g^2", "µg/g^2"),
}
_DEFAULT = tuple(COEFFICIENTS)[:9]  # the nine of eq. (1), in the order they are kept
_MILLION = 1e6
_WEAK = 5.0  # u of one grows so much by the other being fitted as well
_ROUNDING = 1e-12  # residuals below this part of the largest reading are rounding


@dataclass(frozen=True, eq=False)
class TumbleCoefficient(Result):
    """One coefficient of eq. (1); all but K1 are divided by K1.

    `customary` holds value, u, U and unit as a data sheet has them; of K1 only u and U, in ppm.
    """

    value: float
    u: float
    U: float
    unit: str
    k: float
    dof: float
    customary: dict[str, Any]


@dataclass(frozen=True, eq=False)
class Tumble(Result):
    """A single-axis tumble: coefficients, harmonics, and the calibration that they come from.

    Attributes
    ----------
    coefficients : dict of str to TumbleCoefficient
        Those that the points can tell, in the order of `COEFFICIENTS`.
    calibration : Calibration
    rolls : tuple of Roll
    harmonics, residual_harmonics : tuples of Harmonic
        Of the readings and of their residuals.
    fourier_max_difference : float or None
        Largest difference of the coefficients by the Fourier view from least squares, as a
        reading over the largest reading; None where the points are not even.
    table_errors : TableErrors
    unidentifiable, weak, warnings : tuples of str
    """

    coefficients: dict[str, TumbleCoefficient]
    calibration: Calibration
    rolls: tuple[Roll, ...]
    harmonics: tuple[Harmonic, ...]
    residual_harmonics: tuple[Harmonic, ...]
    fourier_max_difference: float | None
    table_errors: TableErrors
    unidentifiable: tuple[str, ...]
    weak: tuple[str, ...]
    warnings: tuple[str, ...]

    @property
    def taken_as_zero(self) -> tuple[str, ...]:
        """Coefficients of eq. (1) that the model leaves out."""
        return tuple(name for name in _DEFAULT if name not in self.coefficients)

    def __getitem__(self, name: str) -> TumbleCoefficient:
        """Return a coefficient by name, as in ``tumble["K2"]``."""
        return self.coefficients[name]

    def to_dict(self) -> dict[str, Any]:
        """Return everything as JSON carries it, keys as in docs/reference/check-and-tumble.md."""
        return {
            "schema": SCHEMA,
            **{name: vars(found) for name, found in self.coefficients.items()},
            "harmonics": [entry.to_dict() for entry in self.harmonics],
            "residual_harmonics": [
                {**entry.to_dict(), "p": entry.p} for entry in self.residual_harmonics
            ],
            "fourier_max_difference": self.fourier_max_difference,
            "table_errors": self.table_errors.to_dict(),
            "unidentifiable": self.unidentifiable,
            "taken_as_zero": self.taken_as_zero,
            "weak": self.weak,
            "warnings": self.warnings,
            "calibration": self.calibration.to_dict(),
        }


def tumble(
    readings: Source | Readings,
    *,
    outputs: Names | None = None,
    axes: Names = "x",
    scheme: Source | Scheme | None = None,
    model: str | None = None,
    convention: Convention = "specific-force",
    reading_sd: ArrayLike | None = None,
    gravity: float | None = None,
    gravity_u: float | None = None,
    latitude: float | None = None,
    height: float | None = None,
    unit: str | None = None,
    range: Sequence[float] | None = None,
    confidence: float = 0.95,
) -> Tumble:
    """Calibrate a single-axis accelerometer from a tumble in one or two planes.

    Parameters
    ----------
    readings : Readings, path, mapping of columns, or data frame
        At any number of angles, evenly spaced or not.
    outputs : name, optional
        The one output, where the readings have several columns.
    axes : name
        Its input axis i; p and o follow in cyclic order.
    scheme, convention, reading_sd, gravity, gravity_u, latitude, height, unit, range, confidence
        As in `multipos.fit`.
    model : str, optional
        Eq. (1) less what the points cannot separate; a model given is taken as it is.

    Returns
    -------
    Tumble

    Raises
    ------
    MultiposError
        The angles do not span a turn, or as in `multipos.fit`.
    RankError
        The points cannot separate K0 and K1, or the model given.
    UsageError
        More than one output or axis, or an option is at fault.
    """
    data = orient(read_readings(readings, outputs=outputs, unit=unit), scheme)
    axis = _one_axis(data, axes)
    sign = -1.0 if convention == "gravity" else 1.0
    rolls = find_rolls(data, axis, sign)
    repeated = _check_rolls(data, rolls)
    names, unidentifiable = _kept(data, axis, sign)
    calibration = fit(
        data,
        model=model or _formula(names, axis),
        axes=(axis,),
        convention=convention,
        reading_sd=reading_sd,
        gravity=gravity,
        gravity_u=gravity_u,
        latitude=latitude,
        height=height,
        range=range,
        confidence=confidence,
    )
    signal = calibration.readings.values[:, 0]
    rounding = _ROUNDING * float(np.abs(signal).max())
    residual = residual_series(
        rolls, calibration.residuals[:, 0], _design(calibration.model, calibration), rounding
    )
    sd = float(reading_noise(calibration)[0])
    return Tumble(
        coefficients=_coefficients(calibration, axis),
        calibration=calibration,
        rolls=rolls,
        harmonics=series(rolls, signal, sd if sd > rounding else None),
        residual_harmonics=residual,
        fourier_max_difference=_fourier_difference(calibration, rolls),
        table_errors=table_errors(calibration),
        unidentifiable=unidentifiable,
        weak=_weak(calibration, axis),
        warnings=(*calibration.diagnostics.warnings, *repeated, *strange_harmonics(residual)),
    )


def _one_axis(data: Readings, axes: Names) -> str:
    if len(data.outputs) != 1:
        raise UsageError(
            f"a tumble is of one output, but the readings have {', '.join(data.outputs)}; "
            "name it with --outputs."
        )
    named = default_axes(data.outputs, axes)
    if len(named) != 1 or named[0] not in COMPONENTS:
        raise UsageError(f"--axes takes one of x, y, z for a tumble, got '{','.join(named)}'.")
    return named[0]


def _check_rolls(data: Readings, rolls: tuple[Roll, ...]) -> list[str]:
    """Refuse angles that do not span a turn; return what is to be said of repeated ones."""
    where = data.source or "the readings"
    if rolls and not any(roll.spans_a_turn for roll in rolls):
        widest = max(rolls, key=lambda roll: len(roll.rows))
        raise MultiposError(
            f"{where}: the {len(widest.distinct)} angles in plane {widest.plane} do not span a "
            f"turn, {np.degrees(widest.gap):.4g} of 360 degrees are without a point; add points "
            "so that no gap is wider than 180 degrees."
        )
    said = []
    for roll in rolls:
        twice = roll.repeated
        if twice:
            listed = ", ".join(f"{angle:g}" for angle in twice[:6])
            more = f" and {len(twice) - 6} more" if len(twice) > 6 else ""
            said.append(
                f"plane {roll.plane}: the angles {listed}{more} degrees are there more than once; "
                "least squares takes every reading, the harmonics are of their means"
            )
    return said


def _names(axis: str) -> dict[str, str]:
    """Return i, p, o as case axes, cyclic from the input axis."""
    start = COMPONENTS.index(axis)
    return {role: COMPONENTS[(start + k) % 3] for k, role in enumerate("ipo")}


def _term(name: str, axis: str) -> str:
    text = COEFFICIENTS[name][0]
    roles = _names(axis)
    return "".join(roles.get(mark, mark) for mark in text)


def _formula(names: Sequence[str], axis: str) -> str:
    if tuple(names) == _DEFAULT:
        return "ieee-odd"
    return " + ".join(_term(name, axis) for name in names)


def _kept(data: Readings, axis: str, sign: float) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the coefficients that the points can tell, and in words what they cannot."""
    assert data.up is not None
    every = tuple(COEFFICIENTS)
    formula = " + ".join(_term(name, axis) for name in every)
    model = build_model(formula, data.outputs, (axis,))
    design = model.basis(sign * data.up, {})[:, model.columns[0]]
    kept: list[int] = []
    for column, _ in enumerate(_DEFAULT):
        trial = [*kept, column]
        if separability(design[:, trial], floor=FLOOR).rank == len(trial):
            kept = trial
    found = separability(design, floor=FLOOR)
    if kept[:2] != [0, 1]:
        raise RankError(
            f"{data.source or 'the readings'}: these points cannot tell K0 from K1; "
            "give points with the input axis up and down.",
            rank=found.rank,
            parameters=found.parameters,
            combinations=name_combinations(found.null, every, rows="points"),
        )
    said = name_combinations(found.null, every, rows="points")
    return tuple(every[column] for column in kept), _with_squares(said, found.null, every)


def _with_squares(said: tuple[str, ...], null: Array, names: Sequence[str]) -> tuple[str, ...]:
    """Return the sentences, the one on both cross squares said as what can be seen of them."""
    p, o = names.index("Kpp"), names.index("Koo")
    result = []
    for sentence, v in zip(said, null.T, strict=True):
        both = v[p] != 0.0 and v[o] != 0.0 and not (null[p] - null[o]).any()
        result.append(
            "of `Kpp` and `Koo` only the difference Kpp - Koo can be told, as "
            "a_i^2 + a_p^2 + a_o^2 = 1: " + sentence
            if both
            else sentence
        )
    return tuple(result)


def _coefficients(calibration: Calibration, axis: str) -> dict[str, TumbleCoefficient]:
    c, model = calibration, calibration.model
    output = model.outputs[0]
    try:
        scale = model.index(output, _term("K1", axis))
    except KeyError:
        raise UsageError(
            f"the model '{model.text}' has no term {_term('K1', axis)}; a tumble divides by K1."
        ) from None
    K1, u1 = float(c.parameters[scale]), float(c.u[scale])
    if K1 == 0.0:
        raise MultiposError(
            f"the scale factor K1 of {output} is 0, and all other coefficients are divided by it; "
            "the output does not follow the angle, check its column and cable."
        )
    result = {}
    for name, (_, sign, unit, customary) in COEFFICIENTS.items():
        try:
            j = model.index(output, _term(name, axis))
        except KeyError:
            continue
        k, dof = float(c.k[j]), float(c.parameter_dof[j])
        if name == "K1":
            ppm = abs(_MILLION * u1 / K1)
            custom: dict[str, Any] = {"u": ppm, "U": k * ppm, "unit": customary}
            result[name] = TumbleCoefficient(K1, u1, k * u1, model.units[j], k, dof, custom)
            continue
        value = float(c.parameters[j]) / K1
        shared = float(c.covariance[j, scale])
        variance = float(c.covariance[j, j]) - 2.0 * value * shared + value**2 * u1**2  # eq. (2)
        u = math.nan if math.isnan(variance) else math.sqrt(max(variance, 0.0)) / abs(K1)
        value *= sign
        custom = {name: _MILLION * v for name, v in (("value", value), ("u", u), ("U", k * u))}
        result[name] = TumbleCoefficient(
            value, u, k * u, unit, k, dof, {**custom, "unit": customary}
        )
    return result


def _weak(calibration: Calibration, axis: str) -> tuple[str, ...]:
    """Say which pairs are told apart so weakly that each costs the other most of its u."""
    model = calibration.model
    places = {
        model.index(model.outputs[0], _term(name, axis)): name
        for name in COEFFICIENTS
        if name != "K0" and _term(name, axis) in {str(term) for term in model.terms[0]}
    }
    said = []
    for j, one in places.items():
        for k, other in places.items():
            rho = float(calibration.correlation[j, k])
            if j >= k or not abs(rho) < 1.0:
                continue
            loss = 1.0 / math.sqrt(1.0 - rho**2)
            if loss > _WEAK:
                said.append(
                    f"`{one}` and `{other}` are told apart weakly: the u of each is {loss:.2g} "
                    "times what it would be if the other were known"
                )
    return tuple(said)


def _fourier_difference(calibration: Calibration, rolls: tuple[Roll, ...]) -> float | None:
    """Return how far the coefficients from the harmonics are from those of least squares.

    By Parseval the sum of squares of a roll is n times that of its harmonics, so least squares of
    the harmonics, against those of the sampled terms, is the same problem in other axes.
    """
    c = calibration
    stated = c.readings.u is not None and np.ptp(c.readings.u) > 0.0
    if stated or c.readings.covariance is not None or not rolls:
        return None
    if sum(len(roll.rows) for roll in rolls) != len(c.readings):
        return None
    design, signal = _design(c.model, c), c.readings.values[:, 0]
    left, right = [], []
    for roll in rolls:
        if not roll.even or np.ptp(np.bincount(roll.groups)) > 0:
            return None
        weighted = np.sqrt(len(roll.rows) * power(roll))[:, None] * transform(roll)
        left.append(weighted @ roll.average(design[roll.rows]))
        right.append(weighted @ roll.average(signal[roll.rows]))
    by_fourier = solve(np.concatenate(left), np.concatenate(right)).coefficients
    return float(np.abs(by_fourier - c.parameters).max() / np.abs(signal).max())


def _design(model: Model, calibration: Calibration) -> Array:
    phi = model.basis(calibration.reference, calibration.readings.environment)
    return np.asarray(phi[:, model.columns[0]])
