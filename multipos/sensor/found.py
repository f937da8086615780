"""What a fit finds beside its parameters: how it was made, the noise, the orientations, the terms.

The parts of a `Calibration` that only some estimators and options have; the field is None where
there is nothing to say. Their fields are the keys of the calibration file. `add_scatter` adds the
scatter from rest to rest to the noise of readings.
"""

import math
from collections.abc import Mapping, Sequence
from enum import StrEnum
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np

from multipos.files.numbers import number, uncertain
from multipos.files.records import (
    ANY_NUMBER,
    ANY_TEXT,
    DOF,
    FIGURE,
    NOT_NEGATIVE,
    P_VALUE,
    VARIANCES,
    AnyOf,
    Fields,
    Flag,
    Listed,
    Maybe,
    Named,
    NotNegative,
    Number,
    Numbers,
    Positive,
    Whole,
)
from multipos.files.schema import OPTIONAL, UNREAD
from multipos.numerics.arrays import Array
from multipos.positions.readings import add_variances
from multipos.results import Keyed, frozen

# Null is infinite, 0 none; less than a millionth of one is neither.
DOF_OR_NONE = Maybe(AnyOf((Number(0.0, 0.0), DOF)), math.inf)
# One number a position, or one an output as well where the outputs were fitted apart.
BY_POSITION = AnyOf((Numbers(2, gaps=True), Numbers(1, gaps=True)))
_SETTING = AnyOf((ANY_TEXT, Flag(), Listed(Whole()), ANY_NUMBER))  # of a table in a budget
_LINE = Fields({"quantity": ANY_TEXT, "contribution": Named(FIGURE)})
_TESTED = Fields({"term": ANY_TEXT, "F": FIGURE, "p": P_VALUE})


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

    @property
    def unaffected_by(self) -> frozenset[str]:
        """Which quantities of a budget cannot be wrong, as orientations were not used."""
        return frozenset({"level", "index"} if self is Estimator.UNKNOWN else ())

    @property
    def contains(self) -> frozenset[str]:
        """Which quantities of a budget are part of its likelihood."""
        return frozenset(() if self.exact else {"orientation"})

    def off(self, force: Array, reference: Array) -> Array:
        """Return how far forces (n, k) are off their references (n,).

        In size, where a reference has no known orientation.
        """
        if self is Estimator.UNKNOWN:
            return np.asarray(_norms(force) - _norms(reference))
        return _norms(force - reference)

    @property
    def position(self) -> str:
        """What one of its positions is called."""
        return "hand-held position" if self is Estimator.UNKNOWN else "position"

    @property
    def residual_note(self) -> str:
        """What a residual shows, where orientations were estimated with the parameters."""
        if self.exact:
            return ""
        if self is Estimator.UNCERTAIN:
            return (
                "The orientations were estimated with the parameters, so a residual shows only "
                "what no turn of its position explains."
            )
        return (
            "No orientation is known, so a position has one number: by how much the size of its "
            "compensated force is off. It is what the figure shows."
        )

    @property
    def output_tests(self) -> tuple[str, ...]:
        """Which tests of outputs fitted alone apply to it."""
        return ("terms", "influence", "harmonics") if self.exact else ()


def _norms(vectors: Array) -> Array:
    """Return the norms (n,) of vectors (n, k)."""
    return np.asarray(np.linalg.norm(vectors, axis=1))


class Parameter(NamedTuple):
    """One parameter with its uncertainty; U = k u at the calibration's confidence."""

    output: str
    term: str
    name: Annotated[str, UNREAD]
    value: float
    u: Annotated[float, Maybe(NOT_NEGATIVE, math.nan)]
    dof: Annotated[float, DOF_OR_NONE]
    k: Annotated[float, Maybe(NOT_NEGATIVE, math.nan)]
    U: Annotated[float, UNREAD]
    unit: Annotated[str, UNREAD]
    label: Annotated[str, UNREAD]
    symbol: Annotated[str | None, UNREAD]

    def __str__(self) -> str:
        return f"{self.name} = {uncertain(self.value, self.u)} {self.unit}, U = {number(self.U, 2)}"


_FIGURE = Maybe(ANY_NUMBER, math.nan)


class Status(NamedTuple):
    """How the estimator ended; the last step is relative, the gradient in units of u."""

    converged: bool
    iterations: int
    message: str
    last_step: Annotated[float, _FIGURE, OPTIONAL] = 0.0
    gradient: Annotated[float, _FIGURE, OPTIONAL] = 0.0


@frozen
class Component(Keyed):
    """A standard deviation that was estimated with the parameters, and its own uncertainty."""

    value: Positive
    u: Positive


@frozen
class OrientationSpread(Keyed):
    """How far positions were off [degrees], per axis, estimated with the parameters.

    Attributes
    ----------
    value, u : float
    determined : bool
        Whether it is known to a factor of two.
    low, high : float
        Ends of its central 68 %.
    source : str
        'stated' as the centre of what was estimated, 'estimated' freely, or 'exact'.
    """

    value: NotNegative
    u: NotNegative
    determined: bool
    low: NotNegative
    high: NotNegative
    source: Literal["stated", "estimated", "exact"]

    @property
    def in_words(self) -> str:
        """Its value and the ends."""
        return f"{self.value:.2g} degrees (68 %: {self.low:.2g} to {self.high:.2g})"

    @staticmethod
    def _upgraded(content: Mapping[str, Any]) -> Any:
        """Return what a file says; versions before 0.3 gave no ends, 0.1 what was determined."""
        value, u = content.get("value"), content.get("u")
        if not (isinstance(value, float) and isinstance(u, float)):
            return content
        ends = {"low": max(value - u, 0.0), "high": value + u, "source": "estimated"}
        return {"determined": True, **ends, **content}


@frozen
class RestToRest(Keyed):
    """Scatter of one output from rest to rest, beyond what its readings state.

    Attributes
    ----------
    value, u : float
        Standard deviation added to the stated uncertainty, and how well it is known.
    dof : float
        Degrees of freedom of the variance of a reading, both parts together.
    """

    value: NotNegative
    u: NotNegative
    dof: Annotated[float, DOF_OR_NONE]


@frozen
class VarianceComponents(Keyed):
    """What was found of the noise beside the parameters; None where it was not to be found.

    Attributes
    ----------
    rest_to_rest : mapping of output to RestToRest, or None
        Where readings state their uncertainty.
    reading_sd : Component or None
        In reading units.
    orientation_sd_deg : OrientationSpread or None
    effective_rows : mapping of output to float, or None
        Of a record whose rows are correlated: how many independent ones a mean of it is equivalent
        to.
    """

    rest_to_rest: Annotated[Mapping[str, RestToRest] | None, OPTIONAL] = None
    reading_sd: Annotated[Component | None, OPTIONAL] = None
    orientation_sd_deg: Annotated[OrientationSpread | None, OPTIONAL] = None
    effective_rows: Annotated[Mapping[str, NotNegative] | None, OPTIONAL] = None


def add_scatter(
    noise: Array | None, components: VarianceComponents | None, outputs: Sequence[str]
) -> Array | None:
    """Return noise, as `Readings.noise` has it, with the scatter from rest to rest beside it."""
    if noise is None or components is None or components.rest_to_rest is None:
        return noise
    scatter = [components.rest_to_rest[output].value ** 2 for output in outputs]
    return add_variances(noise, np.tile(scatter, len(noise) // len(scatter)))


@frozen
class FoundOrientations(Keyed):
    """Where positions were found to be.

    Attributes
    ----------
    orientation_error_deg : (n,) array or None
        How far each position was off; NaN where nothing was known of it.
    group_rotation_deg : mapping of group to (3,) array, or None
        Rotation vector of each group.
    inclination_deg : mapping of group to float, or None
        How far the axis points up, of rolls of open angle that share an inclination.
    level_sd_deg : float or None
        What was stated of the tilt that all positions share.
    level_tilt_deg : (2,) array or None
        What was found of it, about each level axis.
    """

    orientation_error_deg: Annotated[Array | None, BY_POSITION, OPTIONAL] = None
    group_rotation_deg: Annotated[Mapping[str, Array] | None, OPTIONAL] = None
    inclination_deg: Annotated[Mapping[str, float] | None, OPTIONAL] = None
    level_sd_deg: Annotated[float | None, NOT_NEGATIVE, OPTIONAL] = None
    level_tilt_deg: Annotated[Array | None, OPTIONAL] = None


class Excluded(NamedTuple):
    """A row that was set aside before the fit: its label, how far off it is, and its number.

    Versions before 0.3 did not say which row of its label it is: 0.
    """

    label: str
    off: NotNegative
    unit: str
    row: Annotated[int, OPTIONAL] = 0


@frozen
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

    terms: Annotated[tuple[str, ...], Listed(ANY_TEXT, 1)]
    path: Annotated[tuple[Mapping[str, Any], ...], Listed(_TESTED)]
    runner_up: Annotated[Mapping[str, Any] | None, Maybe(_TESTED)]
    collinear: tuple[str, ...]


@frozen
class StatedBudget(Keyed):
    """The budget that a covariance follows from.

    Attributes
    ----------
    tables : mapping
        As stated.
    rows : tuple of mappings
        Its lines, evaluated.
    scatter : (p, p) array or None
        Covariance that the readings give before common causes are taken out of their residuals;
        None in files that do not say it.
    """

    tables: Annotated[Mapping[str, Mapping[str, Any]], Named(Named(_SETTING))]
    rows: Annotated[tuple[Mapping[str, Any], ...], Listed(_LINE)]
    scatter: Annotated[Array | None, VARIANCES, OPTIONAL] = None
