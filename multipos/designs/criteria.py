"""What a design is to be good for: criteria that weigh the information of its positions.

`make_criterion` reads a criterion, `objective` is its value, `kernels` gives G of eq. (2) and
`sensitivity` the gradient s(u) at positions. `smooth_least` and `least_eigenvalue` are criterion E
of eigenvalues, smooth, and as it is.

With I(u) the information of a position along u, eq. (1) of `information`, what is designed is the
information per position, M = Σ w_k I(u_k), Σ w_k = 1, by one of

    D   (ln det M)/p,
    L   −ln tr(M⁻¹ B),      B = 1 (A), the mean of X'X over directions (I), e_j e_j' (u_j),   (1)

both to be made large; B of a range of tilt or force is for `multipos.designs.ranges`. With the
gradient s(u) of (1) towards a position at u,

    s(u) = tr(G I(u)),      G = M⁻¹/p  or  M⁻¹ B M⁻¹ / tr(M⁻¹ B),      Σ w_k s(u_k) = 1,      (2)

M is optimal exactly where s(u) ≤ 1 everywhere, and else short of the optimum by max s − 1 at
most. p s(u) is the variance of the prediction at u in case D. E, the least eigenvalue of M, is
made smooth, so that it has a gradient too:

    F = −ln(tr M^−q)/q,    G = M^(−q−1) / tr M^−q,    ln λ_min − (ln p)/q ≤ F ≤ ln λ_min;   (3)

so is G, the largest s of case D, here d, at directions j that are seen, the same as D at an optimum
(Kiefer and Wolfowitz) but not of few positions:

    F = −ln(mean d_j^q)/q,    G = M⁻¹ Σ_j ω_j I(u_j) M⁻¹/p,    ω_j = d_j^(q−1)/Σ d^q.        (4)

Sources: J. Kiefer, J. Wolfowitz, Canad. J. Math. 12, 1960 (the equivalence of D and G);
V. V. Fedorov, Theory of Optimal Experiments, 1972 (linear criteria).
"""

import math
from collections.abc import Callable
from functools import partial

import numpy as np

from multipos.designs.information import Blocks, Setting, inform, log_det, multiply
from multipos.designs.ranges import range_directions
from multipos.errors import MultiposError, UsageError
from multipos.numerics.arrays import COMPONENTS, Array
from multipos.numerics.terms import Term
from multipos.positions.scheme import read_scheme
from multipos.results import frozen
from multipos.sensor.model import Model

# A scheme that serves one parameter alone would leave others unknown: they count this much.
_OTHERS = 1e-4
_POWER = 100.0  # q of eq. (3); λ_min is found to a thousandth, which more steps hardly better


@frozen
class Criterion:
    """What makes one scheme better than another: D without `weight`, else B of eq. (1).

    With a `power` it is q of eq. (3), or of eq. (4) where rows at directions are `seen`.
    """

    name: str
    weight: Blocks | None = None
    power: float = 0.0
    seen: Blocks = ()


def make_criterion(name: str, setting: Setting, region: Array | None = None) -> Criterion:
    """Return the criterion D, A, E, G, I, u:OUTPUT:TERM, tilt:±DEGREES or force:±G.

    Parameters
    ----------
    name : str
        G, the largest variance of the prediction, has the optimum of D.
    setting : Setting
    region : (n, 3) array, optional
        Up vectors over which I averages; the whole sphere where not given.

    Raises
    ------
    UsageError
        No such criterion or parameter.
    """
    if name in ("D", "G"):
        return Criterion(name)
    if name == "E":
        return Criterion(name, power=_POWER)
    if name == "A":
        blocks = setting.blocks * max(len(setting.draws), 1)
        return Criterion(name, tuple(np.eye(part.stop - part.start) for part in blocks))
    if name == "I":
        return Criterion(name, _by_draw(setting, partial(_mean_prediction, region=region)))
    if name.startswith(("tilt:", "force:")):
        return Criterion(name, _by_draw(setting, partial(_weigh_range, name)))
    return Criterion(name, _weight_of_one(name, setting))


def _weigh_range(name: str, setting: Setting) -> Array:
    """Return B for the mean variance of tilt or force over a range: `multipos.designs.ranges`."""
    up, directions = range_directions(name, setting.model.axes)
    X, J = setting.design(setting.size * up), setting.force_jacobian(up)
    by_parameter = np.linalg.pinv(J[:, :, list(setting.model.sensed_axes)]) @ X  # (n, K, p)
    B = np.zeros((X.shape[2], X.shape[2]))
    for along in directions:
        rows = np.einsum("nk,nkp->np", along, by_parameter)
        B += rows.T @ rows / len(rows)
    # what the quantity does not need must not be left wholly unknown
    return np.asarray(B + _OTHERS * np.trace(B) / len(B) * np.eye(len(B)))


def _by_draw(setting: Setting, weigh: Callable[[Setting], Array]) -> Blocks:
    """Return B of eq. (1) by blocks, at each of the draws where there are any."""
    return tuple(
        whole[part, part]
        for one in setting.drawn or (setting,)
        for whole in [weigh(one)]
        for part in one.blocks
    )


def _mean_prediction(setting: Setting, *, region: Array | None) -> Array:
    """Return the mean of X'X over a region, or over the sphere."""
    if region is None and setting.model.has_terms and abs(setting.size) == 1.0:
        return _moments(setting.model)
    up = read_scheme("fibonacci-1000").up if region is None else region
    X = setting.design(setting.size * up)
    return np.asarray(np.einsum("nmp,nmq->pq", X, X) / len(up))


def _weight_of_one(name: str, setting: Setting) -> Blocks:
    """Return B of eq. (1) for the variance of one parameter, u:OUTPUT:TERM."""
    kind, _, key = name.partition(":")
    output, _, term = key.partition(":")
    if kind != "u" or not term:
        raise UsageError(
            f"unknown criterion '{name}'; give D, A, E, G, I, u:OUTPUT:TERM, tilt:±DEGREES or "
            "force:±G."
        )
    try:
        index = setting.model.index(output, term)
    except KeyError as error:
        raise UsageError(f"criterion '{name}': {error.args[0]}.") from None
    # 1 for the one, a little for the others
    diagonal = np.full(sum(part.stop - part.start for part in setting.blocks), _OTHERS)
    diagonal[index] = 1.0
    blocks = setting.blocks * max(len(setting.draws), 1)
    return tuple(np.diag(diagonal[part]) for part in blocks)


def objective(information: Blocks, criterion: Criterion) -> float:
    """Return the criterion of eq. (1), −inf where the information is singular."""
    value = log_det(information)
    if criterion.seen and value > -math.inf:
        d = sensitivity(criterion.seen, kernels(information, Criterion("D")))
        size = np.mean((d / d.max()) ** criterion.power)
        return -math.log(d.max()) - math.log(size) / criterion.power
    if criterion.power and value > -math.inf:
        eigen = np.concatenate([np.linalg.eigvalsh(M) for M in information])
        return smooth_least(eigen, criterion.power).item()
    if criterion.weight is None or value == -math.inf:
        return value / sum(len(M) for M in information)
    traces = [
        np.trace(np.linalg.solve(M, B)) for M, B in zip(information, criterion.weight, strict=True)
    ]
    return -math.log(sum(traces))


def kernels(information: Blocks, criterion: Criterion) -> Blocks:
    """Return G of eq. (2).

    Raises
    ------
    MultiposError
        The information is singular: the criterion asks nothing of some parameter.
    """
    try:
        if criterion.seen:
            return _kernels_of_largest(information, criterion)
        if criterion.power:
            return _kernels_of_least(information, criterion.power)
        inverses = [np.linalg.inv(M) for M in information]
    except np.linalg.LinAlgError:
        raise MultiposError(
            "the best positions for this criterion leave a parameter undetermined, of which it "
            "asks nothing; give a wider --region, or criterion D."
        ) from None
    if criterion.weight is None:
        p = sum(len(M) for M in information)
        return tuple(inverse / p for inverse in inverses)
    products = [C @ B for C, B in zip(inverses, criterion.weight, strict=True)]
    total = sum(np.trace(product) for product in products)
    return tuple(P @ C / total for P, C in zip(products, inverses, strict=True))


def smooth_least(eigen: Array, power: float) -> Array:
    """Return F of eq. (3) of positive eigenvalues (…, p)."""
    least = eigen.min(axis=-1, keepdims=True)
    return np.asarray(
        np.log(least[..., 0]) - np.log(((least / eigen) ** power).sum(axis=-1)) / power
    )


def _kernels_of_least(information: Blocks, power: float) -> Blocks:
    """Return G of eq. (3)."""
    found = [np.linalg.eigh(M) for M in information]
    if not all(eigen[0] > 0.0 for eigen, _ in found):
        raise np.linalg.LinAlgError
    F = smooth_least(np.concatenate([eigen for eigen, _ in found]), power)
    # λ^−q / tr M^−q, by logarithms, whose powers are no numbers
    shares = [np.exp(-power * (np.log(eigen) - F)) / eigen for eigen, _ in found]
    return tuple((Q * share) @ Q.T for (_, Q), share in zip(found, shares, strict=True))


def _kernels_of_largest(information: Blocks, criterion: Criterion) -> Blocks:
    """Return G of eq. (4)."""
    inverses = kernels(information, Criterion("D"))
    d = sensitivity(criterion.seen, inverses)
    share = (d / d.max()) ** (criterion.power - 1.0)
    p = sum(len(M) for M in information)
    B = inform(criterion.seen, p * share / (share @ d))
    return tuple(C @ each @ C for C, each in zip(inverses, B, strict=True))


def least_eigenvalue(information: Blocks) -> float:
    """Return λ_min of the information of all outputs together."""
    return min(float(np.linalg.eigvalsh(M)[0]) for M in information)


def sensitivity(rows: Blocks, kernel: Blocks) -> Array:
    """Return s(u) of eq. (2) for each position, (n,)."""
    total = np.zeros(len(rows[0]))
    for Z, G in zip(rows, kernel, strict=True):
        flat = Z.reshape(-1, Z.shape[2])
        total += np.einsum("ij,ij->i", multiply(flat, G), flat).reshape(len(Z), -1).sum(axis=1)
    return total


def _moments(model: Model) -> Array:
    """Return the mean of X'X over the sphere, term by term in closed form."""
    p = len(model.keys)
    B = np.zeros((p, p))
    for part, terms in zip(model.slices, model.terms, strict=True):
        B[part, part] = [[_mean_product(a, b) for b in terms] for a in terms]
    return B


def _mean_product(a: Term, b: Term) -> float:
    """Return the mean over the sphere of the product of two terms.

    That of |x|^i |y|^j |z|^k is Γ(3/2) Γ((i+1)/2) Γ((j+1)/2) Γ((k+1)/2) / (Γ(1/2)³ Γ((n+3)/2)),
    n = i + j + k the degrees of both; where both together are odd in an axis it is zero.
    """
    value, degree = 0.5 / math.pi, 0
    for axis in COMPONENTS:
        factors = [f for f in (*a.factors, *b.factors) if f.variable == axis]
        if sum(f.is_odd for f in factors) % 2:
            return 0.0
        own = sum(f.degree for f in factors)
        value *= math.gamma((own + 1) / 2)
        degree += own
    return value / math.gamma((degree + 3) / 2)
