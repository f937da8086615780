"""What the poses taken determine together: the fit, its parameters against targets, the next pose.

An evaluation is a function of the poses and of what was asked for, and of nothing else: a pose that
is taken back leaves no trace. `evaluate` fits them, `average_poses` gives their means, `model_of`
the model: the linear one first, the one that was asked for as soon as the poses determine it;
`next_pose` chooses what to take next. Whether a target is met is decided here:

    met_j = U_j ≤ T_j at these poses and at all but the last of them, both with ν ≥ 6,         (1)

with U by the noise that the fit finds, which is never less than the rests' own u. After one more
pose it must still hold: stopping where the residuals are small by luck would leave U too small.
"""

import warnings
from dataclasses import replace
from typing import Any

import numpy as np

from multipos.capturing.next_pose import NextPose, best_pose, expected, gain_at
from multipos.capturing.poses import Frame, Pose, find_frame, is_in_space
from multipos.capturing.targets import spread_targets
from multipos.errors import CalibrationWarning, MultiposError, UsageError
from multipos.finding import Finding, Findings, in_order
from multipos.fitting.calibrate_logs import fit_rests
from multipos.logs.averages import Averages
from multipos.logs.joining import Chosen, complete
from multipos.logs.still import StillLog
from multipos.numerics.arrays import COMPONENTS
from multipos.numerics.terms import formula_columns
from multipos.positions.attitudes import Convention
from multipos.positions.order import Order, travel_order
from multipos.positions.scheme import Scheme
from multipos.results import Keyed, Result, frozen
from multipos.sensor.calibration import Calibration
from multipos.sensor.model import Model, build_model, default_axes

FEWEST_DOF = 6


@frozen(eq=True)
class SessionPlan:
    """What was asked for.

    Attributes
    ----------
    fitting : mapping
        Options of the fit.
    targets : mapping of str to float
    positions : int or None
        Poses after which the session is at its end.
    scheme : Scheme or None
        Known positions to lead through.
    order : str, optional
        How they follow each other.
    """

    fitting: dict[str, Any]
    targets: dict[str, float]
    positions: int | None
    scheme: Scheme | None
    order: Order | None

    @property
    def convention(self) -> Convention:
        """Which sign the axis that points up has."""
        found: Convention = self.fitting.get("convention", "specific-force")
        return found

    def axes_of(self, outputs: tuple[str, ...]) -> tuple[int, ...]:
        """Return the axis, 0 to 2, that each output senses."""
        axes = default_axes(outputs, self.fitting.get("axes"))
        return tuple(COMPONENTS.index(axis) for axis in axes)


@frozen(eq=True)
class Progress(Keyed):
    """One parameter and its target; `met` as eq. (1), None without a target."""

    name: str
    value: float
    U: float
    unit: str
    target: float | None
    met: bool | None


@frozen
class PosesGain(Result):
    """How well some poses determine the parameters.

    Attributes
    ----------
    averages : Averages or None
    calibration : Calibration or None
    problem : str or None
        Why there is no calibration yet.
    frame : Frame or None
    parameters : tuple of Progress
    findings : tuple of Finding
    enough : bool
        Whether every target is met.
    """

    averages: Averages | None
    calibration: Calibration | None
    problem: str | None
    frame: Frame | None
    parameters: tuple[Progress, ...]
    findings: Findings
    enough: bool


NOTHING = PosesGain(None, None, "no pose has been taken yet", None, (), (), enough=False)


def evaluate(
    plan: SessionPlan, log: StillLog, poses: list[Pose], before: "PosesGain | None"
) -> PosesGain:
    """Return how well accepted poses determine the parameters.

    Parameters
    ----------
    plan : SessionPlan
    log : StillLog
        The log they are rests of.
    poses : list of Pose
    before : PosesWorth or None
        Of all but the last of them.
    """
    if not poses:
        return NOTHING
    averages = average_poses(plan, log, poses)
    calibration, problem = _fit(plan, averages)
    axes = plan.axes_of(averages.outputs)
    means = averages.readings.values
    asked = [pose.asked for pose in poses] if plan.scheme is None else []
    frame = find_frame(means, axes, plan.convention, calibration, asked)
    parameters: tuple[Progress, ...] = ()
    if calibration is not None:
        parameters = tuple(_progress(plan, calibration, before))
    wanted = [each.met for each in parameters if each.met is not None]
    found = averages.findings if calibration is None else calibration.findings
    return PosesGain(
        averages=averages,
        calibration=calibration,
        problem=problem,
        frame=frame,
        parameters=parameters,
        findings=in_order((*_unreachable(plan, calibration, poses), *found)),
        enough=bool(wanted) and all(wanted) and problem is None,
    )


def average_poses(plan: SessionPlan, log: StillLog, poses: list[Pose]) -> Averages:
    """Return the averages of poses, with the directions of the scheme where one is followed."""
    chosen = [Chosen(pose.position, log, pose.still, given=True) for pose in poses]
    averages = complete([log], chosen, None, plan.convention, [])
    if plan.scheme is None:
        return averages
    names = plan.scheme.names
    rows = [names.index(pose.position) for pose in poses]
    return replace(averages, scheme_up=plan.scheme.up[rows])


def _fit(plan: SessionPlan, averages: Averages) -> tuple[Calibration | None, str | None]:
    """Return the fit of the model asked for, or of the linear one, and what is in the way."""
    problem = None
    options = {name: value for name, value in plan.fitting.items() if name != "model"}
    for model in dict.fromkeys([plan.fitting.get("model", "linear"), "linear"]):
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", CalibrationWarning)  # shown as findings
                return fit_rests(averages, model, **options), problem
        except UsageError:
            raise
        except MultiposError as error:
            problem = problem or str(error)
    return None, problem


def _dof(calibration: Calibration) -> float:
    """Return how many readings more there are than the fit has to find."""
    free = len(calibration.reference) * (1 if calibration.model.gauge else len(calibration.outputs))
    return float(free - len(calibration.parameters))


def _progress(
    plan: SessionPlan, calibration: Calibration, before: PosesGain | None
) -> list[Progress]:
    targets = _targets_in(plan, calibration.model)
    known = None if before is None else before.calibration
    same_names = known is not None and known.names == calibration.names
    said = []
    for entry in calibration.entries:
        target = targets.get(entry.name)
        met = None
        if target is not None:
            met = _small(calibration, entry.name, target)
            met = met and same_names and known is not None and _small(known, entry.name, target)
        said.append(Progress(entry.name, entry.value, entry.U, entry.unit, target, met))
    return said


def _small(calibration: Calibration, name: str, target: float) -> bool:
    return _dof(calibration) >= FEWEST_DOF and target >= calibration[name].U


def _unreachable(plan: SessionPlan, calibration: Calibration | None, poses: list[Pose]) -> Findings:
    """Say which targets cannot be met, by the noise as the fit finds it, and why."""
    if calibration is None or not plan.targets or _dof(calibration) < FEWEST_DOF:
        return ()
    targets = _targets_in(plan, calibration.model)
    scheme = plan.scheme
    further = None if scheme is None else scheme.up[_left_of(scheme, poses)]
    try:
        ratios, count = expected(calibration, targets, further)
    except MultiposError:
        return ()
    named = [name for name in calibration.names if name in targets]
    far = [name for name, ratio in zip(named, ratios.tolist(), strict=True) if ratio > 1.0]
    if not far:
        return ()
    times = f"{float(ratios.max()):.2g} times the target"
    more = f"after {count} more poses all over the sphere"
    action = "Hold poses longer, in a quieter place, or raise the target."
    if further is not None:
        more = f"after the last {count} positions of the scheme" if count else "at its end"
        action = "Use a scheme with more positions, or raise the target."
    text = f"the target of {', '.join(far)} is out of reach: U would be {times} {more}"
    return (Finding("target-out-of-reach", "warning", text, action),)


def _left_of(scheme: Scheme, poses: list[Pose]) -> list[int]:
    """Return the rows of the positions that have not been taken."""
    done = {pose.position for pose in poses}
    return [i for i, label in enumerate(scheme.names) if label not in done]


def model_of(plan: SessionPlan, outputs: tuple[str, ...], unit: str) -> Model:
    """Return the model by which poses are chosen: the one asked for, or the linear one.

    The linear one stands for a model of one's own, or one that depends on more than the position.

    Raises
    ------
    UsageError
        There is no such model, or a target that it does not have; or outputs are not three, so
        that a direction does not show, where no scheme states it.
    """
    if len(outputs) != len(COMPONENTS) and plan.scheme is None:
        raise UsageError(
            f"with {len(outputs)} outputs a direction does not show; name three with --outputs, or "
            "the positions with --scheme."
        )
    axes = default_axes(outputs, plan.fitting.get("axes"))
    asked = plan.fitting.get("model", "linear")
    own = not isinstance(asked, str) or "=" in asked or asked.endswith(".toml")
    columns = () if own else formula_columns(asked)

    def build(formula: str) -> Model:
        built = build_model(formula, outputs, axes, COMPONENTS, unit, columns)
        gauge = plan.fitting.get("gauge", "lower")
        return built.with_gauge(gauge) if plan.scheme is None else built

    if not own:
        spread_targets(plan.targets, build(asked))
    return build("linear" if own or columns else asked)


def next_pose(
    plan: SessionPlan,
    model: Model,
    found: PosesGain,
    frame: Frame | None,
    poses: list[Pose],
    current: Pose | None,
) -> NextPose | None:
    """Return the pose to take next.

    Parameters
    ----------
    found : PosesWorth
    frame : Frame or None
        How readings show directions, by what is under way too.
    poses : list of Pose
        The accepted ones.
    current : Pose or None
        One that is being taken, and will be accepted.
    """
    if plan.scheme is not None:
        return _next_of_scheme(plan, plan.scheme, model, found, poses)
    shown = [*poses, *([] if current is None else [current])]
    asked = np.array([pose.asked for pose in shown if pose.asked is not None]).reshape(-1, 3)
    if is_in_space(asked):  # how the board stands in its case is known, or that nobody follows
        asked = asked[:0]
    taken = np.empty((0, 3))
    if frame is not None and shown:
        asked = frame.in_outputs(asked)
        taken = frame.up(np.array([pose.still.found.mean for pose in shown]))
    best = best_pose(model, found.calibration, taken, _targets_in(plan, model), asked)
    if best is None or frame is None:
        return best
    return replace(best, direction=frame.in_case(best.direction) + 0.0)


def _targets_in(plan: SessionPlan, model: Model) -> dict[str, float]:
    """Return the targets of the parameters that the model has."""
    kinds = {name.partition("_")[0] for name in model.names}
    known = {n: U for n, U in plan.targets.items() if n in kinds or n in model.names}
    return spread_targets(known, model)


def _next_of_scheme(
    plan: SessionPlan, scheme: Scheme, model: Model, found: PosesGain, poses: list[Pose]
) -> NextPose | None:
    """Return the next position of the scheme, as it is laid out or in short ways."""
    labels, left = scheme.names, _left_of(scheme, poses)
    if not left:
        return None
    i = left[0]
    if plan.order == "travel":
        start = scheme.up[[labels.index(poses[-1].position)]] if poses else None
        i = left[int(travel_order(scheme.up[left], start)[0])]
    taken = scheme.up[[labels.index(pose.position) for pose in poses]].reshape(-1, 3)
    gain = gain_at(model, found.calibration, taken, _targets_in(plan, model), scheme.up[i])
    return NextPose(scheme.up[i], gain, labels[i])
