"""The session: rests in, the state out, and what the user decides in between.

    rests → poses (taken, or refused with a reason) → evaluation → next pose → enough?

A `Session` changes by four things only: rows that come, `undo`, `redo` of a pose, and `finish`.
Whoever looks at it from another thread holds `changed`, its lock. What is shown of it is in
`multipos.capturing.state`.
"""

import threading
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from multipos.capturing import evaluation, poses
from multipos.capturing.live_rests import LiveRests
from multipos.capturing.live_rows import LiveRows, RowOptions
from multipos.capturing.next_pose import NextPose
from multipos.logs.log_columns import magnetic_outputs
from multipos.logs.still import Still, StillLog
from multipos.logs.table import Log
from multipos.numerics.arrays import Array
from multipos.sensor.gravity import GRAVITY, Field, field_sensed
from multipos.sensor.model import Model

_LIVE = 0.05  # [s] of rows that a live value is the mean of
_OFF_DEG = 10.0  # from a position of the scheme


class Session:
    """A guided session.

    Attributes
    ----------
    changed : threading.Condition
        To be held by whoever looks at the session or changes it; called at every change.
    version : int
        Counts changes of anything but the live values.
    poses : list of Pose
        Every rest that was offered.
    evaluation : PosesWorth
    asked_to_finish, finished : bool
    connected : bool
    rows, rests, model : LiveRows, LiveRests, Model, or None
        Once the columns are known.
    field : Field
        What the outputs sense, by names and unit.
    decided : dict of str to str
        What the user took back: the first row of each rest, and why.
    next : NextPose or None
    newest : (M,) array or None
        What the sensor reads.
    under_way : Pose or None
        What is still for long enough, but has not ended.
    notify : callable
        Is given the session after each pose, again after one whose rest the threshold moves,
        which is fixed by three, and where `connected` changes.
    """

    def __init__(
        self,
        plan: evaluation.SessionPlan,
        reading: RowOptions,
        notify: "Callable[[Session], object] | None" = None,
    ) -> None:
        self.plan: evaluation.SessionPlan = plan
        self._reading = reading
        self._notify = notify
        self._reported: list[tuple[int, int]] = []  # the rests that were reported
        self.changed: threading.Condition = threading.Condition()
        self.version: int = 0
        self.ticks: int = 0
        self.poses: list[poses.Pose] = []
        self.evaluation: evaluation.PosesGain = evaluation.NOTHING
        self.finished: bool = False
        self.asked_to_finish: bool = False
        self.connected: bool = True
        self.rows: LiveRows | None = None
        self.rests: LiveRests | None = None
        self.model: Model | None = None
        self.field: Field = GRAVITY
        self._known: dict[tuple[str, ...], evaluation.PosesGain] = {(): evaluation.NOTHING}
        self.next: NextPose | None = None
        self._is_fixed = reading.threshold is not None
        self._again = ""  # the pose that is to be taken again
        self.newest: Array | None = None
        self.under_way: poses.Pose | None = None
        self._asked: list[tuple[int, Array]] = []  # first row, and the direction asked for from it
        self.decided: dict[str, str] = {}

    # What changes it

    def begin(self, log: Log, head: Array) -> LiveRows:
        """Settle what the columns are, by the first rows.

        Raises
        ------
        UsageError
            An option does not fit them.
        """
        asked = self._reading
        kind, unit = (self.plan.fitting.get(name) for name in ("field", "unit"))
        outputs = asked.outputs
        if outputs is None and kind == "magnetic":
            outputs = magnetic_outputs(log, None, kind, unit)
        self.rows = LiveRows(log, head, outputs, asked.timing)
        self.rests = LiveRests(self.rows, asked.min_duration, asked.threshold)
        unit = unit or log.units.get(self.rows.outputs[0], "reading")
        self.field = field_sensed(self.rows.outputs, unit, kind)
        self.model = evaluation.model_of(self.plan, self.rows.outputs, unit)
        self._choose_next()
        return self.rows

    def feed(self, columns: Array, *, connected: bool = True) -> list[bool]:
        """Take up numeric columns (k, n) of the log; return which rows are good."""
        assert self.rows is not None
        assert self.rests is not None
        if connected != self.connected:
            self.connected = connected
            self.version += 1
            if self._notify is not None:
                self._notify(self)
        if not columns.shape[1]:
            return []
        outputs, good = self.rows.take(columns)
        if outputs.shape[1]:
            self._show_live(outputs)
            if self.rests.feed(outputs):
                self._offer_settled()
            self._look_under_way()
        self.ticks += 1
        return good

    def undo(self) -> str | None:
        """Take back the newest pose; return its position, None where there is none."""
        for i in reversed(range(len(self.poses))):
            if self.poses[i].accepted:
                self._take_back(i, "taken back")
                return self.poses[i].position
        return None

    def redo(self, position: str) -> bool:
        """Take one pose again: what was taken back counts again, what counts is asked for anew.

        Returns whether there is such a pose.
        """
        places = [i for i, pose in enumerate(self.poses) if pose.position == position]
        for i in reversed(places):
            pose = self.poses[i]
            if pose.undone:
                self.poses[i] = pose.restored()
                self.decided.pop(self.key(pose))
                self._again = "" if self._again == position else self._again
                self._evaluate()
                return True
            if pose.accepted:
                self._again = position
                self._take_back(i, "to be taken again")
                return True
        return False

    def finish(self) -> None:
        """End the session: what is still counts as if the log ended here.

        Raises
        ------
        MultiposError
            There is nothing like a rest.
        """
        if self.finished:
            return
        try:
            if self.rests is not None and self.rests.finish():
                self._offer_settled()
        finally:
            self.finished = True
        self.under_way = None
        self.next = None
        self.version += 1

    # What it is

    @property
    def accepted(self) -> list[poses.Pose]:
        """The poses that count."""
        return [pose for pose in self.poses if pose.accepted]

    @property
    def threshold(self) -> float | None:
        """The threshold V, once it is fixed."""
        return None if self.rests is None else self.rests.threshold

    @property
    def rate(self) -> float | None:
        """The rate R [Hz]."""
        return None if self.rows is None else self.rows.rate

    @property
    def is_enough(self) -> bool:
        """Whether every target is met, or as many poses taken as were asked for."""
        count = len(self.accepted)
        done = self.plan.positions is not None and count >= self.plan.positions
        if self.plan.scheme is not None and self.threshold is not None:
            done = done or count >= len(self.plan.scheme)
        return self.threshold is not None and (done or self.evaluation.enough)

    # How it goes on

    def _show_live(self, outputs: Array) -> None:
        assert self.rows is not None
        count = max(1, round((self.rows.rate or 100.0) * _LIVE))
        self.newest = outputs[:, -count:].mean(axis=1)

    def direction(self, mean: Array | None) -> Array | None:
        """Return the up vector (3,) that a reading (M,) shows, None where it does not."""
        frame = self._frame()
        if mean is None:
            return None
        if frame is None:  # no pose yet: the reading itself may be in a known unit
            assert self.rows is not None
            axes = self.plan.axes_of(self.rows.outputs)
            frame = poses.find_frame(mean[np.newaxis], axes, self.plan.convention, None)
        if frame is None:
            return None
        up = frame.in_case(frame.up(mean[np.newaxis]))[0]
        return up if np.isfinite(up).all() else None

    def _frame(self) -> poses.Frame | None:
        """Return how readings show directions, by the poses taken and what is under way."""
        current = self.under_way
        if current is None or current.reason is not None or self.plan.scheme is not None:
            return self.evaluation.frame
        assert self.rows is not None
        shown = [*self.accepted, current]
        return poses.find_frame(
            np.array([pose.still.found.mean for pose in shown]),
            self.plan.axes_of(self.rows.outputs),
            self.plan.convention,
            self.evaluation.calibration,
            [pose.asked for pose in shown],
        )

    def directions(self) -> list[Array | None]:
        """Return the up vector (3,) of every pose."""
        means = [pose.still.found.mean for pose in self.poses]
        if self.evaluation.frame is None or not means:
            return [self.direction(mean) for mean in means]
        frame = self.evaluation.frame
        up = frame.in_case(frame.up(np.array(means)))
        return [each if np.isfinite(each).all() else None for each in up]

    def _offer_settled(self) -> None:
        """Offer the rests that are new; all of them anew while they are provisional."""
        assert self.rests is not None
        settled = self.rests.settled
        kept = [pose.still.rows for pose in self.poses]
        moved = kept != [still.rows for still in settled[: len(kept)]]
        if moved or (self.threshold is not None and not self._is_fixed):
            self._is_fixed = self.threshold is not None
            self.poses, self._known = [], {(): evaluation.NOTHING}
        for still in settled[len(self.poses) :]:
            if self.is_enough:
                return
            self.poses.append(self._judge(still, str(len(self.poses) + 1)))
            self._evaluate()
            self._tell(still)

    def _tell(self, still: Still) -> None:
        """Tell of the newest pose: once before the threshold is fixed, and again if it moved."""
        place = len(self.poses) - 1
        before = self._reported[place : place + 1]
        if self._notify is None or (before and (self.threshold is None or before == [still.rows])):
            return
        self._reported[place : place + 1] = [still.rows]
        self._notify(self)

    def _judge(self, still: Still, number: str) -> poses.Pose:
        """Return the pose that a rest is, accepted or refused."""
        assert self.rows is not None
        asked = next((up for row, up in reversed(self._asked) if row <= still.rows.start), None)
        pose = poses.Pose(number, still, accepted=True, reason=None, asked=asked)
        reason = poses.refuse_rest(still, self.rows.outputs, self.threshold)
        if reason is None:
            means = np.array([each.still.found.mean for each in self.accepted])
            reason = poses.refuse_unit(still, self.evaluation.frame, means)
        if self.plan.scheme is not None:
            position, off = self._place(still)
            pose = replace(pose, position=position or number)
            reason = reason or off
        elif reason is None:
            reason = self._repeats(still)
        if reason is not None:
            return replace(pose, accepted=False, reason=self.field.worded(reason))
        taken_back = self.decided.get(self.key(pose))
        return pose if taken_back is None else pose.taken_back(taken_back)

    def _repeats(self, still: Still) -> str | None:
        up = self.direction(still.found.mean)
        accepted = self.accepted
        if up is None or not accepted or self.evaluation.frame is None:
            return None
        means = np.array([pose.still.found.mean for pose in accepted])
        labels = [pose.position for pose in accepted]
        frame = self.evaluation.frame
        return poses.refuse_repeat(up, frame.in_case(frame.up(means)), labels)

    def _place(self, still: Still) -> tuple[str, str | None]:
        """Return the position of the scheme that a rest is at, and why it is at none."""
        scheme = self.plan.scheme
        assert scheme is not None
        asked = "" if self.next is None else self.next.label
        if not asked:
            return "", "every position of the scheme has been taken"
        up = self.direction(still.found.mean)
        if up is None:
            return asked, None
        labels = scheme.names
        off = poses.apart_deg(scheme.up, up)
        if off[labels.index(asked)] <= _OFF_DEG:
            return asked, None
        done = {pose.position for pose in self.accepted}
        i = int(np.argmin(off))
        if off[i] > _OFF_DEG:
            return "", (
                f"{off[labels.index(asked)]:.0f} degrees from position {asked}, and at none of the "
                f"scheme: the nearest, {labels[i]}, is {off[i]:.0f} degrees away"
            )
        if labels[i] in done:
            return "", f"repeats position {labels[i]} of the scheme; {asked} is next"
        return labels[i], None

    def _take_back(self, place: int, reason: str) -> None:
        pose = self.poses[place]
        self.poses[place] = pose.taken_back(reason)
        self.decided[self.key(pose)] = reason
        self._evaluate()

    @staticmethod
    def key(pose: poses.Pose) -> str:
        """Return what tells a pose from all others: where its rest begins."""
        return str(pose.still.rows.start)

    def _evaluate(self) -> None:
        """Evaluate the poses that count, and choose the next."""
        accepted = self.accepted
        self.evaluation = self._evaluated(accepted)
        if self._again and any(pose.position == self._again for pose in accepted):
            self._again = ""
        self._choose_next()
        self.version += 1

    def _evaluated(self, accepted: Sequence[poses.Pose]) -> evaluation.PosesGain:
        key = tuple(self.key(pose) for pose in accepted)
        if key not in self._known:
            before = None
            if self.plan.targets:
                before = self._evaluated(accepted[:-1])
            self._known[key] = evaluation.evaluate(
                self.plan, self.still_log(), list(accepted), before
            )
            for old in list(self._known)[1:-64]:  # the newest are asked for again, by undo
                del self._known[old]
        return self._known[key]

    def _choose_next(self) -> None:
        assert self.model is not None
        again = next((pose for pose in self.poses if pose.position == self._again), None)
        current = self.under_way
        if current is not None and current.reason is not None:
            current = None
        if again is not None and self._again:
            up = self.direction(again.still.found.mean)
            if up is not None:
                self.next = NextPose(up, None, self._again)
                return
        self.next = evaluation.next_pose(
            self.plan, self.model, self.evaluation, self._frame(), self.accepted, current
        )
        row = 0 if self.rows is None else self.rows.rows
        if self.next is not None:
            self._asked.append((row, self.next.direction))

    def _look_under_way(self) -> None:
        """See whether the sensor has been still for long enough, and lead on from there."""
        assert self.rests is not None
        motion = self.rests.motion()
        long_enough = motion.still and not motion.samples_left
        if long_enough == (self.under_way is not None):
            return
        self.under_way = None
        if long_enough:
            still = self.rests.running()
            if still is not None:
                self.under_way = self._judge(still, str(len(self.poses) + 1))
        self._choose_next()
        self.version += 1

    def still_log(self) -> StillLog:
        """Return the log as it is by now, for the averages of its rests."""
        rows, rests = self.rows, self.rests
        assert rows is not None
        assert rests is not None
        return StillLog(
            log=rows.log,
            outputs=rows.outputs,
            rests=tuple(rests.settled),
            short=(),
            shortest=rests.grid.shortest,
            survey=rests.survey,
            clock=rows.clock,
            rate=rows.rate,
            threshold=rests.threshold,
            findings=rows.findings,
        )
