"""Doubts about the model: a term that the data ask for, and terms that the positions cannot show.

A term that is missing spoils compensated force by as much as it is large, and no U of the
parameters holds it: with a linear model and 2 mg of third order, U covers 58 % at 24 positions
and 10 % at 400. Where positions show the term, its test finds it long before that
(`multipos.doubts.score_tests`); where they do not, the budget's [unseen] states how large it may
be. Terms are named one after the other, each tested beside those that were named.
"""

from collections.abc import Sequence

from multipos.doubt import Doubt
from multipos.doubts.candidates import formula_with, lacking
from multipos.doubts.over_temperature import COLUMN, zero_per_soak
from multipos.doubts.score_tests import judge_model, significant
from multipos.sensor.calibration import Calibration
from multipos.sensor.expressions import ExpressionModel
from multipos.sensor.term_tests import ModelTest
from multipos.uncertainty.unseen import unseen_sizes

_MOST = 3  # terms named
_AS_GOOD = 6.6  # of twice the logarithm of the likelihood: the 99 % point of chi² on one degree


def missing_term(c: Calibration) -> Doubt | None:
    """Name the terms that the data ask for, the one that explains most first."""
    best = significant(c.diagnostics.model_tests)
    if any(test.term.startswith(COLUMN) for test in best) and zero_per_soak(c) is not None:
        best = tuple(test for test in best if not test.term.startswith(COLUMN))
    if not best:
        return None
    named, first = _named(c, best), best[0]
    others = [t.term for t in best[1:] if t.gain > first.gain - _AS_GOOD and t.term not in named]
    instead = f"; {' or '.join(others)} would explain them as well" if others else ""
    chance = "less than 1e-99" if first.p < 1e-99 else f"{first.p:.1g}"
    return Doubt(
        "missing-term",
        "caution",
        f"the residuals ask for {' and '.join(named)}, which the model lacks (p = {chance}"
        f"{instead}): U of compensated force does not hold that error; {_way_out(c, named)}",
        outputs=_showing(first),
    )


def hidden_terms(c: Calibration) -> Doubt | None:
    """Name the terms that the positions cannot show and the budget does not state."""
    hidden = not_stated(c)
    if not hidden:
        return None
    return Doubt(
        "hidden-terms",
        "caution",
        f"these positions cannot show {_listed(hidden)}, and U of compensated force leaves such "
        "terms out: add directions between those there are, or state them in a budget, [unseen]",
    )


def not_stated(c: Calibration) -> tuple[str, ...]:
    """Return the hidden terms that the budget does not state."""
    stated = unseen_sizes(c)
    return tuple(kind for kind in c.diagnostics.hidden if kind not in stated)


def said_of_hidden(c: Calibration) -> tuple[str, ...]:
    """Return a sentence on the hidden terms for who applies a calibration; none where all show."""
    hidden = not_stated(c)
    if not hidden:
        return ()
    said = (
        f"the positions of the calibration could not show {_listed(hidden)}: between the "
        "directions that were applied force may be off by such terms, and U leaves them out"
    )
    return (said,)


def _named(c: Calibration, best: Sequence[ModelTest]) -> tuple[str, ...]:
    """Return the best term, and what is asked for beside it."""
    named: tuple[str, ...] = (best[0].term,)
    while len(named) < _MOST:
        more = significant(judge_model(c, named).tests)
        if not more:
            break
        named = (*named, more[0].term)
    return named


def _way_out(c: Calibration, named: tuple[str, ...]) -> str:
    if isinstance(c.model, ExpressionModel):
        return "write the term into the model"
    columns = {kind.name: sum(map(len, kind.terms)) for kind in lacking(c)}
    shown = {t.term: sum(q for q, _ in t.dofs) for t in c.diagnostics.model_tests}
    formula = f"fit --model '{formula_with(c.model, named)}'"
    if all(shown.get(name) == columns[name] for name in named):
        return formula
    return f"{formula} at positions that show all of it"


def _showing(test: ModelTest) -> tuple[str, ...]:
    """Return the outputs in which the term shows; none where all were tested as one."""
    alone = [
        ModelTest(test.term, (output,), (f,), (dof,))
        for output, f, dof in zip(test.outputs, test.ratios, test.dofs, strict=False)
    ]
    return tuple(one.outputs[0] for one in alone if one.p < 0.01)


def _listed(kinds: Sequence[str]) -> str:
    return kinds[0] if len(kinds) == 1 else f"{', '.join(kinds[:-1])} or {kinds[-1]}"
