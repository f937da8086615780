"""What a fit finds beside its parameters: how it was made, the noise, the orientations, the terms.

The parts of a `Calibration` that only some estimators and options have; the field is None where
there is nothing to say. Their fields are the keys of the calibration file.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from multipos.numerics.arrays import Array
from multipos.results import Keyed


class Estimator(StrEnum):
    """How the parameters were found; its text is what files and reports say."""

    CLOSED_FORM = "closed-form"
    LINEAR = "linear"
    UNCERTAIN = "uncertain-orientation"
    UNKNOWN = "unknown-orientation"

    @property
    def exact(self) -> bool:
        """Whether orientations were taken as known exactly, so that outputs are fitted alone."""
        return self in (Estimator.CLOSED_FORM, Estimator.LINEAR)


@dataclass(frozen=True, eq=False)
class Component(Keyed):
    """A standard deviation that was estimated with the parameters, and its own uncertainty."""

    value: float
    u: float


@dataclass(frozen=True, eq=False)
class VarianceComponents(Keyed):
    """What restricted maximum likelihood says of the noise; None where it was stated.

    Attributes
    ----------
    reading_sd : Component or None
        In reading units.
    orientation_sd_deg : Component or None
    """

    reading_sd: Component | None = None
    orientation_sd_deg: Component | None = None


@dataclass(frozen=True, eq=False)
class FoundOrientations(Keyed):
    """Where positions were found to be.

    Attributes
    ----------
    orientation_error_deg : (n,) array or None
        How far each position was off; NaN where nothing was known of it.
    group_rotation_deg : mapping of group to (3,) array, or None
        Rotation vector of each group.
    level_sd_deg : float or None
        What was stated of the tilt that all positions share.
    level_tilt_deg : (2,) array or None
        What was found of it, about each level axis.
    """

    orientation_error_deg: Array | None = None
    group_rotation_deg: Mapping[str, Array] | None = None
    level_sd_deg: float | None = None
    level_tilt_deg: Array | None = None


@dataclass(frozen=True, eq=False)
class Chosen(Keyed):
    """How the terms of one output were chosen stepwise.

    Attributes
    ----------
    terms : tuple of str
    path : tuple of {step, action, term, F, p}
    runner_up : {term, F, p} or None
        The best of the terms left out.
    collinear : tuple of str
        Terms that others already say.
    """

    terms: tuple[str, ...]
    path: tuple[Mapping[str, Any], ...]
    runner_up: Mapping[str, Any] | None
    collinear: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class StatedBudget(Keyed):
    """The budget that a covariance follows from.

    Attributes
    ----------
    tables : mapping
        As stated.
    rows : tuple of mappings
        Its lines, evaluated.
    scatter : (p, p) array or None
        Covariance that the readings themselves contribute; None in files that do not say it.
    """

    tables: Mapping[str, Mapping[str, Any]]
    rows: tuple[Mapping[str, Any], ...]
    scatter: Array | None = None
