"""What more positions bring: designs of several sizes, up to the one that was asked for."""

from collections.abc import Callable

from multipos.designs.result import Design
from multipos.errors import MultiposError, UsageError

_SIZES = 8  # of designs in a curve; each is a search of its own


def smaller_designs(make: Callable[[int], Design], found: Design) -> tuple[Design, ...]:
    """Return designs of fewer positions and the one that was found, fewest first.

    Parameters
    ----------
    make : callable
        Returns the design of so many positions, as the one that was found was made.
    found : Design

    Returns
    -------
    tuple of Design
        At most eight, evenly spread; sizes that cannot separate the parameters are left out.
    """
    most = len(found.positions)
    step = max(1, most // _SIZES)
    designs = [found]
    for count in range(most - step, found.included, -step):
        try:
            designs.append(make(count))
        except (MultiposError, UsageError):  # too few, and so are all that are fewer
            break
    return tuple(reversed(designs[:_SIZES]))
