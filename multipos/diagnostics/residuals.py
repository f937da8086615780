"""Cautions about what the residuals show, of readings that are no gross error.

`outlier` finds positions that stick out, `outlying_rows` and `outlier_of_rows` rows that do,
`lack_of_fit` outputs whose repeats agree too well, and `effective_number` rows that count as fewer.
`rejected_noise` finds a stated noise that residuals reject, `orientation_error` orientation errors,
and `unequal_noise` outputs that differ, by `judge_equality` and `score_equality`. `residuals_of`
are those of a calibration.

- Repeats scatter less than the model misses their means (lack of fit, an F test of the fit).
- Rows whose correlation U follows from count as fewer. What else residuals show in the order of
  their rows stands in `multipos.diagnostics.row_order`.

What was stated of readings and positions is cautioned about with the cause that the data prefer by
`multipos.diagnostics.variances`. A missing term comes before all of them: it has its own test, and
looks like any of them.

Uncertain and unknown orientations take the noise of outputs as equal, or as stated. With the
projection P = W − WA S⁻¹A'W of `multipos.estimation.likelihood` and v_i the variances taken, the
score of ln v_i and its information are

    U_i = ½ Σ_k (v_i (Σ_k⁻¹ r_k)_i² / φ − v_i P_ki,ki),    I_ij = ½ Σ_kl v_i v_j P_ki,lj²,      (1)

φ the common factor that makes Σ U_i zero; U'I⁻¹U follows χ² on M − 1 where they are right.
"""

import math
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from multipos.diagnostics.columns import repeated_rows
from multipos.diagnostics.repairs import look
from multipos.diagnostics.score_tests import significant
from multipos.diagnostics.variances import (
    LEVEL,
    TELLING,
    Residuals,
    across_the_force,
    deviances_of,
    orientation_sd,
)
from multipos.estimation.gains import AtSolution, information_at_solution
from multipos.estimation.known import REJECTED
from multipos.estimation.likelihood import respond, weigh
from multipos.estimation.outliers import Outlying, find_outlying_rows
from multipos.files.numbers import p_in_words
from multipos.finding import Finding
from multipos.numerics.arrays import COMPONENTS, Array, Mask, resolution
from multipos.numerics.factoring import is_regular
from multipos.numerics.quantiles import chi2_quantile, chi2_tail
from multipos.positions.readings import diagonal
from multipos.sensor.calibration import Calibration
from multipos.sensor.found import Estimator

_LEVEL = 0.01  # at which repeats reject the model, all outputs together
_ROUNDING = 1e-12  # of a response: residuals that are nothing
_SINGULAR = 1e-12  # of a determinant, beside the product of its diagonal
_SHOWN = 4
_NAMED = 2  # outlying readings in one sentence
_GROSS = 100.0  # times that residuals are smaller without rows that nobody should use
_ENOUGH = 3  # degrees of freedom without them
_SIGN = 0.05  # of an error: how near twice the reading it is where a sign was lost


def outlier(c: Calibration, *, sought: bool = False) -> Finding | None:
    """Find positions that stick out, and readings whose sign is lost.

    Rows that are outliers may have been sought before the fit, and none be there.
    """
    of_rows = None if sought else outlier_of_rows(c)
    if of_rows is not None:
        return of_rows
    found = c.diagnostics.outliers
    noise = c.residual_sd > _ROUNDING * np.linalg.norm(c.sensitivity, axis=1) if found else ()
    if not found or not np.any(noise):
        return None
    more = f"; and {len(found) - _NAMED} more" if len(found) > _NAMED else ""
    rows = _named_in(found, c.readings.labels)
    return Finding(
        "outlier",
        "warning",
        f"{'; '.join(found[:_NAMED])}{more}",
        f"Measure again, or set aside with --exclude {','.join(rows)}.",
        rows=rows,
    )


def _named_in(texts: Sequence[str], labels: Sequence[str]) -> tuple[str, ...]:
    """Return the labels of positions that texts begin with."""
    begun = {
        text[len("position ") : end]
        for text in texts
        if text.startswith("position ")
        for end, mark in enumerate(text)
        if mark in ": "
    }
    return tuple(dict.fromkeys(label for label in labels if label in begun))


def outlying_rows(c: Calibration) -> Outlying | None:
    """Return the rows that are outliers, where all positions are listed, or none."""
    readings, reference = c.readings, None
    if c.estimator is not Estimator.UNKNOWN:
        if readings.group is not None or readings.open_roll is not None or readings.up is None:
            return None
        size = np.linalg.norm(c.reference, axis=1, keepdims=True)
        reference = c.reference if c.estimator.exact else c.sign * size * readings.up
        if not np.isfinite(reference).all():
            return None
    sd = None if reference is None else readings.orientation_sd
    return find_outlying_rows(c.model, readings, reference, sd)


def outlier_of_rows(c: Calibration) -> Finding | None:
    """Find rows that are off the fit of the others, by the readings and positions alone."""
    found = outlying_rows(c)
    return None if found is None else _outlying(c, found)


def _outlying(c: Calibration, found: Outlying) -> Finding:
    labels = [c.readings.labels[row] for row in found.rows.tolist()]
    off = [f"{1e3 * size:.3g} mg" for size in found.off.tolist()]
    gross = found.ratio > _GROSS and found.dof >= _ENOUGH
    pairs = list(zip(labels, off, strict=True))
    said = ", ".join(f"{label} ({size})" for label, size in pairs[:_SHOWN])
    more = f" and {len(pairs) - _SHOWN} more" if len(pairs) > _SHOWN else ""
    one = len(pairs) == 1
    said = f"position {said} deviates" if one else f"positions {said}{more} deviate"
    named = ",".join(dict.fromkeys(labels))
    signs, components = _signs_lost(c, found)
    if components:
        along = ", ".join(f"{label} along {axis}" for label, axis in components)
        return Finding(
            "flipped-direction",
            "error" if gross else "warning",
            f"the direction has the wrong sign at position {along}: reversed, it agrees with the "
            "other readings",
            f"Correct the sign in the list, or set aside with --exclude {named}.",
            rows=tuple(dict.fromkeys(labels)),
        )
    if signs:
        cells = ", ".join(f"{output} of position {label}" for label, output in signs)
        return Finding(
            "flipped-row",
            "error" if gross else "warning",
            f"{cells} has the wrong sign: reversed, it agrees with the other readings",
            f"Correct the sign, or set aside with --exclude {named}.",
            rows=tuple(dict.fromkeys(labels)),
            outputs=tuple(dict.fromkeys(output for _, output in signs)),
        )
    lower = f"; residuals without are {found.ratio:.2g} times smaller" if gross else ""
    return Finding(
        "outlier",
        "error" if gross else "warning",
        f"{said} from the fit of the others{lower}",
        f"Measure again, or set aside with --exclude {named}.",
        rows=tuple(dict.fromkeys(labels)),
    )


_Signs = list[tuple[str, str]]


def _signs_lost(c: Calibration, found: Outlying) -> tuple[_Signs, _Signs]:
    """Return the labels and outputs, or axes of directions, whose signs explain all outliers.

    Of what the other rows predict, a reading that lost its sign is off by twice itself, and one
    whose direction is listed with the wrong sign along an axis by K times twice that component.
    """
    view = look(c)
    if view is None:
        return [], []
    rows, others = found.rows, np.ones(len(c.readings), dtype=np.bool_)
    others[rows] = False
    X = np.hstack([view.even, view.odd])
    coefficients = np.linalg.lstsq(X[others], view.values[others], rcond=None)[0]
    first, values = view.even.shape[1], view.values[rows]
    error = values - X[rows] @ coefficients
    size = np.linalg.norm(error, axis=1)
    turned = (np.abs(error - 2.0 * values) < np.abs(error)) & (
        np.abs(error) > _SIGN * size[:, None]
    )
    of_signs = np.linalg.norm(error - 2.0 * values * turned, axis=1)
    moved = 2.0 * X[rows, first : first + 3, None] * coefficients[None, first : first + 3]
    by_axis = np.linalg.norm(error[:, None] + moved, axis=2)
    axis = by_axis.argmin(axis=1)
    of_axes = by_axis[np.arange(len(rows)), axis]
    labels = [c.readings.labels[row] for row in rows.tolist()]
    if (of_axes < _SIGN * size).all() and of_axes.sum() < of_signs.sum():
        return [], [(label, COMPONENTS[i]) for label, i in zip(labels, axis.tolist(), strict=True)]
    if not (of_signs < _SIGN * size).all():
        return [], []
    return [(labels[row], c.outputs[i]) for row, i in np.argwhere(turned).tolist()], []


def lack_of_fit(c: Calibration) -> Finding | None:
    """Find outputs whose repeats scatter less than the model misses them."""
    if c.effective_rows:  # neighbours are no repeats
        return None
    level = _LEVEL / len(c.outputs)
    small = {}
    for output, test in c.diagnostics.lack_of_fit.items():
        p, i = test["p"], c.outputs.index(output)
        if not isinstance(p, float) or p >= level:
            continue
        # repeats that agree because they are rounded say nothing of the noise
        if c.residual_sd[i] > resolution(c.readings.values[:, i]):
            small[output] = p
    if not small or repeated_rows(c) is not None:  # copies are no repeats
        return None
    said = ", ".join(f"{output} ({p_in_words(p)})" for output, p in small.items())
    return Finding(
        "lack-of-fit",
        "warning",
        (
            f"residuals exceed what repeats of a position show: {said}; a term is missing, or "
            "positions are not as listed"
        ),
        "Fit with more terms, or with --orientation-sd auto.",
        outputs=tuple(small),
    )


def effective_number(c: Calibration) -> Finding | None:
    """Find rows that count as fewer, of whose correlation U follows."""
    if not c.effective_rows:
        return None
    n = len(c.residuals)
    fewer = {output: rows for output, rows in c.effective_rows.items() if rows < n}
    said = ", ".join(f"{output} {max(rows, 1.0):.2g}" for output, rows in fewer.items())
    return Finding(
        "time-correlated",
        "note" if c.estimator is Estimator.UNKNOWN else "warning",
        (
            f"noise of neighbouring rows is correlated: {n} rows equal fewer independent ones "
            f"({said}); U includes it"
        ),
        "Measure the positions several times, in random order.",
        outputs=tuple(fewer),
    )


FEW = 6.0  # degrees of freedom below which the law of eq. (1) is not reached
MOST = 600  # readings beyond which eq. (1) is not worked out


def rejected_noise(c: Calibration) -> Finding | None:
    """Find a stated noise that the residuals reject, and name the cause that the data favour."""
    claim = c.diagnostics.claim
    if claim is None or not claim.chi2 > chi2_quantile(REJECTED, claim.dof):
        return None
    cause, action = _cause(c)
    p = chi2_tail(claim.chi2, claim.dof)
    text = f"residuals exceed the stated noise ({p_in_words(p)}); {_excess(c)}; {cause}"
    return Finding("denied-noise", "warning", text, action, p=p)


def _excess(c: Calibration) -> str:
    """Say what of noise beyond the stated one is in U."""
    found = c.variance_components
    scatter = found and found.rest_to_rest
    if not scatter:
        return "U was increased"
    sizes = sorted({f"{part.value:.2g}" for part in scatter.values()}, key=float)
    if len(sizes) == 1:
        return f"U includes an excess of {sizes[0]} {c.model.unit}"
    return f"U includes up to {sizes[-1]} {c.model.unit} of it"


def orientation_error(
    c: Calibration, residuals: Callable[[], Residuals], outlying: Sequence[str] = ()
) -> Finding | None:
    """Find readings that scatter across the force, as orientation errors make them.

    Where positions are outlying, those that are not must do so too.
    """
    if c.noise is not None or not _separable(c):
        return None
    of = residuals()
    if not across_the_force(of)[0] or significant(c.diagnostics.model_tests):
        return None
    if outlying:
        kept = np.array([label not in outlying for label in c.readings.labels])
        others = _of_rows(c, kept, c.reference)
        if others is None or not across_the_force(others)[0]:
            return None
    degrees = math.degrees(float(orientation_sd(of)[0]))
    return Finding(
        "placement",
        "warning",
        (
            f"residuals suggest orientation errors of {degrees:.2g} degrees (1 sigma); U takes "
            "positions as exact"
        ),
        "Fit with --orientation-sd auto.",
    )


def _of_rows(c: Calibration, kept: Mask, reference: Array) -> Residuals | None:
    """Return residuals of rows at known positions, by least squares; None without any."""
    force, values = reference[kept], c.readings.values[kept]
    columns = {name: column[kept] for name, column in c.readings.environment.items()}
    basis, error = c.model.basis(force, columns), np.empty_like(values)
    for i, own in enumerate(c.model.columns):
        if len(basis) <= len(own):
            return None
        Q = np.linalg.qr(basis[:, own])[0]
        error[:, i] = values[:, i] - Q @ (Q.T @ values[:, i])
    slopes = c.model.force_jacobian(c.parameters, force, columns)
    return Residuals(error[None], basis, c.model.columns, slopes[None], force)


def unequal_noise(c: Calibration, at_solution: AtSolution | None = None) -> Finding | None:
    """Find outputs of unequal noise where the likelihood takes them as equal, or as stated."""
    if c.estimator.exact or c.robust_weight is not None or len(c.outputs) < 2:
        return None
    p, sizes = judge_equality(c, at_solution)
    if not p < _LEVEL or significant(c.diagnostics.model_tests):
        return None
    noisiest, quietest = int(np.argmax(sizes)), int(np.argmin(sizes))
    return Finding(
        "unequal-noise",
        "warning",
        (
            f"{c.outputs[noisiest]} is {sizes[noisiest] / sizes[quietest]:.2g} times as noisy as "
            f"{c.outputs[quietest]} ({p_in_words(p)}); its U is too small, as the fit takes "
            f"{'stated' if c.readings.noise is not None else 'equal'} noise"
        ),
        "State the noise of each output with --reading-sd.",
        outputs=c.outputs,
    )


_STATE = "State a larger --reading-sd."
_STATE_EACH = "State the noise of each output with --reading-sd."
_UNEQUAL = 2.0  # times the least excess of an output, that another has
_EXCESS = "likely variation between rests"


def _cause(c: Calibration) -> tuple[str, str]:
    """Return the likely cause of noise beyond the stated one, and the action in this mode."""
    if c.estimator.exact:
        return _cause_at_known(c)
    if c.robust_weight is None and judge_equality(c)[0] < _LEVEL:
        return "the outputs differ in noise", _STATE_EACH
    found = c.variance_components and c.variance_components.rest_to_rest
    sizes = [part.value for part in (found or {}).values()]
    if found and max(sizes) > _UNEQUAL * min(sizes):
        return f"{_EXCESS}, unequal ({_listed(found, sizes)})", _STATE_EACH
    return _EXCESS, _STATE


def _cause_at_known(c: Calibration) -> tuple[str, str]:
    plain = c.readings.noise is not None and c.readings.noise.ndim == 1 and c.robust_weight is None
    if not plain or not c.model.has_terms:
        return _EXCESS, _STATE
    of = residuals_of(c)
    assert c.readings.noise is not None
    stated = diagonal(c.readings.noise).reshape(c.residuals.shape).mean(axis=0)
    excess = np.maximum(np.square(c.residual_sd) - stated, 0.0)
    equal, unequal, oriented = (float(each[0]) for each in deviances_of(of))
    if _separable(c) and of.contrasts < 1:
        # A turn moves the two outputs across a face, a scatter all three.
        off = math.sqrt(1.5 * float(np.mean(excess / np.sum(c.sensitivity**2, axis=1))))
        text = "orientation errors and variation between rests cannot be separated"
        return text, f"Add {_sd(math.degrees(off))} if the sensor was positioned by hand."
    # on the edge of what s² may be χ² has half its weight at zero
    turned = _separable(c) and equal - oriented > chi2_quantile(1.0 - 2.0 * LEVEL, 1.0)
    if turned and oriented <= unequal:
        degrees = math.degrees(float(orientation_sd(of)[0]))
        size = f"likely orientation errors of {degrees:.2g} degrees"
        if of.contrasts >= TELLING:
            return size, "Fit with --orientation-sd auto."
        return f"{size} or variation between rests", f"Fit with {_sd(degrees)}."
    free = len(c.outputs) - 1.0
    if free and equal - unequal > chi2_quantile(1.0 - LEVEL, free):
        return f"{_EXCESS}, unequal ({_listed(c.outputs, np.sqrt(excess).tolist())})", _STATE_EACH
    return _EXCESS, _STATE


def _listed(outputs: Iterable[str], sizes: Sequence[float]) -> str:
    return ", ".join(f"{output} {size:.2g}" for output, size in zip(outputs, sizes, strict=True))


def _sd(degrees: float) -> str:
    return f"--orientation-sd {degrees:.2g}"


def residuals_of(c: Calibration) -> Residuals:
    """Return the residuals of a calibration at known positions, as a batch of one."""
    columns, rows = c.readings.environment, 1 if c.model.is_linear else len(c.residuals)
    return Residuals(
        error=c.residuals[None],
        basis=c.model.basis(c.reference, columns),
        columns=c.model.columns,
        slopes=c.model.force_jacobian(c.parameters, c.reference[:rows], columns)[None],
        force=c.reference,
    )


def judge_equality(c: Calibration, at_solution: AtSolution | None = None) -> tuple[float, Array]:
    """Test by eq. (1) whether outputs have the noise that an uncertain or unknown fit takes.

    Returns
    -------
    p : float
    sizes : (M,) array
        Standard deviations that the residuals show.
    """
    n, m = c.residuals.shape
    nothing = _ROUNDING * float(np.abs(c.readings.values).max())
    if n * m > MOST or not float(np.abs(c.residuals).max()) > nothing:
        return 1.0, np.full(m, np.nan)
    problem, optimum = at_solution() if at_solution else information_at_solution(c)
    if float(problem.degrees.sum()) - problem.unknowns < FEW:
        return 1.0, np.full(m, np.nan)
    push = weigh(problem.precision, optimum.point.residuals)
    precision = problem.precision
    if precision.ndim == 3:
        precision = np.diagonal(precision, axis1=1, axis2=2)
    W, WA = optimum.weighted()
    columns = WA.transpose(1, 0, 2).reshape(WA.shape[1], -1)
    follows = respond(optimum.information, columns).reshape(-1, m, n).transpose(1, 0, 2)
    given = W, WA, follows, push.T, 1.0 / precision.T
    statistic, sizes = score_equality(*(each[..., None, :] for each in given))
    return chi2_tail(float(statistic[0]), m - 1.0), sizes[0]


def score_equality(
    W: Array, WA: Array, follows: Array, push: Array, variance: Array
) -> tuple[Array, Array]:
    """Return U'I⁻¹U of eq. (1) (B,), and the standard deviations (B, M) that residuals show.

    P_ki,lj is δ_kl W_k,ij − (W A)_ki S⁻¹(W A)_lj', so that squares need sums over positions alone.

    Parameters
    ----------
    W, WA, follows : (M, M, B, n), (M, p, B, n), (M, p, B, n) arrays
        With S⁻¹A'W.
    push, variance : (M, B, n) arrays
        Σ⁻¹r and v.
    """
    root = np.sqrt(variance)
    W = W * root[:, None] * root
    WA, follows = ((each * root[:, None]).transpose(0, 2, 1, 3) for each in (WA, follows))
    lost = np.einsum("ibpn,jbpn->ijbn", WA, follows)
    sums = follows @ WA.swapaxes(2, 3)
    traces = np.einsum("iibn->bi", W - lost)
    information = np.einsum("ijbn,ijbn->bij", W, W - 2.0 * lost)
    information += np.einsum("ibpq,jbqp->bij", sums, sums)
    squares = np.einsum("ibn,ibn->bi", root * push, root * push)
    total = squares.sum(axis=1, keepdims=True)
    whole = traces.sum(axis=1, keepdims=True)
    # not where readings are so coarse that nothing is left, or outputs cannot be told apart
    least = _SINGULAR * np.einsum("bii->bi", information).prod(axis=1)
    separated = np.linalg.det(information) > np.maximum(least, 0.0)
    left = (total > 0.0) & (whole > 0.0) & separated[:, None]
    information[~separated] = np.eye(len(W))
    common = np.where(left, total, 1.0) / np.where(left, whole, 1.0)
    U = 0.5 * (squares / common - traces)
    U *= left
    solved = np.linalg.solve(0.5 * information, U[:, :, None])[:, :, 0]
    size = np.sqrt(variance.mean(axis=2).T * common * np.maximum(1.0 + solved, 0.05))
    return np.einsum("bi,bi->b", U, solved), size * left


def _separable(c: Calibration) -> bool:
    """Tell whether orientation error shows beside excess variance: a triad, all rows counted."""
    return c.estimator.exact and c.robust_weight is None and _is_triad(c)


def _is_triad(c: Calibration) -> bool:
    """Tell whether three outputs along three axes, in gravity alone, sense a rotation."""
    three = sorted(c.model.axes) == list(COMPONENTS) and not c.readings.forced.any()
    if not three or not c.model.has_terms:
        return False
    linear = c.model.linear_part(c.parameters, c.mean_environment)[:, 1:]
    return is_regular(linear) or int(np.linalg.matrix_rank(linear)) == len(COMPONENTS)
