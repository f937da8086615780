"""What the units in a header mean for readings, and for what a calibration is applied to.

Outputs are in the unit that their header says. A column in a unit of temperature, time or pressure
is about the surroundings and no output. Temperatures are in degrees Celsius everywhere; a header in
kelvin is believed, and

    t/°C = T/K − 273.15.                                                                    (1)
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from multipos.errors import MultiposError
from multipos.files.tables import Table
from multipos.positions.column_names import unit_of

OF_SURROUNDINGS = frozenset({"K", "°C", "s", "ms", "us", "ns", "hPa", "Pa", "Hz", "%"})
_KELVIN = "K"
_ZERO = 273.15  # [K] at 0 °C


def in_celsius(table: Table, units: Mapping[str, str], notes: list[str]) -> Table:
    """Return a table whose columns in kelvin, by their header, are in degrees Celsius; eq. (1)."""
    kelvin = [n for n, unit in units.items() if unit == _KELVIN and not table.is_text(n)]
    if not kelvin:
        return table
    notes += [f"column '{name}' is in K by its header; 273.15 is subtracted" for name in kelvin]
    moved = {name: table.number(name, empty=True) - _ZERO for name in kelvin}
    return replace(table, columns={**table.columns, **moved})


def require_units(
    source: str, units: Mapping[str, str], outputs: Sequence[str], columns: Sequence[str], unit: str
) -> None:
    """Refuse data whose header says another unit than a calibration is in.

    Parameters
    ----------
    source : str
        The data, for the message.
    units : mapping of str to str
        What the header says, by column.
    outputs, columns : sequences of str
        The outputs of the calibration, and the other columns that its model uses.
    unit : str
        That of its readings; where it is none that is known, no header contradicts it.

    Raises
    ------
    MultiposError
    """
    own = unit_of(unit)
    for name in outputs:
        if own is not None and units.get(name, own) != own:
            raise MultiposError(
                f"{source}: the header gives column '{name}' in {units[name]}, and the calibration "
                f"is in {unit}; convert the column, or take a calibration in its unit."
            )
    for name in columns:
        if units.get(name) == _KELVIN:
            raise MultiposError(
                f"{source}: the header gives column '{name}' in K, and the calibration takes "
                "degrees Celsius; subtract 273.15."
            )
