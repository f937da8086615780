"""What is stated of the parameters of a model beside its readings: starts, bounds and priors.

A `StatedModel` takes them through the search for the parameters; a `Model` is one, of which nothing
is stated but in a user-defined model.

A parameter with bounds is searched for as t, without bounds,

    p = low + (high - low)(1 + sin t)/2,    p = low - 1 + sqrt(t^2 + 1)  or its mirror,     (1)

and one with a prior N(start, sd^2) adds ((p - start)/sd)^2 to what the search makes least.

Source of (1): F. James, MINUIT Reference Manual, CERN Program Library D506, section 1.3.
"""

from dataclasses import field, replace
from functools import cached_property
from typing import Self

import numpy as np

from multipos.finding import Finding, Findings
from multipos.numerics.arrays import Array
from multipos.results import Result, frozen
from multipos.sensor.model_text import StatedParameter

_INSIDE = 1e-6  # of the way between bounds that a start keeps from them, where (1) has no slope


@frozen(eq=True)
class StatedModel(Result):
    """A model whose parameters have starts, bounds and priors, where they are stated.

    Attributes
    ----------
    inner : bool
        Whether parameters are the unbounded ones, t of eq. (1).
    """

    inner: bool = field(default=False, kw_only=True)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        raise NotImplementedError

    @property
    def quantities(self) -> tuple[StatedParameter, ...]:
        """What is stated of each parameter."""
        raise NotImplementedError

    @cached_property
    def starts(self) -> Array:
        """Where the search for each parameter starts (p,), NaN where nothing is stated."""
        given = [np.nan if q.start is None else q.start for q in self.quantities]
        return np.array(given, dtype=np.float64)

    @cached_property
    def beliefs(self) -> Array:
        """The information of the priors (p,), 0 where there is none."""
        return np.array([0.0 if q.sd is None else q.sd**-2 for q in self.quantities])

    @property
    def bounded(self) -> bool:
        """Whether a parameter has bounds, and is not searched for as t yet."""
        return not self.inner and any(quantity.bounded for quantity in self.quantities)

    def belief(self, parameters: Array) -> tuple[Array, Array]:
        """Return the excess (…, p) of parameters over their priors in sd, and its slopes."""
        outer, slope = self.outward(parameters)[:2] if self.inner else (parameters, 1.0)
        root = np.sqrt(self.beliefs)
        centre = np.where(root > 0.0, np.nan_to_num(self.starts), outer)
        return root * (outer - centre), root * slope

    def within(self, parameters: Array) -> Array:
        """Return parameters (p,) within their bounds."""
        low = [quantity.low for quantity in self.quantities]
        return np.clip(parameters, low, [quantity.high for quantity in self.quantities])

    def unbounded(self) -> Self:
        """Return the model of parameters without bounds, which `inward` and `outward` turn."""
        return replace(self, inner=True)

    def outward(self, inner: Array) -> tuple[Array, Array, Array]:
        """Return the parameters of unbounded ones, their slopes and second derivatives, (…, p)."""
        outer, slope, second = inner.copy(), np.ones(inner.shape), np.zeros(inner.shape)
        for i, q in enumerate(self.quantities):
            t = inner[..., i]
            if np.isfinite(q.low) and np.isfinite(q.high):
                half = (q.high - q.low) / 2.0
                outer[..., i], slope[..., i] = q.low + half * (1.0 + np.sin(t)), half * np.cos(t)
                second[..., i] = (q.low + q.high) / 2.0 - outer[..., i]
            elif q.bounded:
                side = 1.0 if np.isfinite(q.low) else -1.0
                end = q.low if np.isfinite(q.low) else q.high
                root = np.hypot(t, 1.0)
                outer[..., i], slope[..., i] = end + side * (root - 1.0), side * t / root
                second[..., i] = side * root**-3
        return outer, slope, second

    def bend(self, inner: Array, gradient: Array) -> Array:
        """Return what the curvature of bounds adds to the information of unbounded ones, (…, p).

        Near a bound at which the best fit lies p' is next to nothing, and −g p''/p' is all there
        is to keep a step short; `gradient` (…, p) is g by t.
        """
        if not self.inner:
            return np.zeros(inner.shape)
        _, slope, second = self.outward(inner)
        added = -gradient * second / np.where(slope == 0.0, np.inf, slope)
        return np.asarray(np.fmax(0.0, added))

    def inward(self, outer: Array) -> Array:
        """Return the unbounded parameters (p,) of parameters, a little inside the bounds."""
        inner = outer.copy()
        for i, q in enumerate(self.quantities):
            if np.isfinite(q.low) and np.isfinite(q.high):
                share = (outer[i] - q.low) / (q.high - q.low)
                inner[i] = np.arcsin(2.0 * np.clip(share, _INSIDE, 1.0 - _INSIDE) - 1.0)
            elif q.bounded:
                away = outer[i] - q.low if np.isfinite(q.low) else q.high - outer[i]
                away = max(away, _INSIDE)
                inner[i] = np.sqrt(away * (away + 2.0))
        return inner

    def at_bounds(self, parameters: Array) -> Findings:
        """Name the parameters (p,) that ended at a bound."""
        said = []
        for name, q, value in zip(self.names, self.quantities, parameters.tolist(), strict=True):
            reach = _INSIDE * min(q.high - q.low, max(abs(value), 1.0))
            for word, end in (("low", q.low), ("high", q.high)):
                if abs(value - end) <= reach:
                    text = (
                        f"`{name}` is at its bound, {word} = {end:g}; the best fit may lie beyond"
                    )
                    said.append(Finding("at-bound", "warning", text, "Widen the bound."))
        return tuple(said)
