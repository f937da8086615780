"""Values beside their uncertainty: in a unit that people read, to the digits of u.

`derived_quantities` gives sensitivities, offsets and angles of a triad, `leaning_quantities` how
far the outputs of any sensor point to each other's axes (`leaning_table`); `quantity_rows` prints
such, and `parameter_cells` parameters. A row has one unit, by the larger of value and U (`with_u`);
a column of numbers of one unit has one as well (`column`).
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from multipos.files.numbers import (
    beside,
    beyond_rounding,
    common_units,
    decimals_of,
    fixed,
    most_of,
    number,
    plain_number,
    readable_unit,
)
from multipos.numerics.arrays import COMPONENTS, Array
from multipos.numerics.quantiles import coverage_factor
from multipos.reports.sections import PageTable
from multipos.sensor.calibration import Calibration
from multipos.sensor.derived import intrinsic_gradient
from multipos.sensor.found import Parameter
from multipos.uncertainty.propagation import Evaluation
from multipos.units import unit_per

QUANTITY_HEADER = ("Quantity", "Value", "U", "Unit", "k")


class Quantity(NamedTuple):
    """A quantity with its uncertainty."""

    name: str
    unit: str
    value: float
    u: float
    U: float
    k: float


class Column(NamedTuple):
    """Numbers of one unit as cells, and the unit."""

    unit: str
    cells: list[str]


def derived_quantities(c: Calibration, budget: Evaluation) -> list[Quantity]:
    """Return sensitivities, offsets, angles between axes and mounting of a triad; else nothing.

    What the gauge has fixed is left out.
    """
    if c.intrinsic is None:
        return []
    values, gradient = intrinsic_gradient(c.model, c.parameters, c.mean_environment)
    u, dof, _ = budget.combine(gradient)
    per = unit_per(c.model.unit, 1, (), c.field.unit)
    names = [
        *((f"Sensitivity of {o}", per) for o in c.outputs),
        *((c.field.worded(f"Offset of {o}"), c.field.printed) for o in c.outputs),
        *((f"Angle between input axes {p}", "deg") for p in ("xy", "xz", "yz")),
        *((f"Mounting, rotation about {a}", "deg") for a in COMPONENTS),
    ]
    if c.model.gauge is not None:
        names = names[:-3]
    found = zip(names, values.tolist(), u.tolist(), dof.tolist(), strict=False)
    quantities = []
    for (name, unit), value, sd, nu in found:
        k = coverage_factor(c.confidence, nu)
        quantities.append(Quantity(name, unit, value, sd, k * sd, k))
    for i, p in enumerate((c[output, "1"] for output in c.outputs), start=len(c.outputs)):
        of_readings = Quantity(quantities[i].name, p.unit, p.value, p.u, p.U, p.k)
        quantities[i] = c.field.zero(quantities[i], of_readings)
    return quantities


def leaning_quantities(c: Calibration) -> list[Quantity]:
    """Return how far each output leans to the others; without what the gauge has fixed."""
    return [
        Quantity(
            f"Output on {pair[0]}, tilt to {pair[1]}",
            "deg",
            angle["value"],
            angle["u"],
            angle["U"],
            angle["U"] / angle["u"],
        )
        for pair, angle in c.installation_deg.items()
        if angle["u"]
    ]


def leaning_table(c: Calibration) -> tuple[PageTable, ...]:
    """Return the table of `leaning_quantities`, where there are any."""
    rows = tuple(quantity_rows(leaning_quantities(c)))
    return (PageTable("Installation", QUANTITY_HEADER, rows),) if rows else ()


def quantity_rows(found: Sequence[Quantity]) -> list[tuple[str, ...]]:
    """Return name, value, U, unit and k of each; those of one unit have it in common."""
    units = common_units((q.unit, most_of(q.value, q.U)) for q in found)
    rows: list[tuple[str, ...]] = []
    for q in found:
        factor, unit = units[q.unit]
        shown = beside(factor * q.value, factor * q.u, factor * q.U)
        rows.append((q.name, *shown, unit, plain_number(q.k, 3)))
    return rows


def parameter_cells(entries: Iterable[Parameter]) -> list[tuple[str, str, str, str]]:
    """Return value, u, U and unit of parameters; those of one unit have it in common."""
    given = list(entries)
    units = common_units((p.unit, most_of(p.value, p.U)) for p in given)
    return [with_u(p.value, p.u, p.U, units[p.unit]) for p in given]


def with_u(
    value: float, u: float, U: float, unit: str | tuple[float, str]
) -> tuple[str, str, str, str]:
    """Return a value, its u and its U to the digits of u, and the unit of all three.

    `unit` is that of the numbers, or the one to print with its factor, as of `common_units`.
    """
    factor, shown = readable_unit(most_of(value, U), unit) if isinstance(unit, str) else unit
    decimals = decimals_of(factor * u)
    value_cell, U_cell = beside(factor * value, factor * u, factor * U)
    return value_cell, "-" if decimals is None else f"{factor * u:.{decimals}f}", U_cell, shown


def column(
    values: Sequence[float] | Array,
    unit: str | tuple[float, str],
    u: float | None = None,
    *,
    signed: bool = False,
    scale: float = 1.0,
) -> Column:
    """Return numbers as cells of one unit, to the digits of `u`, else to three.

    What is but the rounding of numbers of size `scale` is 0. `unit` is that of the numbers, or
    the one to print with its factor, as of `readable_unit`.
    """
    values = [beyond_rounding(x, scale) for x in np.asarray(values, dtype=np.float64).tolist()]
    u = None if u is None else beyond_rounding(u, scale)
    sizes = np.abs(np.asarray(values))
    if isinstance(unit, str):
        unit = readable_unit(float(np.max(sizes[np.isfinite(sizes)], initial=0.0)), unit)
    factor, shown = unit
    decimals = None if u is None else decimals_of(factor * u)
    cells = []
    for value in (factor * np.asarray(values, dtype=np.float64)).tolist():
        if not np.isfinite(value):
            cells.append(number(value))
        elif decimals is None:
            sign = "+" if signed and value > 0.0 else ""
            cells.append(sign + plain_number(value))
        else:
            cells.append(fixed(value, decimals, signed=signed))
    return Column(shown, cells)
