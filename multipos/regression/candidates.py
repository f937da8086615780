"""Candidates: the terms that may be in a regression.

`read_candidates` returns the variables and terms that options state, `polynomial` all terms up to
a degree, `stands_on` which terms each one stands on.

The terms of degree D in m variables are all products of at most D factors, (m + D)!/(m! D!) of
them: the five variables of the full-temperature model make 21 in second degree. A formula lists
them one by one instead.
"""

from collections.abc import Sequence
from itertools import combinations_with_replacement

from multipos.errors import UsageError
from multipos.files.spelling import Names, split_names
from multipos.numerics.factors import Factor
from multipos.numerics.terms import Term, parse_terms

HIGHEST_DEGREE = 30  # of a power; NIST's Filip has 10


def read_candidates(
    response: str, variables: Names | None, degree: int | None, terms: str | None
) -> tuple[tuple[str, ...], tuple[Term, ...]]:
    """Return the variables and the candidate terms that options state.

    Raises
    ------
    UsageError
        Terms stated twice or not at all, or made of the response.
    """
    names = None if variables is None else split_names(variables, "--variables")
    if terms is not None and degree is not None:
        raise UsageError("--degree and --terms both state the terms; give one.")
    if names is not None and len(set(names)) < len(names):
        raise UsageError(f"--variables names a column twice: {','.join(names)}.")
    if terms is not None:
        names, candidates = _from_formula(terms, names)
    elif names is None:
        raise UsageError("regress needs --variables A,B,C or --terms.")
    else:
        candidates = polynomial(names, 1 if degree is None else degree)
    _check_variables(names, response)
    return names, candidates


def _from_formula(
    text: str, names: tuple[str, ...] | None
) -> tuple[tuple[str, ...], tuple[Term, ...]]:
    """Return the variables, those that are used where none are named, and the terms."""
    terms = parse_terms(text, highest=HIGHEST_DEGREE)
    used = tuple(dict.fromkeys(f.variable for term in terms for f in term.factors))
    if names is None:
        return used, terms
    strange = [name for name in used if name not in names]
    if strange:
        raise UsageError(f"--terms uses '{strange[0]}', which is not among --variables.")
    return names, terms


def _check_variables(names: tuple[str, ...], response: str) -> None:
    if response in names:
        raise UsageError(
            f"the response '{response}' is among the variables and would explain itself; "
            "leave it out."
        )
    if not names:
        raise UsageError("--terms holds no variable; the mean alone needs no regression.")


def polynomial(variables: Sequence[str], degree: int) -> tuple[Term, ...]:
    """Return all terms of variables up to a degree, the constant first."""
    if not 1 <= degree <= HIGHEST_DEGREE:
        raise UsageError(f"--degree must lie between 1 and {HIGHEST_DEGREE}, got {degree}.")
    terms = []
    for d in range(degree + 1):
        for chosen in combinations_with_replacement(variables, d):
            factors = tuple(Factor(v, chosen.count(v)) for v in sorted(set(chosen)))
            terms.append(Term(factors))
    return tuple(terms)


def stands_on(terms: Sequence[Term]) -> list[frozenset[int]]:
    """Return which terms each one stands on: T for T², V and T for V·T."""
    degrees = [{f.variable: f.degree for f in term.factors} for term in terms]
    return [
        frozenset(
            j
            for j, lower in enumerate(degrees)
            if lower
            and lower != own
            and all(degree <= own.get(name, 0) for name, degree in lower.items())
        )
        for own in degrees
    ]
