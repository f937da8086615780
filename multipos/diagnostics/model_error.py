"""Findings about the model: a term that the data ask for, and terms that the positions cannot show.

`missing_term` names the terms that the data ask for, `hidden_terms` those that the positions cannot
show and `not_stated` those of them that the budget lacks, on which `find_hidden` is the note;
`are_better_with` says where terms lower the errors at rows left out. `zero_per_soak` finds a zero
that differs from soak to soak, which `judge_soaks` tests; `columns_of` are the columns of kinds of
terms.

A term that is missing spoils compensated force by as much as it is large, and no U of the
parameters holds it: with a linear model and 2 mg of third order, U covers 58 % at 24 positions and
10 % at 400. Where positions show the term, its test finds it long before that
(`multipos.diagnostics.score_tests`); where they do not, the budget's [unseen] states how large it
may be. Terms are named one after the other, each tested beside those that were named.

**Soaks.** A soak is a stay at one temperature, in which several positions are read. Its rows share
whatever the zero did there beside what the model follows (hysteresis, a switch-on, a chamber that
tilts):

    y_k = x_k' p + a_s(k) + e_k,    a_s ~ N(0, σ_a²).                                       (1)

The fit takes all rows as independent; U of the bias over temperature holds what the soaks differ by
(`multipos.sensor.temperature`). With Δ what columns of the soaks explain beyond the model and the
next power of temperature (of three soaks: the model), on q degrees of freedom, and ν left,

    F = (Δ/q) / (rest/ν),      σ_a² = (F − 1) s² q / Σ left of the columns,                 (2)

one F an output, their p values combined as in `multipos.sensor.fit_diagnostics`. A curve that was
fitted straight shows as the next power of temperature (`multipos.diagnostics.score_tests`); of the
two causes a zero of its own for each soak explains the other, so it is asked first.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from multipos.diagnostics.projections import Kind, formula_with, lacking, left_of, seen_rows
from multipos.diagnostics.score_tests import judge_model, significant
from multipos.files.numbers import p_in_words
from multipos.finding import Finding, Findings
from multipos.numerics.arrays import COMPONENTS, Array, Mask
from multipos.numerics.factoring import column_norms
from multipos.positions.headers import TEMPERATURE
from multipos.sensor.calibration import Calibration
from multipos.sensor.fit_diagnostics import ModelTest
from multipos.sensor.found import Estimator
from multipos.uncertainty.unseen_terms import unseen_sizes

_LEVEL = 0.01
_CURVED = 4  # soaks, from which on a curve and zeros of their own are separate


def zero_per_soak(c: Calibration) -> Finding | None:
    """Find a zero that differs from soak to soak, by eq. (2)."""
    found = judge_soaks(c)
    if found is None or not found[0].p < _LEVEL:
        return None
    test, sizes = found
    listed = ", ".join(
        f"{output} {size:.2g}" for output, size in zip(c.outputs, sizes.tolist(), strict=True)
    )
    return Finding(
        "zero-per-soak",
        "note",
        f"bias is not repeatable between soaks ({listed} {c.model.unit} rms, {p_in_words(test.p)}: "
        "hysteresis or drift); U includes it",
    )


def judge_soaks(c: Calibration) -> tuple[ModelTest, Array] | None:
    """Test eq. (1) in every output; None where there are no soaks, or nothing is left.

    Returns
    -------
    ModelTest
    sizes : (M,) array
        σ_a, in reading units.
    """
    plain = c.estimator.exact and c.noise is None and c.robust_weight is None
    if not plain or not c.model.has_terms or TEMPERATURE not in c.readings.environment:
        return None
    from multipos.sensor.temperature import runs_of, soaks_of

    soak = soaks_of(c.readings)
    if soak is None or runs_of(c.readings, c.model) is not None:  # whose zeros U has already
        return None
    columns = (soak[:, None] == np.unique(soak)).astype(np.float64)
    phi = c.model.basis(c.reference, c.readings.environment)
    curved = [kind for kind in lacking(c) if kind.name.partition("^")[0] == TEMPERATURE]
    if columns.shape[1] < _CURVED:  # a curve explains all soaks, and they explain the curve
        curved = []
    ratios, dofs, sizes = [], [], []
    for i, mine in enumerate(c.model.columns):
        further = columns_of(curved, i, c.reference, c.readings.environment)
        design = np.column_stack([phi[:, mine], further])
        Q = np.linalg.qr(design)[0]
        V = left_of(Q, columns)
        rows = seen_rows(V, column_norms(columns))
        q, nu = float(len(rows)), float(len(Q) - Q.shape[1] - len(rows))
        e = c.residuals[:, i] - Q @ (Q.T @ c.residuals[:, i])
        explained = float(np.sum((rows @ e) ** 2))
        rest = float(e @ e) - explained
        if q < 1.0 or nu < 1.0 or not rest > 0.0:
            return None
        ratios.append(explained / q / (rest / nu))
        dofs.append((q, nu))
        sizes.append(np.sqrt(max(ratios[-1] - 1.0, 0.0) * rest / nu * q / np.sum(V**2)))
    return ModelTest("soak", c.outputs, tuple(ratios), tuple(dofs)), np.array(sizes)


def columns_of(
    kinds: Sequence[Kind], output: int, reference: Array, environment: Mapping[str, Array]
) -> Array:
    """Return the columns (n, q) of kinds of terms of one output, at references (n, 3) [g]."""
    variables = {axis: reference[:, i] for i, axis in enumerate(COMPONENTS)} | dict(environment)
    terms = [term for kind in kinds for term in kind.terms[output]]
    columns = [np.broadcast_to(term.evaluate(variables), len(reference)) for term in terms]
    return np.column_stack(columns) if columns else np.zeros((len(reference), 0))


_MOST = 3  # terms named
_ALONE = 1e-6  # of 1 − leverage, where a row alone fixes a parameter
_SEPARATE = 1e-9  # of a column, that the others leave of it
_AS_GOOD = 6.6  # of twice the logarithm of the likelihood: the 99 % point of chi² on one degree


def missing_term(c: Calibration) -> Finding | None:
    """Name the terms that the data ask for, the one that explains most first."""
    best = significant(c.diagnostics.model_tests)
    if any(test.term.startswith(TEMPERATURE) for test in best) and zero_per_soak(c) is not None:
        best = tuple(test for test in best if not test.term.startswith(TEMPERATURE))
    best = tuple(test for test in best if _is_admissible(c, (test.term,)))
    if not best:
        return None
    named, first = _named(c, best), best[0]
    others = [t.term for t in best[1:] if t.gain > first.gain - _AS_GOOD and t.term not in named]
    instead = f"; {' or '.join(others)} would fit as well" if others else ""
    return Finding(
        "missing-term",
        "warning",
        (
            f"the model lacks {' and '.join(named)}, which residuals show "
            f"({p_in_words(first.p)}{instead}); U of compensated force excludes that error"
        ),
        _way_out(c, named),
        outputs=_showing(first),
    )


def hidden_terms(c: Calibration) -> Finding | None:
    """Name the terms that the positions cannot show and the budget does not state."""
    hidden = not_stated(c)
    if not hidden:
        return None
    return Finding(
        "hidden-terms",
        "note",
        (
            f"{_listed(hidden)} cannot be determined from these positions and is not included "
            "in U of compensated force"
        ),
        "Add positions between these directions, or enter an allowance under [unseen] of a budget.",
    )


def not_stated(c: Calibration) -> tuple[str, ...]:
    """Return the hidden terms that the budget does not state."""
    stated = unseen_sizes(c)
    return tuple(kind for kind in c.diagnostics.hidden if kind not in stated)


def find_hidden(c: Calibration) -> Findings:
    """Return a note on the hidden terms for who applies a calibration; none where all show."""
    hidden = not_stated(c)
    if not hidden:
        return ()
    text = (
        f"{_listed(hidden)} could not be determined from the positions of the calibration and is "
        "not included in U between them"
    )
    return (Finding("hidden-terms", "note", text),)


def _named(c: Calibration, best: Sequence[ModelTest]) -> tuple[str, ...]:
    """Return the best term, and what is asked for beside it."""
    named: tuple[str, ...] = (best[0].term,)
    while len(named) < _MOST:
        more = significant(judge_model(c, named).tests)
        if not more or not _is_admissible(c, (*named, more[0].term)):
            break
        named = (*named, more[0].term)
    return named


def _is_admissible(c: Calibration, named: tuple[str, ...]) -> bool:
    """Tell whether the fit with these terms is better for it.

    They are fitted: positions show them, and the errors at rows that are left out are smaller.
    """
    if any(name in c.diagnostics.hidden for name in named):
        return False
    if c.estimator is not Estimator.LINEAR or not c.model.has_terms:
        return True
    if c.robust_weight is not None:
        return True
    kinds = [kind for kind in lacking(c) if kind.name in named]
    with np.errstate(divide="ignore"):
        root = np.broadcast_to(1.0 / c.sd_of_readings, c.residuals.shape)
    size = np.linalg.norm(c.sensitivity, axis=1)
    if not (np.isfinite(root).all() and size.all()):  # no residuals, or no linear response
        return False
    phi = c.model.basis(c.reference, c.readings.environment)
    bases, added, residuals = [], [], []
    for i, own in enumerate(c.model.columns):
        weight = root[:, [i]]
        bases.append(np.linalg.qr(phi[:, own] * weight)[0])
        added.append(columns_of(kinds, i, c.reference, c.readings.environment) * weight)
        residuals.append(c.residuals[:, [i]] * weight)
    return bool(are_better_with(bases, added, residuals)[0])


def are_better_with(
    bases: Sequence[Array],
    added: Sequence[Array],
    residuals: Sequence[Array] | Array,
) -> Mask:
    """Tell in which units (B,) further terms lower the errors at rows that are left out.

    Parameters
    ----------
    bases, added : M arrays (n, p), (n, k)
        Q of the model's design, and columns of the terms.
    residuals : M arrays (n, B)
        Of the model.
    """
    ratio = np.zeros(residuals[0].shape[1])
    for Q, Z, e in zip(bases, added, residuals, strict=True):
        if not Z.shape[1]:
            ratio += 1.0
            continue
        length = np.linalg.norm(Z, axis=0)
        unit = Z / np.where(length > 0.0, length, 1.0)
        T, R = np.linalg.qr(unit - Q @ (Q.T @ unit))
        if len(Q) < Q.shape[1] + Z.shape[1] or np.abs(np.diag(R)).min() < _SEPARATE:
            return np.zeros(len(ratio), dtype=np.bool_)
        along, left = T.T @ e, 1.0 - np.einsum("np,np->n", Q, Q)
        before = _left_out(e, left)
        after = _left_out(e - T @ along, left - np.einsum("nk,nk->n", T, T))
        ratio += after / np.where(before > 0.0, before, 1.0)
    return np.asarray(ratio < len(residuals))


def _left_out(residuals: Array, left: Array) -> Array:
    """Return the sums of squares (B,) of errors at rows left out, by 1 − leverage (n,)."""
    error = residuals / np.maximum(left, _ALONE)[:, None]
    return np.asarray(np.einsum("nb,nb->b", error, error))


def _way_out(c: Calibration, named: tuple[str, ...]) -> str:
    if not c.model.has_terms:
        return "Add the term to the model."
    columns = {kind.name: sum(map(len, kind.terms)) for kind in lacking(c)}
    shown = {t.term: sum(q for q, _ in t.dofs) for t in c.diagnostics.model_tests}
    formula = f"Fit with --model '{formula_with(c.model, named)}'"
    if all(shown.get(name) == columns[name] for name in named):
        return f"{formula}."
    return f"{formula} at positions that show all of it."


def _showing(test: ModelTest) -> tuple[str, ...]:
    """Return the outputs in which the term shows; none where all were tested as one."""
    alone = [
        ModelTest(test.term, (output,), (f,), (dof,))
        for output, f, dof in zip(test.outputs, test.ratios, test.dofs, strict=False)
    ]
    return tuple(one.outputs[0] for one in alone if one.p < 0.01)


def _listed(kinds: Sequence[str]) -> str:
    return kinds[0] if len(kinds) == 1 else f"{', '.join(kinds[:-1])} or {kinds[-1]}"
