"""Choice of a calibration's terms: stepwise, one output at a time, over positions and temperatures.

A formula with temperature terms, such as `1 + x + y + z + temperature + temperature*own + …`, lists
candidates; each output keeps those of them that its readings support
(`multipos.numerics.selection`). Its constant and the term of its own axis always stay: without bias
and scale factor there is no calibration. Readings that state their uncertainty are weighted by it.

What was chosen by looking at the data looks better in the same data than it is: u and p of the
terms kept are those of a model fixed beforehand, and too good.
"""

from dataclasses import replace

import numpy as np

from multipos.estimation.known import solve_known
from multipos.finding import Finding
from multipos.fitting.completion import add_findings
from multipos.numerics.arrays import Array
from multipos.numerics.selection import Selection, Thresholds, compress, select_stepwise
from multipos.numerics.terms import CONSTANT, linear_term
from multipos.positions.readings import Readings, select_outputs
from multipos.sensor.calibration import Calibration
from multipos.sensor.found import Chosen
from multipos.sensor.model import Model

OPTIMISTIC = Finding(
    "selected-terms",
    "note",
    "terms were chosen stepwise by the readings that test them: U of the terms kept is too small, "
    "and omitted terms are taken as zero",
)


def select_terms(
    model: Model, reference: Array, readings: Readings, limits: Thresholds | None = None
) -> tuple[Model, dict[str, Chosen]]:
    """Return the model with the terms that the readings support, and how they were chosen.

    Parameters
    ----------
    model : Model
        With all candidate terms.
    reference : (n, 3) array [g]
        Known, or estimated beforehand where the orientation is not.
    readings : Readings
    limits : Thresholds, optional
        p to enter .05 and to remove .10 by default.

    Returns
    -------
    Model
    dict of output to Chosen

    Raises
    ------
    RankError
        The positions cannot separate a bias and a scale factor, which always stay.
    """
    limits = limits or Thresholds()
    phi = model.basis(reference, readings.environment)
    weight = _weights(readings)
    keys: list[tuple[str, str]] = []
    record: dict[str, Chosen] = {}
    for i, (output, axis, terms) in enumerate(
        zip(model.outputs, model.axes, model.terms, strict=True)
    ):
        names = [str(term) for term in terms]
        always = {CONSTANT, linear_term(axis)}
        forced = [j for j, term in enumerate(terms) if term in always]
        if forced:  # what stays whatever the readings say, they must be able to tell
            smallest = model.only(output).keeping([(output, names[j]) for j in forced])
            solve_known(smallest, reference, select_outputs(readings, (output,)))
        w = weight[:, i]
        triangle = compress(phi[:, model.columns[i]] * w[:, None], readings.values[:, i] * w)
        found = select_stepwise(triangle, names, limits, forced=forced)
        keys += [(output, names[j]) for j in found.columns]
        record[output] = _chosen(found, names)
    return model.keeping(keys), record


def with_selection(calibration: Calibration, record: dict[str, Chosen]) -> Calibration:
    """Return a calibration that carries how its terms were chosen, and says what that means."""
    return add_findings(replace(calibration, selection=record), OPTIMISTIC)


def _weights(readings: Readings) -> Array:
    if readings.u is not None:
        return 1.0 / readings.u
    if readings.covariance is not None:
        return 1.0 / np.sqrt(np.diag(readings.covariance)).reshape(readings.values.shape)
    return np.ones_like(readings.values)


def _chosen(found: Selection, names: list[str]) -> Chosen:
    best = found.runner_up
    return Chosen(
        terms=tuple(names[j] for j in found.columns),
        path=tuple(
            {"step": s.step, "action": s.action, "term": s.term, "F": s.F, "p": s.p}
            for s in found.path
        ),
        runner_up=None if best is None else {"term": best.term, "F": best.F, "p": best.p},
        collinear=tuple(found.collinear),
    )
