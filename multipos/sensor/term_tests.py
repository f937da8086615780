"""A test of a term that a model lacks: what it says, and its form in files.

Each output by itself has a ratio R_i that follows F(q_i, ν_i) if nothing is in the term. Their
p values P_i combine to

    X = −2 sum ln P_i,   chi² on 2M degrees of freedom,                                     (1)

(R. A. Fisher, *Statistical Methods for Research Workers*, 1932, section 21.1); outputs that are
tested together have one R ~ F(q, ν). `multipos.doubts.score_tests` says how R comes about.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from multipos.files.records import ANY_TEXT, NOT_NEGATIVE, P_VALUE, Fields, Listed, Named, Number
from multipos.numerics.quantiles import chi2_quantile, chi2_tail, f_quantile, f_tail
from multipos.results import Result, plain

_LEAST = 1e-300  # of a probability, whose logarithm is a number still
_DOF = Number(0.0, above=True)
MODEL_TESTS = Listed(
    Fields(
        {
            "term": ANY_TEXT,
            "statistic": NOT_NEGATIVE,
            "dof": Listed(_DOF, 1, 2),
            "p": P_VALUE,
        },
        {"outputs": Named(Fields({"F": NOT_NEGATIVE, "dof": Listed(_DOF, 2, 2)}))},
    )
)


@dataclass(frozen=True, eq=False)
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
    outputs: tuple[str, ...]
    ratios: tuple[float, ...]
    dofs: tuple[tuple[float, float], ...]

    def __post_init__(self) -> None:
        """Tuples of numbers are frozen as they are."""

    @cached_property
    def statistic(self) -> float:
        """X of eq. (1), or R where there is one."""
        if len(self.ratios) == 1:
            return self.ratios[0]
        tails = (f_tail(f, *dof) for f, dof in zip(self.ratios, self.dofs, strict=True))
        return -2.0 * sum(math.log(max(p, _LEAST)) for p in tails)

    @property
    def dof(self) -> tuple[float, ...]:
        """Degrees of freedom: one of chi², two of F."""
        return self.dofs[0] if len(self.ratios) == 1 else (2.0 * len(self.ratios),)

    @cached_property
    def p(self) -> float:
        """How often chance alone does the same."""
        if len(self.ratios) == 1:
            return f_tail(self.ratios[0], *self.dofs[0])
        return chi2_tail(self.statistic, *self.dof)

    @property
    def gain(self) -> float:
        """What the term adds to twice the logarithm of the likelihood, less two a parameter."""
        pairs = zip(self.ratios, self.dofs, strict=True)
        return sum((q + nu) * math.log1p(q * f / nu) - 2.0 * q for f, (q, nu) in pairs)

    def is_below(self, level: float) -> bool:
        """Tell whether p is below a level; most often without working it out."""
        count = len(self.ratios)
        # X beyond its quantile needs one P at most as large as if all were equal.
        enough = level
        if count > 1:
            enough = math.exp(-0.5 * chi2_quantile(1.0 - level, 2.0 * count) / count)
        pairs = zip(self.ratios, self.dofs, strict=True)
        return any(f > f_quantile(1.0 - enough, *dof) for f, dof in pairs) and self.p < level

    def to_dict(self) -> dict[str, Any]:
        """Return the test as what JSON can carry."""
        said = {"term": self.term, "statistic": self.statistic, "dof": self.dof, "p": self.p}
        if self.outputs:
            triples = zip(self.outputs, self.ratios, self.dofs, strict=True)
            said["outputs"] = {output: {"F": f, "dof": dof} for output, f, dof in triples}
        result: dict[str, Any] = plain(said)
        return result


def model_test_from_dict(said: Mapping[str, Any]) -> ModelTest:
    """Return the test that `ModelTest.to_dict` described."""
    apart: Mapping[str, Any] = said.get("outputs", {})
    if not apart:
        return ModelTest(said["term"], (), (said["statistic"],), (_pair(said["dof"]),))
    dofs = tuple(_pair(found["dof"]) for found in apart.values())
    ratios = tuple(float(found["F"]) for found in apart.values())
    return ModelTest(said["term"], tuple(apart), ratios, dofs)


def _pair(dof: Sequence[float]) -> tuple[float, float]:
    q, nu = dof
    return float(q), float(nu)
