"""How to fit: the options, written out once in the signature of `multipos.fit`, and checked once.

`Options` is what the fit passes on of them, checked; `choose_estimator` and `criterion_in_words`
say what they call for. `takes_options` gives a function that hands its ``**options`` on the
signature with all of them in it, so that `help`, editors and the reference show them, and refuses
a name that is none of them.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import wraps
from inspect import Parameter, signature
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from multipos.errors import MultiposError, UsageError
from multipos.estimation import correlated_rows
from multipos.files.spelling import Names, near
from multipos.files.tables import Source
from multipos.numerics.arrays import COMPONENTS
from multipos.numerics.losses import LOSSES, Loss
from multipos.numerics.quantiles import check_confidence
from multipos.numerics.terms import ModelText
from multipos.positions.attitudes import Convention, check_convention
from multipos.positions.headers import TEMPERATURE
from multipos.positions.order import Order
from multipos.positions.orientations import StatedOrientations
from multipos.positions.readings import Readings
from multipos.positions.scheme import Scheme
from multipos.results import frozen
from multipos.sensor.bench import BenchOptions, require_numbers
from multipos.sensor.found import Estimator
from multipos.sensor.model import GAUGES, Gauge, Model
from multipos.sensor.temperature import runs_of, soaks_of
from multipos.uncertainty.budgets import Budget, BudgetSource

_CONTRADICT = {
    "--closed-form": (
        "--unknown-orientation",
        "--orientation-sd",
        "--level-sd",
        "--robust",
        "--stepwise",
        "--drift",
    ),
    # Where orientations are unknown, outputs have one noise anyway.
    "--unknown-orientation": ("--orientation-sd", "--level-sd", "--pool"),
}


class FitOptions(BenchOptions, total=False):
    """The options of `multipos.fit`, which whatever calibrates hands on to it."""

    scheme: "Source | Scheme | None"
    order: Order
    model: ModelText
    convention: Convention
    outputs: Names | None
    axes: Names | None
    inputs: Names
    closed_form: bool
    unknown_orientation: bool
    orientation_sd: float | Literal["auto"] | None
    gauge: Gauge
    robust: Loss | None
    pool: bool
    stepwise: bool
    exclude: Names
    drift: bool
    reading_sd: ArrayLike | None
    level_sd: float
    budget: BudgetSource | Budget | None
    unit: str | None
    nominal: Sequence[float] | None


Function = TypeVar("Function", bound=Callable[..., Any])


def takes_options(
    options: type, *of: Callable[..., Any], **defaults: Any
) -> Callable[[Function], Function]:
    """Give a function the keywords that it hands on to others.

    Parameters
    ----------
    options : TypedDict
        Which they are.
    *of : functions
        In whose signatures they are written out.
    **defaults
        Of keywords that have another default in this function.

    Returns
    -------
    function
        Of a function, the same one with the whole signature, which refuses any other keyword with
        a `TypeError` that offers the nearest.
    """
    taken = options.__annotations__

    def written_out(function: Function) -> Function:
        own = signature(function)
        named = {p.name: p for p in own.parameters.values() if p.kind is not Parameter.VAR_KEYWORD}
        for source in of:
            for each in signature(source).parameters.values():
                if each.kind is Parameter.KEYWORD_ONLY and each.name in taken:
                    default = defaults.get(each.name, each.default)
                    named.setdefault(each.name, each.replace(default=default))

        @wraps(function)
        def checked(*arguments: Any, **options: Any) -> Any:
            for name in options.keys() - named.keys():
                way = near(name, named)
                raise TypeError(f"{function.__name__}() takes no option '{name}'{way}")
            return function(*arguments, **options)

        whole = own.replace(parameters=tuple(named.values()))
        checked.__signature__ = whole  # type: ignore[attr-defined]
        return checked  # type: ignore[return-value]

    return written_out


@frozen(eq=True)
class Options:
    """What was asked for, as `multipos.fit` takes it.

    Attributes
    ----------
    convention, gauge, robust, confidence, closed_form, unknown_orientation, pool, stepwise, drift
    orientation_sd, level_sd
        As in `multipos.fit`, angles in degrees.
    resolution : float
        Standard uncertainty by the resolution that a budget states, in reading units.

    Raises
    ------
    UsageError
        One is no such option, or two contradict each other.
    """

    convention: Convention = "specific-force"
    gauge: Gauge = GAUGES[0]
    robust: Loss | None = None
    confidence: float = 0.95
    closed_form: bool = False
    unknown_orientation: bool = False
    pool: bool = False
    stepwise: bool = False
    drift: bool = False
    orientation_sd: float | Literal["auto"] | None = None
    level_sd: float = 0.0
    resolution: float = 0.0

    def __post_init__(self) -> None:
        """Refuse what is no such option, and two that contradict each other."""
        check_convention(self.convention)
        if self.gauge not in GAUGES:
            raise UsageError(f"unknown gauge '{self.gauge}'; give lower or symmetric.")
        if self.robust is not None and self.robust not in LOSSES:
            raise UsageError(f"unknown loss '{self.robust}'; --robust takes {', '.join(LOSSES)}.")
        require_numbers(self, "confidence", "level_sd")
        check_confidence(self.confidence)
        if not 0.0 <= self.level_sd < 90.0:
            raise UsageError(f"--level-sd must lie between 0 and 90 degrees, got {self.level_sd}.")
        if self.orientation_sd == "auto" and self.robust is not None:
            raise UsageError(
                "--orientation-sd auto and --robust cannot be estimated from the same residuals."
            )
        given = {
            "--closed-form": self.closed_form,
            "--unknown-orientation": self.unknown_orientation,
            "--orientation-sd": self.orientation_sd is not None,
            "--level-sd": self.level_sd > 0.0,
            "--robust": self.robust is not None,
            "--stepwise": self.stepwise,
            "--drift": self.drift,
            "--pool": self.pool,
        }
        _check_together([name for name, present in given.items() if present])
        _check_spread(self.orientation_sd)

    @property
    def as_listed(self) -> "Options":
        """The same with orientations taken as they are listed, where errors are estimated."""
        return replace(self, orientation_sd=None) if self.orientation_sd == "auto" else self

    @property
    def spread(self) -> dict[str, Any]:
        """How far orientations may be from those listed [rad], as `place` takes it."""
        sd = self.orientation_sd
        return {
            "orientation_sd": None if sd is None or isinstance(sd, str) else math.radians(sd),
            "estimate": sd == "auto",
            "level_sd": math.radians(self.level_sd),
        }


def _check_together(given: list[str]) -> None:
    """Refuse options that contradict each other."""
    for first in given:
        for other in _CONTRADICT.get(first, ()):
            if other in given:
                raise UsageError(f"{first} and {other} contradict each other; give one.")


def _check_spread(sd: float | str | None) -> None:
    if sd is None or sd == "auto":
        return
    if isinstance(sd, str):
        raise UsageError(f"--orientation-sd takes degrees or 'auto', got '{sd}'.")
    if not 0.0 <= sd < 180.0:
        raise UsageError(f"--orientation-sd must lie between 0 and 180 degrees, got {sd}.")


_EXACT_BESIDE = ("robust", "pool", "level_sd")  # options beside which nothing is estimated
_MOST = 5000  # rows, of which a fit with orientation errors takes some seconds
_LEFT = 2  # contrasts of every output, below which nothing is


def with_default_errors(
    options: Options, stated_up: StatedOrientations, readings: Readings, model: Model
) -> tuple[Options, str | None]:
    """Return options with orientation errors estimated where nobody says anything of them.

    The second is why not, in words, where they are taken as exact all the same; None where they
    are estimated, stated or unknown.
    """
    stated = options.orientation_sd is not None or readings.orientation_sd is not None
    if stated or options.closed_form or not stated_up.exact:
        return options, None
    beside = [name for name in _EXACT_BESIDE if getattr(options, name)]
    spare = len(readings) - max(len(terms) for terms in model.terms)
    if beside:
        why = f"their errors are not estimated with --{beside[0].replace('_', '-')}"
    elif len(readings.outputs) < len(COMPONENTS):
        why = f"{len(readings.outputs)} of three outputs do not show their errors"
    elif len(readings) > _MOST:
        why = f"of more than {_MOST} rows none is estimated"
    elif readings.forced.any():
        why = "known forces are taken as they stand"
    elif spare < _LEFT:
        why = f"the model leaves {max(spare, 0)} contrasts of an output, of {_LEFT} needed"
    elif (np.ptp(readings.values, axis=0) == 0.0).any():
        why = "an output never changes"
    elif _between_positions(readings):
        why = "readings are correlated between positions"
    elif runs_of(readings, model) is not None:
        why = "their errors are not estimated with a zero for each run"
    elif TEMPERATURE in model.environment and soaks_of(readings) is not None:
        why = "their errors are not estimated with a zero for each soak"
    elif correlated_rows.are_asked(model, readings, stated_up.reference, Estimator.LINEAR):
        why = "rows of one record, many for each position, do not show their errors"
    else:
        return replace(options, orientation_sd="auto"), None
    return options, why


def _between_positions(readings: Readings) -> bool:
    """Tell whether what is stated of the noise correlates readings of several positions."""
    noise, n = readings.noise, len(readings)
    if noise is None or noise.ndim == 1:
        return False
    position = np.arange(len(noise)) // (len(noise) // n)
    return bool(noise[position[:, None] != position].any())


def choose_estimator(options: Options, stated_up: StatedOrientations) -> Estimator:
    """Return the estimator that the options and what is known of the positions call for.

    Raises
    ------
    MultiposError
        The closed form, which takes exact orientations, is asked for where they are not.
    """
    if options.closed_form:
        if not stated_up.exact:
            raise MultiposError(
                "--closed-form takes exact orientations, but the readings have groups, rolls of "
                "open angle or orientation_sd_deg above 0; leave --closed-form out."
            )
        return Estimator.CLOSED_FORM
    if stated_up.unknown:
        return Estimator.UNKNOWN
    return Estimator.LINEAR if stated_up.exact else Estimator.UNCERTAIN


def criterion_in_words(
    estimator: Estimator, options: Options, model: Model, readings: Readings
) -> str:
    """Return what the estimator makes least or most, for the result."""
    stated = readings.noise is not None
    return _CRITERIA[estimator].format(
        weighted="weighted " if stated else "",
        nonlinear="" if model.has_terms else "nonlinear ",
        noise="stated reading noise" if stated else "equal reading noise",
        loss="" if options.robust is None else f", {options.robust} loss",
    )


_CRITERIA = {
    Estimator.CLOSED_FORM: "exact solution of the six-position equations",
    Estimator.LINEAR: "{weighted}{nonlinear}least squares of the readings{loss}",
    Estimator.UNCERTAIN: "maximum a posteriori of readings and orientations, {noise}{loss}",
    Estimator.UNKNOWN: "maximum likelihood of the readings, {noise}{loss}",
}
