"""What a fit says of itself: linearity, lack of fit, equal variances, tests of the model.

- `Diagnostics` is what is found about a fit; `ModelTest` a test of a term that a model lacks, and
  `NoiseTest` one of the stated noise.
- `linearity` is the departure of each output from a line.
- `bartlett` and `are_unequal` tell whether variances of outputs are equal.
- `lack_of_fit` and `lack_of_fit_ratios` test the model by repeated positions.

Linearity of an output against its own reference: with the least-squares line through the
readings and its span S from −1 to +1 g (where forces are known, to the largest), the largest
|reading − line| and the largest |residual of the model|, both over S, in percent.

In a test of a term each output by itself has a ratio R_i that follows F(q_i, ν_i) if nothing is in
the term. Their p values P_i combine to

    X = −2 sum ln P_i,   chi² on 2M degrees of freedom,                                     (1)

(R. A. Fisher, *Statistical Methods for Research Workers*, 1932, section 21.1); outputs that are
tested together have one R ~ F(q, ν). `multipos.diagnostics.score_tests` says how R comes about.
"""

import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import field
from functools import cached_property
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from multipos.files.records import (
    DOF,
    FIGURE,
    NOT_NEGATIVE,
    P_VALUE,
    Fields,
    Figure,
    Listed,
    Maybe,
    Named,
    NotNegative,
    Numbers,
)
from multipos.files.schema import NOWHERE, Stored, also
from multipos.finding import Findings, findings_upgraded
from multipos.numerics import quantiles
from multipos.numerics.arrays import COMPONENTS, Array, Mask, Places
from multipos.results import Result, frozen
from multipos.sensor.model import Model

_LEAST = 1e-300  # of a probability, whose logarithm is a number still


_BY_OUTPUT = Named(Fields({"F": NOT_NEGATIVE, "dof": Listed(DOF, 2, 2)}))


@frozen
class ModelTest(Result):
    """A test of one kind of term, outputs together.

    Attributes
    ----------
    term : str
        As in a formula, with `own` and `other` for the axes.
    outputs : tuple of str
        Those tested by themselves; empty where all are tested as one.
    ratios : tuple of float
        R of each, or the one of all.
    dofs : tuple of (q, ν)
    """

    term: str
    outputs: Annotated[tuple[str, ...], NOWHERE]
    ratios: Annotated[tuple[float, ...], NOWHERE]
    dofs: Annotated[tuple[tuple[float, float], ...], NOWHERE]

    _also = (
        also("statistic", NOT_NEGATIVE, Stored(after="term")),
        also("dof", Listed(DOF, 1, 2), Stored(after="term")),
        also("p", P_VALUE, Stored(after="term")),
        also("by_output", _BY_OUTPUT, Stored("outputs", optional=True, after="term")),
    )

    @classmethod
    def _from_file(
        cls,
        term: str,
        statistic: float,
        dof: tuple[float, ...],
        p: float,
        by_output: Mapping[str, Any] | None = None,
    ) -> "ModelTest":
        """Return the test that a file holds; its p follows."""
        if not by_output:
            return cls(term, (), (statistic,), (_pair(dof),))
        dofs = tuple(_pair(each["dof"]) for each in by_output.values())
        return cls(term, tuple(by_output), tuple(e["F"] for e in by_output.values()), dofs)

    def __post_init__(self) -> None:
        """Tuples of numbers are frozen as they are."""

    @cached_property
    def statistic(self) -> float:
        """X of eq. (1), or R where there is one."""
        if len(self.ratios) == 1:
            return self.ratios[0]
        tails = (quantiles.f_tail(f, *dof) for f, dof in zip(self.ratios, self.dofs, strict=True))
        return -2.0 * sum(math.log(max(p, _LEAST)) for p in tails)

    @property
    def dof(self) -> tuple[float, ...]:
        """Degrees of freedom: one of chi², two of F."""
        return self.dofs[0] if len(self.ratios) == 1 else (2.0 * len(self.ratios),)

    @cached_property
    def p(self) -> float:
        """How often chance alone does the same."""
        if len(self.ratios) == 1:
            return quantiles.f_tail(self.ratios[0], *self.dofs[0])
        return quantiles.chi2_tail(self.statistic, *self.dof)

    def __str__(self) -> str:
        law = "F" if len(self.dof) == 2 else "chi2"
        return f"{law}({', '.join(f'{v:.4g}' for v in self.dof)}) = {self.statistic:.3g}"

    @property
    def gain(self) -> float:
        """What the term adds to twice the logarithm of the likelihood, less two a parameter."""
        pairs = zip(self.ratios, self.dofs, strict=True)
        return sum((q + nu) * math.log1p(q * f / nu) - 2.0 * q for f, (q, nu) in pairs)

    @property
    def by_output(self) -> dict[str, dict[str, Any]]:
        """The F and dof of each output that is tested by itself."""
        triples = zip(self.outputs, self.ratios, self.dofs, strict=bool(self.outputs))
        return {output: {"F": f, "dof": dof} for output, f, dof in triples}


def _pair(dof: Sequence[float]) -> tuple[float, float]:
    q, nu = dof
    return float(q), float(nu)


UNEQUAL = 0.05  # level at which outputs are called unequally noisy


class NoiseTest(NamedTuple):
    """chi² of the residuals under the stated noise alone, on its degrees of freedom."""

    chi2: NotNegative
    dof: Annotated[float, DOF]


_LACK_OF_FIT = Fields({"F": FIGURE, "dof": Maybe(Numbers(1)), "p": P_VALUE})


@frozen
class Diagnostics(Result):
    """What was found about a fit.

    Attributes
    ----------
    rank, parameters : int
    condition : float
        Largest 2-norm condition of the column-scaled, whitened designs.
    leverage : (n, M) array
    lack_of_fit : mapping of output to {F, dof, p}
        Against the spread of repeated positions; empty where none repeats.
    outliers, unidentifiable : tuples of str
    findings : tuple of Finding
        The most serious first.
    model_tests : tuple of ModelTest
        Of every standard term up to third order that the model lacks and the positions show.
    hidden : tuple of str
        Terms of that set that the positions cannot show.
    claim : NoiseTest or None
        How the residuals stand to the stated noise, where there is one.
    """

    rank: int
    parameters: int
    condition: Figure
    leverage: Annotated[Array, Numbers(2, gaps=True)]
    lack_of_fit: Annotated[Mapping[str, Mapping[str, object]], Named(_LACK_OF_FIT)] = field(
        default_factory=dict
    )
    outliers: tuple[str, ...] = ()
    unidentifiable: tuple[str, ...] = ()
    hidden: tuple[str, ...] = ()
    claim: NoiseTest | None = None
    findings: Findings = ()
    model_tests: tuple[ModelTest, ...] = ()

    @staticmethod
    def _upgraded(content: Mapping[str, Any]) -> Any:
        """Return what a file says; version 0.1 had less."""
        return {"hidden": [], "claim": None, "model_tests": [], **findings_upgraded(content)}


def linearity(
    model: Model,
    reference: Array,
    values: Array,
    residuals: Array,
    *,
    reach: float | None = 1.0,
) -> dict[str, dict[str, float]]:
    """Return {output: {without_model_percent, with_model_percent}}; NaN where no line fits.

    The span is that of ± `reach`, where it is None of the largest force along the axis.
    """
    result = {}
    for column, (output, axis) in enumerate(zip(model.outputs, model.axes, strict=True)):
        own = reference[:, COMPONENTS.index(axis)]
        reading = values[:, column]
        centred = own - own.mean()
        square = float(centred @ centred)
        if square < 1e-18:
            result[output] = {"without_model_percent": np.nan, "with_model_percent": np.nan}
            continue
        slope = float(centred @ reading) / square
        from_line = reading - reading.mean() - slope * centred
        largest = float(np.abs(own).max()) if reach is None else reach
        span = abs(2.0 * slope) * largest or np.nan
        result[output] = {
            "without_model_percent": 100.0 * float(np.abs(from_line).max()) / span,
            "with_model_percent": 100.0 * float(np.abs(residuals[:, column]).max()) / span,
        }
    return result


def bartlett(rss: ArrayLike, dof: ArrayLike) -> float:
    """Bartlett's test: p value of the hypothesis that several residual variances are equal.

    Parameters
    ----------
    rss : (m,) array
        Sums of squared residuals.
    dof : float or (m,) array
        Their degrees of freedom.

    Returns
    -------
    float
        Small where equality is to be rejected; nan for fewer than two variances, where one has no
        degree of freedom, or where all are zero.
    """
    rss, dof = np.broadcast_arrays(
        np.asarray(rss, dtype=np.float64), np.asarray(dof, dtype=np.float64)
    )
    m = rss.size
    if m < 2 or not (dof > 0.0).all() or not rss.any():
        return float("nan")
    if (rss == 0.0).any():
        return 0.0
    return quantiles.chi2_tail(float(_statistic(rss, dof)), m - 1)


def are_unequal(rss: Array, dof: Array) -> Mask:
    """Tell of which units (B,) Bartlett's test rejects that variances are equal, rss (B, m)."""
    with np.errstate(divide="ignore", invalid="ignore"):  # inf where one is zero, nan where all are
        statistic = _statistic(rss, dof)
    return np.asarray(statistic > quantiles.chi2_quantile(1.0 - UNEQUAL, len(dof) - 1))


def _statistic(rss: Array, dof: Array) -> Array:
    """Return Bartlett's statistic (…), corrected, of (…, m) sums on (m,) degrees of freedom."""
    total = dof.sum()
    pooled = total * np.log(rss.sum(axis=-1) / total)
    correction = 1.0 + ((1.0 / dof).sum() - 1.0 / total) / (3.0 * (len(dof) - 1))
    return np.asarray((pooled - (dof * np.log(rss / dof)).sum(axis=-1)) / correction)


def lack_of_fit(
    residuals: ArrayLike,
    groups: Sequence[Hashable] | NDArray[np.generic],
    parameters: int,
    *,
    sd: ArrayLike = 1.0,
) -> tuple[float, int, int, float] | None:
    """F test of the model's own error against the scatter of repeated rows.

    Rows of one group share their row of the design, so their residuals scatter about the mean of
    the group by noise alone (pure error); the means scatter by noise and by what the model lacks.

    Parameters
    ----------
    residuals : (n,) array
    groups : sequence of n labels
    parameters : int
        Number of coefficients fitted.
    sd : float or (n,) array
        Standard deviation of each row, up to a common factor.

    Returns
    -------
    (F, dof_lack, dof_pure, p), or None where nothing repeats or the groups are no more than the
    parameters.
    """
    r = np.asarray(residuals, dtype=np.float64)
    numbers: dict[Hashable, int] = {}
    index = np.array([numbers.setdefault(label, len(numbers)) for label in groups], dtype=np.intp)
    weight = np.broadcast_to(np.asarray(sd, dtype=np.float64) ** -2.0, r.shape)
    found = lack_of_fit_ratios(r[None], index, parameters, weight)
    if found is None:
        return None
    (f,), dof_lack, dof_pure = found
    return float(f), dof_lack, dof_pure, quantiles.f_tail(float(f), dof_lack, dof_pure)


def lack_of_fit_ratios(
    residuals: Array, group: Places, parameters: int, weight: Array
) -> tuple[Array, int, int] | None:
    """Return F (B,) of `lack_of_fit` and its degrees of freedom, of residuals (B, n).

    Parameters
    ----------
    residuals : (B, n) array
    group : (n,) array of int
        From 0 on.
    parameters : int
    weight : (n,) array
    """
    total = np.bincount(group, weights=weight)
    dof_lack, dof_pure = len(total) - parameters, len(group) - len(total)
    if dof_lack <= 0 or dof_pure <= 0:
        return None
    order, count = np.argsort(group, kind="stable"), np.bincount(group)
    sums = np.add.reduceat((weight * residuals)[:, order], np.cumsum(count) - count, axis=1)
    mean = sums / total
    pure = (weight * (residuals - mean[:, group]) ** 2).sum(axis=1) / dof_pure
    lack = (total * mean**2).sum(axis=1) / dof_lack
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(lack / pure), dof_lack, dof_pure
