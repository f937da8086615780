"""Figures, each a function that draws on a matplotlib axes it is given.

`new_figure` makes a figure that knows nothing of the screen, `render` gives it as SVG, PNG or PDF,
the same bytes for the same drawing. Open `style` first, where both stand. This room alone is public
as it is: users draw on axes of their own.
"""

from importlib import import_module
from typing import Any

from multipos import names_in_stub

# Read when first used: what draws one figure need not know the others' results.
_NAMES = names_in_stub(__file__)
__all__ = sorted(_NAMES)


def __getattr__(name: str) -> Any:
    if name not in _NAMES:
        raise AttributeError(f"module 'multipos.plots' has no attribute '{name}'")
    return getattr(import_module(_NAMES[name]), name)
