"""Single-axis tumble: an accelerometer with input, pendulous and output axis turned in gravity.

Least squares give the coefficients of `multipos.verification.coefficients`. The Fourier view
(`multipos.positions.harmonics`) of the same readings gives the same where the points are even steps
of a turn, and its residual harmonics are the test of table and model: what no term explains.

Hysteresis: what an output reads at an angle that is come to from below and from above.

A pass runs forward where the angle of the roll, as a scheme lists it, grows from one reading to the
next, and backward where it falls. At the N angles that were come to both ways the difference of the
means is d_k, and

    h = (1/N) sum d_k,      u(h) = s(d)/√N on N − 1 degrees of freedom,                     (1)

forward less backward, in g. What shifts from angle to angle is in s(d); a zero that drifts evenly
through both passes is in h, for the backward pass comes later. The first reading of a roll, and one
at the angle of the reading before, belong to the pass that follows.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from multipos.errors import RankError
from multipos.finding import Finding, Findings, in_order
from multipos.fitting.fit_readings import fit
from multipos.numerics.arrays import Array, Places
from multipos.numerics.least_squares import solve
from multipos.numerics.quantiles import coverage_factor
from multipos.numerics.terms import Formula, ModelText
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
from multipos.positions.readings import Readings
from multipos.results import Drawn, Result, Tabular, frozen
from multipos.sensor.calibration import Calibration
from multipos.sensor.gravity import StatedBench
from multipos.sensor.model import Model
from multipos.sensor.tilt import reading_noise
from multipos.uncertainty.turntable import TableErrors, find_head, table_errors
from multipos.verification.coefficients import (
    DEFAULT,
    TumbleCoefficient,
    coefficients_beside,
    find_hidden_table,
    find_without_u,
    fitted_coefficients,
    formula_of,
    kept_coefficients,
    poorly_separated,
    those_that_hold,
)

_OF_TUMBLE = ("hidden-table", "part-of-a-turn")  # which a tumble says in its own words
_STILL = 1e-9  # [rad], a turn that is none
_FEWEST = 2  # angles come to both ways, without which there is no spread


@frozen
class Hysteresis(Result):
    """Mean of forward less backward readings at the same angles of a roll, by eq. (1)."""

    value: float
    u: float
    U: float
    unit: str
    dof: float
    angles: int


def find_hysteresis(
    rolls: Sequence[Roll], signal: Array, confidence: float
) -> dict[str, Hysteresis]:
    """Return the hysteresis of every roll that was passed both ways, by its plane.

    Parameters
    ----------
    rolls : sequence of Roll
    signal : (n,) array [g]
        The readings over K1, in the order in which they were taken.
    confidence : float
    """
    found = {}
    for roll in rolls:
        # An angle of plane 'yx' falls where that of the roll, from x to y, grows.
        sense = 1 if roll.plane == "".join(sorted(roll.plane)) else -1
        way, values, groups = sense * passes(roll.angle), signal[roll.rows], roll.groups
        differences = []
        for group in range(len(roll.distinct)):
            here = groups == group
            forward, backward = values[here & (way > 0)], values[here & (way < 0)]
            if len(forward) and len(backward):
                differences.append(float(forward.mean() - backward.mean()))
        count = len(differences)
        if count < _FEWEST:
            continue
        u = float(np.std(differences, ddof=1)) / np.sqrt(count)
        U = coverage_factor(confidence, count - 1.0) * u
        value = float(np.mean(differences))
        found[roll.plane] = Hysteresis(value, float(u), float(U), "g", count - 1.0, count)
    return found


def passes(angle: Array) -> Places:
    """Return +1 for readings (n,) of a forward pass, −1 of a backward one, 0 where none shows."""
    turned = np.remainder(np.diff(angle) + np.pi, 2.0 * np.pi) - np.pi
    way = np.sign(np.where(np.abs(turned) < _STILL, 0.0, turned))
    way[np.abs(np.abs(turned) - np.pi) < _STILL] = 0.0  # half a turn goes either way
    result = np.concatenate([[0.0], way])
    for row in range(len(result) - 2, -1, -1):
        if result[row] == 0.0:
            result[row] = result[row + 1]
    return result.astype(np.intp)


SCHEMA = "multipos/tumble/1"
_LEANING = 0.1  # rad, by which an input axis that is mounted by hand lies from where it should
_ROUNDING = 1e-12  # residuals below this part of the largest reading are rounding


@frozen
class Tumble(Result, Drawn, Tabular):
    """A single-axis tumble: coefficients, harmonics, and the calibration that they come from.

    Attributes
    ----------
    coefficients : dict of str to TumbleCoefficient
        Those that the points can tell, in the order of `COEFFICIENTS`; u and U are NaN of those
        that lean on errors of the table which are beyond chance.
    calibration : Calibration
    rolls : tuple of Roll
    harmonics, residual_harmonics : tuples of Harmonic
        Of the readings and of their residuals.
    fourier_max_difference : float or None
        Largest difference of the coefficients by the Fourier view from least squares, as a
        reading over the largest reading; None where the points are not even.
    table_errors : TableErrors
    unidentifiable, weak : tuples of str
    hysteresis : dict of plane to Hysteresis
        Of the rolls that were passed forward and backward.
    findings : tuple of Finding
        Of the calibration, and of the tumble.
    beside_table : dict of str to TumbleCoefficient
        Those coefficients that no error of the table does the same as, estimated beside all.

    Examples
    --------
    >>> import numpy as np
    >>> import multipos as mp
    >>> angle = np.arange(0.0, 360.0, 30.0)
    >>> i, p = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    >>> volt = 0.012 + 2.5 * i + 0.001 * p + 2e-5 * np.cos(40.0 * angle)
    >>> readings = {"roll_axis": ["z"] * 12, "angle_deg": angle, "volt": volt}
    >>> found = mp.tumble(readings, unit="V")
    >>> list(found.coefficients)
    ['K0', 'K1', 'delta_o', 'K2', 'K3', 'Kip', 'Koq']
    >>> print(f"{found.harmonics[1].order}: {found.harmonics[1].amplitude:.3f} V")
    1: 2.500 V
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
    hysteresis: dict[str, Hysteresis]
    beside_table: dict[str, TumbleCoefficient]
    findings: Findings = ()

    @property
    def taken_as_zero(self) -> tuple[str, ...]:
        """Coefficients of eq. (1) that the model leaves out."""
        return tuple(name for name in DEFAULT if name not in self.coefficients)

    def __getitem__(self, name: str) -> TumbleCoefficient:
        """Return a coefficient by name, as in ``tumble["K2"]``."""
        return self.coefficients[name]

    def columns(self) -> dict[str, Any]:
        """Return the coefficients: name, value, u, k, U, unit."""
        names = ("value", "u", "k", "U", "unit")
        fields = {key: [getattr(c, key) for c in self.coefficients.values()] for key in names}
        return {"name": list(self.coefficients), **fields}

    def to_dict(self) -> dict[str, Any]:
        """Return everything as JSON carries it, keys as in docs/howto/single-axis-tumble.md."""
        return {
            "schema": SCHEMA,
            **{name: vars(found) for name, found in self.coefficients.items()},
            "harmonics": [entry.to_dict() for entry in self.harmonics],
            "residual_harmonics": [
                {**entry.to_dict(), "p": entry.p} for entry in self.residual_harmonics
            ],
            "fourier_max_difference": self.fourier_max_difference,
            "hysteresis": {plane: vars(found) for plane, found in self.hysteresis.items()},
            "table_errors": self.table_errors.to_dict(),
            "beside_table": {name: vars(found) for name, found in self.beside_table.items()},
            "unidentifiable": self.unidentifiable,
            "taken_as_zero": self.taken_as_zero,
            "weak": self.weak,
            "findings": [finding.to_dict() for finding in self.findings],
            "calibration": self.calibration.to_dict(),
        }


def tumble_output(
    data: Readings,
    facing: str,
    bench: StatedBench,
    *,
    model: ModelText | None,
    convention: Convention,
    reading_sd: float | None,
) -> Tumble:
    """Return the tumble of oriented readings of one output along an axis.

    Parameters
    ----------
    data : Readings
    facing : str
        Its input axis i, with a minus where it faces the other way; p and o follow in cyclic order.
    bench : StatedBench
    model, convention, reading_sd
        As in `multipos.tumble`.
    """
    axis = facing.removeprefix("-")
    sign = -1.0 if convention == "gravity" else 1.0
    rolls = find_rolls(data, axis, sign)
    limited = _on_part_of_a_turn(data, rolls)
    repeated = [*limited, *_find_repeats(rolls)]
    names, unidentifiable = kept_coefficients(data, axis, sign, limited=bool(limited))
    calibration = fit(
        data,
        model=model or Formula(formula_of(names, axis)),
        axes=(facing,),
        convention=convention,
        reading_sd=reading_sd,
        **vars(bench),
    )
    coefficients = fitted_coefficients(calibration, axis)
    signal = calibration.readings.values[:, 0]
    rounding = _ROUNDING * float(np.abs(signal).max())
    residual = residual_series(
        rolls, calibration.residuals[:, 0], _design(calibration.model, calibration), rounding
    )
    sd = float(reading_noise(calibration)[0])
    table = table_errors(calibration)
    beside = {} if table.beside is None else coefficients_beside(calibration, axis, table.beside)
    stated = calibration.readings.covariance is not None
    held = those_that_hold(coefficients, beside, table.beside, stated=stated)
    findings = (
        *(each for each in calibration.findings if each.code not in _OF_TUMBLE),
        *_of_plane(coefficients, calibration),
        *repeated,
        *strange_harmonics(residual),
        *find_without_u(held),
        *find_hidden_table(held, calibration, axis),
    )
    return Tumble(
        coefficients=held,
        calibration=calibration,
        rolls=rolls,
        harmonics=series(rolls, signal, sd if sd > rounding else None),
        residual_harmonics=residual,
        fourier_max_difference=_fourier_difference(calibration, rolls),
        table_errors=table,
        unidentifiable=unidentifiable,
        weak=poorly_separated(calibration, axis),
        findings=in_order(findings),
        hysteresis=find_hysteresis(
            _mounted_once(calibration.readings, rolls),
            signal / coefficients["K1"].value,
            calibration.confidence,
        ),
        beside_table=beside,
    )


def _mounted_once(readings: Readings, rolls: tuple[Roll, ...]) -> tuple[Roll, ...]:
    """Return the rolls that were not taken in several mountings, which differ by more."""
    axes = [one.roll.axis for one in find_head(readings)]
    return tuple(roll for roll in rolls if axes.count(roll.axis) < 2)


def _of_plane(found: Mapping[str, TumbleCoefficient], c: Calibration) -> Findings:
    """Find a plane where the input axis leans too far for the coefficients to be its own."""
    if {"no-signal", "turned"} & {finding.code for finding in c.findings}:
        return ()  # the same, said already
    sizes = [abs(found[name].value) for name in ("delta_o", "delta_p") if name in found]
    lean = math.hypot(*sizes)
    if not lean > _LEANING:
        return ()
    axis, degrees = c.model.axes[0], math.degrees(math.atan(lean))
    text = (
        f"the input axis of {c.outputs[0]} is {degrees:.2g} degrees from {axis}: K1 and the terms "
        f"of higher order are those along {axis}"
    )
    action = "Check roll_axis, the angle that is zero, and --axes."
    return (Finding("wrong-plane", "warning", text, action, outputs=c.outputs),)


def _on_part_of_a_turn(data: Readings, rolls: tuple[Roll, ...]) -> list[Finding]:
    """Say that no roll spans a turn, and what can be identified then; nothing where one does."""
    if not rolls or data.forced.any() or any(roll.spans_a_turn for roll in rolls):
        return []
    return [
        Finding(
            "part-of-a-turn",
            "warning",
            (
                f"the {len(roll.distinct)} angles in plane {roll.plane} leave "
                f"{np.degrees(roll.gap):.4g} of 360 degrees empty: no harmonics; results hold for "
                "these angles only"
            ),
            "Measure without a gap wider than 180 degrees.",
        )
        for roll in rolls
    ]


def _find_repeats(rolls: tuple[Roll, ...]) -> list[Finding]:
    """Say which angles are there more than once."""
    said = []
    for roll in rolls:
        twice = roll.repeated
        if twice and len(set(passes(roll.angle).tolist())) == 1:  # not one pass each way
            listed = ", ".join(f"{angle:g}" for angle in twice[:6])
            more = f" and {len(twice) - 6} more" if len(twice) > 6 else ""
            text = (
                f"plane {roll.plane}: the angles {listed}{more} degrees are repeated; least "
                "squares uses every reading, harmonics use means"
            )
            said.append(Finding("repeated-angles", "note", text))
    return said


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
    try:
        by_fourier = solve(np.concatenate(left), np.concatenate(right)).coefficients
    except RankError:  # means over a turn tell less than all its readings
        return None
    return float(np.abs(by_fourier - c.parameters).max() / np.abs(signal).max())


def _design(model: Model, calibration: Calibration) -> Array:
    phi = model.basis(calibration.reference, calibration.readings.environment)
    return np.asarray(phi[:, model.columns[0]])
