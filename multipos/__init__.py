"""multipos calibrates accelerometers from static positions in gravity.

A scheme gives references, readings are averaged, a model is fitted, a calibration comes out
with its uncertainty, and everything else reads that calibration.

Conventions
-----------
Case axes x, y, z are right-handed; `u` is the unit vector pointing up, in case axes. Under the
convention 'specific-force' the reference of a position is +u (the axis that points up reads
+1), under 'gravity' it is −u. References are in g, angles inside are radians; degrees carry
``_deg`` in their names. Residual = reading − model.

The names in the stub beside this file, which type checkers read, are imported when they are first
used, so that the command line starts quickly.
"""

import re
from importlib import import_module
from pathlib import Path
from typing import Any

__version__ = "0.3.0"


def names_in_stub(file: str) -> dict[str, str]:
    """Return which module has each name that the stub beside a file imports."""
    stub = Path(file).with_suffix(".pyi").read_text(encoding="utf-8")
    found = re.findall(r"^ *from (\S+) import (\w+) as \2$", stub, re.MULTILINE)
    return {name: module for module, name in found}


_PUBLIC = names_in_stub(__file__)
__all__ = sorted([*_PUBLIC, "__version__"])


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module 'multipos' has no attribute '{name}'")
    value = getattr(import_module(_PUBLIC[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
