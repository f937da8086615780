"""The information that positions hold about a model.

`make_setting` makes of options a `Setting`, which gives the rows of positions. `inform` is the
information of rows, `log_det` its determinant, `multiply` a product in pieces. `require_values`
refuses positions at which a formula has no value, and `nothing_to_weigh` warns of a reading sd of a
whole g. `tangents` are the two directions across each up vector, `unit` vectors at length 1.

At a position that points up along u the M outputs are y = Θ φ(f) + ε, with f = u turned by a small
rotation δ ~ N(0, s² I), J = dy/df and ε of standard uncertainty σ_i. Eliminating δ leaves

    I(u) = X(u)' V(u)⁻¹ X(u),      V = diag(σ²) + s² J (1 − u u') J',                        (1)

the information of one position about the p parameters, X (M, p) the rows of the model. With known
orientations, s = 0, the outputs are independent blocks; with s finite they are one block; with
unknown ones, s → ∞, three outputs leave a single row, n'X with n normal to the two columns of J
that a rotation reaches: at a nominal sensor n = u and the row is that of the norm |f|.

Everything takes and gives tuples with one entry per block: rows (n, K, p_b), matrices (p_b, p_b).

Source: V. V. Fedorov, Theory of Optimal Experiments, 1972 (several outputs).
"""

import math
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from multipos.errors import MultiposError, UsageError
from multipos.estimation.user_models import hold_free_rotations, nominal_parameters
from multipos.finding import Finding, Findings
from multipos.numerics.arrays import COMPONENTS, LARGEST, SMALLEST, Array
from multipos.numerics.factoring import log_determinant
from multipos.numerics.rotations import directions
from multipos.positions.order import share_absorbed
from multipos.results import frozen
from multipos.sensor.inverse import parameter_jacobian
from multipos.sensor.model import Model

Blocks = tuple[Array, ...]

# Standard uncertainties of a reading in that of an orientation from which no digit is left of it.
_AS_UNKNOWN = 2e7
# Condition of the information, its parameters at one size, from which few digits of it are left.
_SINGULAR = 1e13
# Multiplications of a product from which BLAS may start threads: on a busy machine their waiting
# for each other costs a hundred times what they gain on products of this size.
_PIECE = 200_000


@frozen
class Setting:
    """What is to be learned, and how well a position is known.

    Attributes
    ----------
    model : Model
        In the lower gauge where orientations are unknown.
    orientation_sd : float [rad]
        Per axis; 0 for known orientations, inf for unknown ones. Relative to a reading of unit
        standard uncertainty where `sd` is not given.
    sd : (M,) array or None
        Standard uncertainty of a reading of each output; 1 where not given.
    parameters : (p,) array or None
        Of the sensor; the nominal one (bias 0, scale 1 per g) where not given.
    size : float [g]
        What a position makes of u: f = size u.
    draws : tuple of (p,) arrays
        Parameters that represent a prior over them: the criterion is then the mean over these.
    reading_sd : float [g]
        Standard uncertainty of a reading, which scales the predicted u.
    """

    model: Model
    orientation_sd: float = 0.0
    sd: Array | None = None
    parameters: Array | None = None
    size: float = 1.0
    draws: tuple[Array, ...] = ()
    reading_sd: float = 1.0

    @cached_property
    def blocks(self) -> tuple[slice, ...]:
        """Parameters whose information has no part in common with the others'."""
        return (slice(0, len(self.model.keys)),) if self.coupled else self.model.slices

    @cached_property
    def coupled(self) -> bool:
        """Whether outputs tell of the same: of one position, or of parameters that they share."""
        shares = bool((self.model.output_of == len(self.model.outputs)).any())
        return self.orientation_sd > 0.0 or shares

    @cached_property
    def stated(self) -> "Setting":
        """The setting at the stated parameters alone."""
        return replace(self, draws=())

    @cached_property
    def drawn(self) -> "tuple[Setting, ...]":
        """The setting at each of the draws."""
        return tuple(replace(self, parameters=draw, draws=()) for draw in self.draws)

    @cached_property
    def least(self) -> int:
        """Positions below which the parameters cannot be separated."""
        if math.isinf(self.orientation_sd):
            return len(self.model.keys)
        return max(len(terms) for terms in self.model.terms)

    def rows(self, up: Array) -> Blocks:
        """Return the whitened rows Z with I(u) = Z'Z of each block, at up vectors (n, 3).

        With draws, the blocks of each: the mean of ln det over them is what D makes large.
        """
        if self.draws:
            return tuple(Z for one in self.drawn for Z in one.rows(up))
        force = self.size * up
        if self.coupled:
            return (self.whiten(up, self.design(force)),)
        if self.parameters is None:
            phi = self.model.basis(force, {})
            blocks = [phi[:, np.newaxis, columns] for columns in self.model.columns]
        else:
            X = self.design(force)
            blocks = [X[:, [i], part] for i, part in enumerate(self.model.slices)]
        if self.sd is None:
            return tuple(blocks)
        return tuple(Z / sd for Z, sd in zip(blocks, self.sd.tolist(), strict=True))

    def drift_absorbed(self, up: Array) -> float:
        """Return which share of the row number in one output the model absorbs, at the most.

        Parameters
        ----------
        up : (n, 3) array
            In the order of time.
        """
        M, row = len(self.model.outputs), np.asarray(np.arange(len(up)) - 0.5 * (len(up) - 1))
        blocks = self.rows(up)
        shares = []
        for i in range(M):
            Z, course = blocks[0 if self.coupled else i], row[:, np.newaxis]
            if self.coupled:
                drift = np.zeros((len(up), M, 1))
                drift[:, i, 0] = row
                course = self.whiten(up, drift)[:, :, 0]
            shares.append(share_absorbed(Z.reshape(-1, Z.shape[2]), course.ravel()))
        return max(shares)

    def design(self, force: Array) -> Array:
        """Return X (n, M, p), the derivative of the outputs by the parameters."""
        nominal = np.zeros(len(self.model.keys))  # of any sensor, where the model is linear in them
        parameters = nominal if self.parameters is None else self.parameters
        return parameter_jacobian(self.model, parameters, force, {})

    def whiten(self, up: Array, X: Array) -> Array:
        """Return V^(-1/2) X of eq. (1); where orientations are unknown, the row n'X."""
        if self.sd is not None:
            X = X / self.sd[:, np.newaxis]
        if self.orientation_sd == 0.0:
            return X
        length = np.linalg.norm(up, axis=1)  # of a known force; one of a direction
        turned = self.force_jacobian(up) @ tangents(directions(up))
        turned *= np.where(length == 0.0, 1e-300, length)[:, np.newaxis, np.newaxis]
        if self.sd is not None:
            turned = turned / self.sd[:, np.newaxis]
        if math.isinf(self.orientation_sd):
            normal = np.cross(turned[:, :, 0], turned[:, :, 1])
            normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), SMALLEST)
            return np.asarray(np.einsum("nm,nmp->np", normal, X)[:, np.newaxis, :])
        spread = turned * (self.orientation_sd * abs(self.size))
        # V = 1 + A A' with A (M, 2): its inverse root needs the eigenvalues of A'A only
        eigen, Q = np.linalg.eigh(spread.transpose(0, 2, 1) @ spread)
        eigen = np.maximum(eigen, 1e-12)
        A = spread @ (Q * np.sqrt((1.0 - 1.0 / np.sqrt(1.0 + eigen)) / eigen)[:, np.newaxis, :])
        return np.asarray(X - A @ (A.transpose(0, 2, 1) @ X))

    def force_jacobian(self, up: Array) -> Array:
        """Return dy/df (n, M, 3) at up vectors (n, 3)."""
        if self.parameters is not None:
            return self.model.force_jacobian(self.parameters, self.size * up, {})
        J = np.zeros((len(self.model.outputs), 3))
        for i, axis in enumerate(self.model.axes):
            J[i, COMPONENTS.index(axis)] = 1.0
        return np.broadcast_to(J, (len(up), *J.shape))


def make_setting(
    model: Model,
    *,
    unknown_orientation: bool = False,
    orientation_sd: float | None = None,
    reading_sd: float = 1.0,
) -> Setting:
    """Return the setting that the options of the commands state.

    Parameters
    ----------
    orientation_sd : float [degrees], optional
        Per axis.
    reading_sd : float [g]
        At a nominal sensor; it matters beside `orientation_sd` only.
    """
    if not SMALLEST <= reading_sd <= LARGEST:
        raise UsageError(
            f"--reading-sd must be above 0, from {SMALLEST:g} to {LARGEST:g}, got {reading_sd}."
        )
    if unknown_orientation and orientation_sd is not None:
        raise UsageError("--unknown-orientation and --orientation-sd exclude each other; give one.")
    if unknown_orientation and sorted(model.axes) != list(COMPONENTS):
        raise UsageError(
            "--unknown-orientation needs three outputs, on x, y and z: with fewer, |f| does "
            f"not show; got axes {','.join(model.axes)}."
        )
    own: dict[str, Any] = {"reading_sd": reading_sd}
    if not model.has_terms:
        _require_force_alone(model)
        if unknown_orientation:
            model = hold_free_rotations(model, nominal_parameters(model))
        own |= _at_own_parameters(model)
    elif unknown_orientation:
        model = model.with_gauge("lower")
    if unknown_orientation:
        return Setting(model, math.inf, **own)
    if orientation_sd is None:
        return Setting(model, **own)
    if not 0.0 <= math.radians(orientation_sd) <= _AS_UNKNOWN * reading_sd:
        raise UsageError(
            "--orientation-sd must be 0 or more, in degrees, and with a reading of standard "
            f"uncertainty {reading_sd:g} g below {math.degrees(_AS_UNKNOWN * reading_sd):.0e}, got "
            f"{orientation_sd}; "
            "for unknown orientations give --unknown-orientation."
        )
    return Setting(model, math.radians(orientation_sd) / reading_sd, **own)


def _require_force_alone(model: Model) -> None:
    if model.environment:
        raise UsageError(
            f"the model uses column '{model.environment[0]}', which a position does not set; "
            "give a model of specific force alone."
        )


def _at_own_parameters(model: Model) -> dict[str, Any]:
    """Return the parameters at which a model of one's own is judged, and draws of its prior.

    Of q parameters with a prior, all outputs' copies of one together, 2 q points at ± sqrt(q) sd
    have the prior's mean and covariance.
    """
    nominal = nominal_parameters(model)
    with_prior = dict.fromkeys(q.name for q in model.quantities if q.sd is not None)
    draws = []
    for name in with_prior:
        for sign in (-1.0, 1.0):
            move = [
                math.sqrt(len(with_prior)) * sign * (q.sd or 0.0) if q.name == name else 0.0
                for q in model.quantities
            ]
            draws.append(model.within(nominal + np.array(move)))
    return {"parameters": nominal, "draws": tuple(draws)}


def nothing_to_weigh(setting: Setting) -> Findings:
    """Return a warning where an orientation sd stands beside a reading sd of a whole g."""
    stated = setting.reading_sd != 1.0 or setting.sd is not None
    if stated or setting.orientation_sd in (0.0, math.inf):
        return ()
    text = (
        f"the standard uncertainty of a reading is taken as 1 g, so --orientation-sd "
        f"{math.degrees(setting.orientation_sd):g} hardly counts"
    )
    return (Finding("orientation-unweighed", "warning", text, "State --reading-sd in g."),)


def inform(rows: Blocks, weights: Array | None = None) -> Blocks:
    """Return the information M of rows (n, K, p) with weights (n,), their mean where not given."""
    matrices = []
    for Z in rows:
        n, k, p = Z.shape
        w = np.full(n, 1.0 / n) if weights is None else weights
        flat = (Z * np.sqrt(w)[:, np.newaxis, np.newaxis]).reshape(n * k, p)
        step = max(1, _PIECE // (p * p))
        pieces = [flat[i : i + step] for i in range(0, n * k, step)]
        matrices.append(np.sum([piece.T @ piece for piece in pieces], axis=0))
    return tuple(matrices)


def require_values(setting: Setting, rows: Blocks) -> None:
    """Refuse rows of positions at which a formula of the model has no value."""
    model = setting.model
    for part, Z in zip(setting.blocks, rows, strict=False):  # of draws the first
        none = len(Z) - int(np.sum(np.isfinite(Z).all(axis=(1, 2))))
        if none:
            outputs = ", ".join(dict.fromkeys(output for output, _ in model.keys[part]))
            raise MultiposError(
                f"the formula of {outputs} has no value at {none} of {len(Z)} positions; "
                "change the formula."
            )


def multiply(A: Array, B: Array) -> Array:
    """Return A B, a few rows of A at a time: see `_PIECE`."""
    step = max(1, _PIECE // B.size)
    if step >= len(A):
        return np.asarray(A @ B)
    product = np.empty((len(A), B.shape[1]))
    for i in range(0, len(A), step):
        np.matmul(A[i : i + step], B, out=product[i : i + step])
    return product


def log_det(information: Blocks) -> float:
    """Return ln det of the information, −inf where it is singular."""
    total = 0.0
    for M in information:
        sign, value = log_determinant(M)
        scale = np.sqrt(np.diag(M))
        regular = sign > 0.0 and np.isfinite(value)
        if not regular or np.linalg.cond(M / np.outer(scale, scale)) > _SINGULAR:
            return -math.inf
        total += float(value)
    return total


def tangents(up: Array) -> Array:
    """Return two unit vectors normal to each up vector, (n, 3, 2)."""
    other = np.eye(3)[np.argmin(np.abs(up), axis=1)]
    first = unit(np.cross(up, other))
    return np.stack([first, np.cross(up, first)], axis=2)


def unit(vectors: Array) -> Array:
    """Return vectors (n, 3) at length 1."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
