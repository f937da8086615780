"""What a header says: names as they are known here, and units, of readings and of other data.

Outputs are in the unit that their header says. A column in a unit of temperature, time or pressure
is about the surroundings and no output. Temperatures are in degrees Celsius everywhere; a header in
kelvin is believed, and

    t/°C = T/K − 273.15.                                                                    (1)
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

from multipos.errors import MultiposError
from multipos.files.tables import Table
from multipos.positions import attitudes
from multipos.positions.column_names import split_unit, unit_of
from multipos.positions.forces import REFERENCE_U

# Columns of a readings file that have a meaning of their own and are no outputs.
RESERVED = attitudes.COLUMNS | {"position", "n", "orientation_sd_deg", "group", *REFERENCE_U}
OF_SURROUNDINGS = frozenset({"K", "°C", "s", "ms", "us", "ns", "hPa", "Pa", "Hz", "%"})
_KELVIN = "K"
_ZERO = 273.15  # [K] at 0 °C


def plain_names(table: Table) -> tuple[Table, dict[str, str]]:
    """Return a table whose names have no unit in brackets and known names their own case.

    Returns
    -------
    (Table, {column: unit})
    """
    bare = {name: split_unit(name) for name in table.columns}
    if len({name for name, _ in bare.values()}) < len(bare):
        bare = {name: (name, None) for name in table.columns}  # the units tell columns apart
    known = _own_case([name for name, _ in bare.values()])
    renamed, units = {}, {}
    for name, (written, unit) in bare.items():
        plain = known[written]
        renamed[plain] = table.columns[name]
        if unit is not None:
            units[plain] = unit
    return replace(table, columns=renamed), units


def _own_case(names: Sequence[str]) -> dict[str, str]:
    """Return names as they are known here; those that differ in case alone stay as written."""
    known = {name.casefold(): name for name in (*RESERVED, "temperature", "time")}
    beside = {f"{p}_{name}".casefold(): f"{p}_{name}" for p in ("u", "sd") for name in names}
    folded = Counter(name.casefold() for name in names)

    def own(name: str) -> str:
        if folded[name.casefold()] > 1:
            return name
        return known.get(name.casefold()) or beside.get(name.casefold()) or _as_environment(name)

    return {name: own(name) for name in names}


def _as_environment(name: str) -> str:
    """Return a name of the surroundings in small letters, where it is one in any."""
    folded = name.casefold()
    return folded if is_environment(folded) and not is_environment(name) else name


def find_column(table: Table, name: str) -> str:
    """Return the name that a column has, whatever the case and the unit it is asked for with."""
    if name in table:
        return name
    folded = split_unit(name)[0].casefold()
    alike = [own for own in table.columns if own.casefold() == folded]
    return alike[0] if len(alike) == 1 else name


def unit_as_known(unit: str) -> str:
    """Return a unit of acceleration as it is called here: m/s2, mps2 and m/s**2 are m/s^2."""
    known = unit_of(unit)
    return known if known in ("m/s^2", "g", "mg", "ug") else unit


def unit_of_outputs(
    table: Table, names: tuple[str, ...], units: Mapping[str, str], stated: str | None
) -> str:
    """Return the unit of the outputs, of their header or as stated.

    Raises
    ------
    MultiposError
        The outputs differ in unit, or the header contradicts what is stated.
    """
    written = {name: units[name] for name in names if name in units}
    kinds = sorted(set(written.values()))
    if len(kinds) > 1:
        said = ", ".join(f"{name} in {unit}" for name, unit in written.items())
        raise MultiposError(f"{table.source}: outputs differ in unit, {said}; give them in one.")
    if stated is None:
        return kinds[0] if kinds else "reading"
    asked = unit_as_known(stated)
    if kinds and kinds[0] != asked and kinds[0] != unit_of(asked):
        first = next(iter(written))
        raise MultiposError(
            f"{table.source}: the header gives column '{first}' in {kinds[0]}, and --unit says "
            f"{stated}; correct one, or leave --unit away."
        )
    return asked


def is_environment(name: str) -> bool:
    """Tell whether a column is about the surroundings by its name."""
    surroundings = ("temperature", "time", "head_deg")  # the last, of the head that turns the case
    return name in surroundings or name.startswith("ambient") or name.endswith("_rate")


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
