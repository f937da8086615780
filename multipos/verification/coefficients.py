"""The coefficients of a tumble, as the standard has them and as a model's parameters give them.

- `formula_of` and `kept_coefficients` say which coefficients a tumble has, `fitted_coefficients`
  their values, `coefficients_beside` those that were taken from elsewhere.
- `ratios_to_k1` makes of a model's parameters each a `TumbleCoefficient`, eq. (2).
- `roles` and `applied_forces` say which axis is which, `those_that_hold` which coefficients the
  positions determine.
- `find_without_u` and `find_hidden_table` are findings: no U, and what the table may hide.

With a = (a_i, a_p, a_o) the specific force [g] on the three axes, the output E is modelled by

    E/K1 = K0 + a_i + K2 a_i² + K3 a_i³ + Koq a_i|a_i|
           + Kip a_i a_p + Kio a_i a_o + delta_o a_p − delta_p a_o,                         (1)

eq. (1) of docs/theory/tumble.md: bias K0 [g], scale factor K1 [reading/g], second and third order
K2 [g/g²], K3 [g/g³], odd second order Koq [g/g²], cross-couplings Kip, Kio [g/g²] and the
misalignments delta_o, delta_p [rad] of the input axis about the output and pendulous axes. It is
linear in K1 times each coefficient and fitted by least squares; the ratios to K1 carry

    u²(p/K1) = [u²(p) − 2 r u(p, K1) + r² u²(K1)]/K1²,    r = p/K1.                         (2)

The axes i, p, o are x, y, z in cyclic order from the output's own axis.

Source: the model equation of IEEE Std 1293 as the project's formats reference writes it.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from multipos.errors import MultiposError, RankError, UsageError
from multipos.estimation.known import ZERO_NORM
from multipos.finding import Finding, Findings, errors_of
from multipos.numerics.arrays import COMPONENTS, Array
from multipos.numerics.quantiles import coverage_factor
from multipos.numerics.separability import name_combinations, separability
from multipos.positions.readings import Readings
from multipos.results import Result, frozen
from multipos.sensor.calibration import Calibration
from multipos.sensor.model import Model, build_model
from multipos.uncertainty.turntable import BesideTable, changes_unseen, in_words_of_unseen

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
DEFAULT = tuple(COEFFICIENTS)[:9]  # the nine of eq. (1), in the order they are kept
_MILLION = 1e6
_FAINT = 10.0  # times by which others may enlarge the u of a coefficient on part of a turn
_ODD = 2.0  # times by which Koq, which few sensors have, may enlarge the u of K3


@frozen
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


def applied_forces(data: Readings, sign: float) -> Array:
    """Return the reference (n, 3) of oriented readings, gravity as one g."""
    assert data.up is not None
    force = data.up if data.force is None else np.where(data.forced[:, None], data.force, data.up)
    return sign * force


def roles(axis: str) -> dict[str, str]:
    """Return i, p, o as case axes, cyclic from the input axis."""
    start = COMPONENTS.index(axis)
    return {role: COMPONENTS[(start + k) % 3] for k, role in enumerate("ipo")}


def _term(name: str, axis: str) -> str:
    text = COEFFICIENTS[name][0]
    named = roles(axis)
    return "".join(named.get(mark, mark) for mark in text)


def formula_of(names: Sequence[str], axis: str) -> str:
    """Return the model that has the named coefficients of an output along an axis."""
    if tuple(names) == DEFAULT:
        return "ieee-odd"
    return " + ".join(_term(name, axis) for name in names)


def kept_coefficients(
    data: Readings, axis: str, sign: float, *, limited: bool, chosen: bool = False
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the coefficients that the points can tell, and in words what they cannot.

    `limited` says that the points are on part of a turn: there a coefficient beyond K0 and K1 is
    left out too whose u the others would make ten times as large, as the cosine of small angles is
    nearly a constant. Koq is left out where it enlarges the u of K3 by more than two, unless the
    model was `chosen`, or known forces separate the two.
    """
    force = applied_forces(data, sign)
    every = tuple(COEFFICIENTS)
    formula = " + ".join(_term(name, axis) for name in every)
    model = build_model(formula, data.outputs, (axis,))
    design = model.basis(force, {})[:, model.columns[0]]
    kept: list[int] = []
    faint: list[str] = []
    for column, name in enumerate(DEFAULT):
        trial = [*kept, column]
        if separability(design[:, trial], least_norm=ZERO_NORM).rank < len(trial):
            continue
        loss = _loss(design[:, kept], design[:, column]) if limited and column > 1 else 1.0
        if loss <= _FAINT:
            kept = trial
        else:
            faint.append(
                f"`{name}` hides behind the others on this part of a turn, which would make its u "
                f"{loss:.2g} times as large; it is taken as zero"
            )
    odd = None if data.forced.any() else _odd_loss(design, kept)
    if odd is not None and chosen:
        faint.append(f"`Koq`, where the model has it, makes the u of K3 {odd:.2g} times as large")
    elif odd is not None:
        kept.remove(DEFAULT.index("Koq"))
        faint.append(
            f"`Koq` would make the u of K3 {odd:.2g} times as large; it is taken as zero, which U "
            "leaves out (estimate it with --model ieee-odd)"
        )
    found = separability(design, least_norm=ZERO_NORM)
    said = name_combinations(found.null, every, rows="points")
    if kept[:2] != [0, 1]:
        raise RankError(
            f"{data.source or 'the readings'}: these points cannot separate K0 from K1 of "
            f"{data.outputs[0]}; give points with the input axis {axis} up and down, or leave the "
            "output out with --outputs.",
            rank=found.rank,
            parameters=found.parameters,
            combinations=said,
        )
    said = (*_with_squares(said, found.null, every), *faint)
    return tuple(every[column] for column in kept), said


def _odd_loss(design: Array, kept: Sequence[int]) -> float | None:
    """Return how many times Koq enlarges the u of K3, where that is too much."""
    K3, Koq = DEFAULT.index("K3"), DEFAULT.index("Koq")
    if K3 not in kept or Koq not in kept:
        return None
    others = [column for column in kept if column not in (K3, Koq)]
    with_it, without = (_loss(design[:, of], design[:, K3]) for of in ([*others, Koq], others))
    return with_it / without if with_it > _ODD * without else None


def _loss(others: Array, column: Array) -> float:
    """Return how many times the u of a coefficient is larger because of others."""
    Q, _ = np.linalg.qr(others)
    left = float(np.linalg.norm(column - Q @ (Q.T @ column)))
    return float(np.linalg.norm(column)) / left if left > 0.0 else math.inf


def _with_squares(said: tuple[str, ...], null: Array, names: Sequence[str]) -> tuple[str, ...]:
    """Return the sentences, the one on both cross squares said as what can be seen of them."""
    p, o = names.index("Kpp"), names.index("Koo")
    result = []
    for sentence, v in zip(said, null.T, strict=True):
        both = v[p] != 0.0 and v[o] != 0.0 and not (null[p] - null[o]).any()
        result.append(
            "of `Kpp` and `Koo` only the difference Kpp - Koo is identifiable, as "
            "a_i^2 + a_p^2 + a_o^2 = 1: " + sentence
            if both
            else sentence
        )
    return tuple(result)


def fitted_coefficients(calibration: Calibration, axis: str) -> dict[str, TumbleCoefficient]:
    """Return the coefficients of a calibration of one output along an axis."""
    c = calibration
    return ratios_to_k1(c.model, c.parameters, c.covariance, c.k, c.parameter_dof, axis)


def coefficients_beside(
    calibration: Calibration, axis: str, found: BesideTable
) -> dict[str, TumbleCoefficient]:
    """Return the coefficients that no error of the table does the same as, estimated beside all."""
    model, output = calibration.model, calibration.outputs[0]
    rows = [found.keys.index((output, str(term))) for _, term in model.keys]
    k = np.full(len(rows), coverage_factor(calibration.confidence, found.dof))
    every = ratios_to_k1(
        model,
        found.parameters[rows],
        found.covariance[np.ix_(rows, rows)],
        k,
        np.full(len(rows), found.dof),
        axis,
    )
    free = {
        name for name in every if found.identifiable[rows[model.index(output, _term(name, axis))]]
    }
    return {
        name: entry
        for name, entry in every.items()
        if name in free and (name == "K0" or "K1" in free)
    }


def those_that_hold(
    plain: dict[str, TumbleCoefficient],
    beside: Mapping[str, TumbleCoefficient],
    found: BesideTable | None,
    *,
    stated: bool,
) -> dict[str, TumbleCoefficient]:
    """Return the coefficients with no U that the table's errors would make too small.

    Where these are beyond chance, and the bench was not stated, a coefficient that can be
    identified beside them is the one estimated so; of the others, which lean on them, u and U are
    NaN.
    """
    if found is None or stated or not found.off:
        return plain
    return {name: beside.get(name) or _leaning(entry) for name, entry in plain.items()}


def find_without_u(found: Mapping[str, TumbleCoefficient]) -> Findings:
    """Say which coefficients have no U, and why."""
    names = [name for name, entry in found.items() if math.isnan(entry.U)]
    if not names:
        return ()
    text = f"no U of {', '.join(names)}: table errors, which residuals show, change them equally"
    action = "State the bench with state_bench."  # its zero turns as the input axis does
    if not all(name.startswith("delta") for name in names):
        action = "Roll again with the unit remounted by 90 degrees, and give `head_deg`."
    return (Finding("table", "warning", text, action),)


def find_hidden_table(
    found: Mapping[str, TumbleCoefficient], calibration: Calibration, axis: str
) -> Findings:
    """Say which coefficients the table may change without a residual, where they have a U."""
    c = calibration
    if errors_of(c.findings):
        return ()
    sizes = changes_unseen(c)
    if not sizes.any() or any(math.isnan(entry.U) for entry in found.values()):
        return ()
    scale = abs(found["K1"].value)
    changes = []
    for name, entry in found.items():
        size = float(sizes[c.model.index(c.outputs[0], _term(name, axis))])
        if size > 0.0:
            per = 1.0 if name == "K1" else scale
            changes.append((name, size / per, entry.unit or c.model.units[1], entry.U))
    action = "Roll again with the unit remounted by 90 degrees, and give `head_deg`."
    return (Finding("hidden-table", "note", in_words_of_unseen(changes), action),)


def _leaning(entry: TumbleCoefficient) -> TumbleCoefficient:
    custom = {**entry.customary, "u": math.nan, "U": math.nan}
    return replace(entry, u=math.nan, U=math.nan, customary=custom)


def ratios_to_k1(
    model: Model, parameters: Array, covariance: Array, k: Array, dof: Array, axis: str
) -> dict[str, TumbleCoefficient]:
    """Return the coefficients of eq. (1) from those of a model, their u by eq. (2).

    Raises
    ------
    UsageError, MultiposError
        The model has no K1, or K1 is zero.
    """
    output = model.outputs[0]
    try:
        scale = model.index(output, _term("K1", axis))
    except KeyError:
        raise UsageError(
            f"the model '{model.text}' has no term {_term('K1', axis)}; a tumble divides by K1."
        ) from None
    K1, variance1 = float(parameters[scale]), float(covariance[scale, scale])
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
        value, u, size, own = K1, math.sqrt(variance1), abs(_MILLION / K1), model.units[j]
        custom: dict[str, Any] = {}
        if name != "K1":
            ratio = float(parameters[j]) / K1
            shared = float(covariance[j, scale])
            variance = float(covariance[j, j]) - 2.0 * ratio * shared + ratio**2 * variance1
            u = math.nan if math.isnan(variance) else math.sqrt(max(variance, 0.0)) / abs(K1)
            value, size, own = sign * ratio, _MILLION, unit
            custom["value"] = size * value
        U = float(k[j]) * u
        custom |= {"u": size * u, "U": size * U, "unit": customary}
        result[name] = TumbleCoefficient(value, u, U, own, float(k[j]), float(dof[j]), custom)
    return result
