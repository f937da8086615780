"""Units as people write them in a header.

`unit_of` returns the unit that a text is, `split_unit` a name and the unit in brackets behind it.

What is in brackets is a unit only where it is known as such: in ``accelerometer_m_s2[0]`` it is a
number.
"""

import re

from multipos.files.spelling import packaged_pairs
from multipos.units import STANDARD_GRAVITY

# As a unit is called here, and as a header may write it, without blanks and in small letters.
_WRITTEN = packaged_pairs(__file__, "units.csv")
UNITS = {written: unit for unit, all_ in _WRITTEN.items() for written in all_.split()}
MAGNETIC_UNITS = ("T", "mT", "uT", "nT", "G", "mG")
PER_G = {"g": 1.0, "m/s^2": STANDARD_GRAVITY, "mg": 1e3, "ug": 1e6}
_BRACKETS = re.compile(r"(.*?)[\s_]*[\[(]\s*([^\[\]()]+?)\s*[\])]")


def unit_of(written: str) -> str | None:
    """Return the unit that a text is, None where it is none that is known."""
    plain = written.replace(" ", "")
    # A capital tells gauss from g and tesla from time.
    return plain if plain in MAGNETIC_UNITS else UNITS.get(plain.casefold())


def split_unit(name: str) -> tuple[str, str | None]:
    """Return a name and the unit in brackets behind it; G of an acceleration is g."""
    found = _BRACKETS.fullmatch(name)
    unit = unit_of(found[2]) if found else None
    if found and unit in ("G", "mG") and "acc" in found[1].casefold():
        unit = unit.lower()
    return (found[1], unit) if found and unit and found[1] else (name, None)
