"""Cautions about what nothing checks: as many parameters as readings, or hardly fewer.

A fit with no degrees of freedom passes through every reading, right or wrong, and its residuals,
zero to rounding, say nothing. With orientations unknown a position is one equation, however
many outputs it has.
"""

from multipos.sensor.calibration import Calibration
from multipos.sensor.doubt import Doubt
from multipos.sensor.found import Estimator

_POOR = 0.02  # U of a linear term, as a share of the scale factor of its output


def no_redundancy(c: Calibration) -> Doubt | None:
    """Find fits that nothing checks."""
    n = len(c.readings)
    if c.estimator == Estimator.UNKNOWN:
        spare = n - len(c.parameters)
    elif c.estimator.exact:
        spare = n - max(len(terms) for terms in c.model.terms)
    else:
        return None
    if spare <= 0:
        return Doubt(
            "no-redundancy",
            "caution",
            f"{n} positions for as many parameters: the fit passes through every reading and "
            "nothing shows whether it is right; add positions",
        )
    return _poorly_known(c) if c.estimator == Estimator.UNKNOWN else None


def _poorly_known(c: Calibration) -> Doubt | None:
    """Find linear terms that positions of unknown orientation leave nearly open."""
    scale = {c.model.keys[i][0]: abs(float(c.parameters[i])) for i in c.model.own_scales}
    poor = [
        (name, size / scale[output])
        for (output, term), name, size in zip(c.model.keys, c.names, c.U.tolist(), strict=True)
        if term.along is not None and output in scale and size > _POOR * scale[output]
    ]
    if not poor:
        return None
    said = ", ".join(f"{name} to {1e3 * share:.2g} mrad" for name, share in poor[:4])
    return Doubt(
        "no-redundancy",
        "caution",
        f"the positions hardly tell some parameters: {said} (U); add positions that differ more",
    )
