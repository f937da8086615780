"""The true angle of every position of a station's fixture, from residuals within units.

- `sum_fixtures` returns what the units of a batch say of their fixtures, `FixtureSums`.

A fixture holds unit after unit at position k in the same wrong attitude, off by a small rotation
δ_k: the reference is f_k + δ_k × f_k for all of them. A unit's fit takes up what a change of its
own parameters explains and leaves the rest in the residuals. With A_u the unit's sensitivities and
H_i the hat matrix of output i, whose axis is i,

    e_uki = (A_u⁻¹ r_uk)_i = Σ_l (I − H_i)_kl (δ_l × f_l)_i + noise = (G δ)_ki,              (1)

and δ̂_u = G⁺ e_u is the shortest δ that explains a unit. Its mean over the units of a station is
the fixture's, its scatter over √N the standard uncertainty, with what units differ in being laid
in.

What G does not see is not there: a turn about f_k, which changes nothing, a rotation that all
positions share, which every unit's cross terms take up, and on few positions more than that (the
six faces: half of every angle goes into cross terms). Positions with such a part have no value.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from multipos.estimation.batches import Estimates
from multipos.estimation.known import SharedDesign
from multipos.numerics.arrays import COMPONENTS, Array, Mask, Places, median
from multipos.numerics.rotations import cross_matrix
from multipos.results import frozen

_MOST = 120  # positions: G has (3 n)² numbers
_UNSEEN = 1e-9  # singular values of G below this are zero
_UNSEEN_PART = 1e-6  # part of an angle that may be unseen
_WILD = 5.0  # times the median of the residuals, beyond which a unit tells nothing of its fixture


@frozen
class Fixture:
    """Positions and G⁺ of eq. (1).

    Attributes
    ----------
    labels : tuple of n str
    up : (n, 3) array
        As listed.
    left : (M, n, n) array
        I − H_i, from readings to residuals.
    inverse : (3 n, 3 n) array
        From e, position by position, to δ [rad].
    identifiable : (n,) array of bool
        Positions whose angle is seen but for the common rotation.
    """

    labels: tuple[str, ...]
    up: Array
    left: Array
    inverse: Array
    identifiable: Mask

    @classmethod
    def of(cls, shared: SharedDesign, labels: tuple[str, ...], up: Array) -> "Fixture | None":
        """Return the fixture of a design; None without an angle, or with too many positions."""
        axes, n = shared.model.axes, len(shared.reference)
        if sorted(axes) != sorted(COMPONENTS) or n > _MOST:
            return None
        crossed = -cross_matrix(shared.reference)  # δ × f = −[f]× δ
        pairs = zip(shared.designs, shared.inverses, strict=True)
        left = np.stack([np.eye(n) - design @ inverse for design, inverse in pairs])
        G = np.zeros((n, 3, n, 3))
        for own, axis in zip(left, axes, strict=True):
            i = COMPONENTS.index(axis)
            G[:, i] = own[:, :, None] * crossed[None, :, i]
        U, s, Vt = np.linalg.svd(G.reshape(3 * n, 3 * n))
        seen = s > _UNSEEN
        if not seen.any():
            return None
        pinv = (Vt[seen].T / s[seen]) @ U[:, seen].T
        return cls(labels, up, left, pinv, _identifiable(Vt[~seen], shared.reference))


def _identifiable(unseen: Array, reference: Array) -> Mask:
    """Tell at which positions nothing is unseen but turns about f and the common rotation."""
    n = len(reference)
    along = np.zeros((n, n, 3))
    along[np.arange(n), np.arange(n)] = reference
    known = np.concatenate((along.reshape(n, 3 * n), np.tile(np.eye(3), n)))
    basis = np.linalg.qr(known.T)[0]
    rest = unseen - (unseen @ basis) @ basis.T
    return np.asarray(np.abs(rest.reshape(-1, n, 3)).max(axis=(0, 2), initial=0.0) < _UNSEEN_PART)


class FixtureSums(NamedTuple):
    """Sums over units of one station in one fixture: of δ̂_u and of its squares, (n, 3) [rad]."""

    station: int
    labels: tuple[str, ...]
    up: Array
    identifiable: Mask
    units: int
    total: Array
    square: Array


def sum_fixtures(
    fixture: Fixture, values: Sequence[Array], found: Estimates, stations: Places
) -> tuple[FixtureSums, ...]:
    """Return the sums of units, station by station.

    Parameters
    ----------
    fixture : Fixture
    values : sequence of M (B, n) arrays
        Readings of each output.
    found : Estimates
        Of B units.
    stations : (B,) array of int
    """
    rms = found.rms
    usable = found.sound & np.isfinite(rms)
    if not usable.any():
        return ()
    usable &= rms <= _WILD * median(rms[usable])
    residuals = np.stack([y @ own for y, own in zip(values, fixture.left, strict=True)], axis=2)
    left = residuals @ found.inverse.transpose(0, 2, 1)
    angles = left.reshape(len(left), -1) @ fixture.inverse.T
    angles = angles.reshape(len(left), -1, 3)  # δ̂_u (B, n, 3) of every unit
    known = fixture.labels, fixture.up, fixture.identifiable
    sums = []
    for station in np.unique(stations[usable]).tolist():
        mine = angles[usable & (stations == station)]
        total, square = mine.sum(axis=0), (mine**2).sum(axis=0)
        sums.append(FixtureSums(station, *known, len(mine), total, square))
    return tuple(sums)
