"""Numbers of a session by hand or by a second route, at points without symmetry."""

import io
import math
import threading
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.stats import t

import multipos as mp
from multipos.capturing import (
    arrivals,
    evaluation,
    keeping,
    live_rests,
    live_rows,
    poses,
    screen,
    serving,
    sources,
)
from multipos.capturing import next_pose as next_pose_module
from multipos.capturing import session as session_module
from multipos.capturing.next_pose import _ratios, _score, _State, best_pose, gain_of
from multipos.designs.information import Setting
from multipos.logs.rests import Rest
from multipos.sensor.model import build_model

MODEL = build_model("linear", ("ax", "ay", "az"), ("x", "y", "z"))
TAKEN = np.array([[1.0, 0.0, 0.0], [0.0, 0.6, 0.8], [0.0, -0.8, 0.6], [-0.6, 0.0, -0.8]])


def state(dof=7.0):
    rng = np.random.default_rng(3)
    X = [np.append(1.0, up) for up in TAKEN]
    present = np.kron(np.eye(3), sum(np.outer(x, x) for x in X) + 0.1 * np.eye(4))
    return _State(Setting(MODEL), present, rng.uniform(1, 2, 12), rng.uniform(0.01, 0.02, 12), dof)


def ratios_by_hand(now, up, targets, dof):
    own = np.kron(np.eye(3), np.outer(np.append(1.0, up), np.append(1.0, up)))
    u = np.sqrt(np.diag(np.linalg.inv(now.present + own)) * now.scale + now.fixed)
    k = t.ppf(0.975, dof if dof > 0.0 else 1.0)
    return [k * u[MODEL.names.index(name)] / target for name, target in targets.items()]


def test_what_a_pose_would_make_of_targets_and_of_the_whole():
    # eqs. (1), (2) of capturing.next_pose
    targets, up = {"bias_ay": 0.3, "scale_az": 0.7, "bias_ax": 0.2}, np.array([0.48, -0.64, 0.6])
    now = state()
    own = np.kron(np.eye(3), np.outer(np.append(1.0, up), np.append(1.0, up)))
    assert_allclose(_ratios(now, own[None], targets, 7.0)[0], ratios_by_hand(now, up, targets, 7.0))
    assert_allclose(_ratios(now, own[None], targets, 0.0)[0], ratios_by_hand(now, up, targets, 0.0))
    alike = now._replace(present=np.ones((12, 12)))  # without an inverse, of which 1/144 is left
    u = np.sqrt(now.scale / 144.0 + now.fixed)[MODEL.names.index("bias_ay")]
    found = _ratios(alike, np.zeros((1, 12, 12)), {"bias_ay": 0.3}, 7.0)
    assert_allclose(found, t.ppf(0.975, 7.0) * u / 0.3)
    by_hand = -math.log(sum(r**8 for r in ratios_by_hand(now, up, targets, 7.0)))
    assert _score(now, up[None], targets)[0] == pytest.approx(by_hand)
    whole = np.linalg.slogdet(now.present + own)[1]
    assert _score(now, up[None], {})[0] == pytest.approx(whole)
    assert gain_of(now, up, {}) == pytest.approx(whole - np.linalg.slogdet(now.present)[1])
    u = np.sqrt(np.diag(np.linalg.inv(now.present)) * now.scale + now.fixed)
    worst = t.ppf(0.975, 7.0) * max(u[MODEL.names.index(n)] / w for n, w in targets.items())
    then = max(ratios_by_hand(now, up, targets, 8.0))
    assert gain_of(now, up, targets) == pytest.approx(worst - then)


@pytest.mark.parametrize(("share", "fine"), [(0.97, True), (0.99, False)])
def test_an_easy_direction_is_taken_where_it_is_nearly_the_best(share, fine, monkeypatch):
    """Of what the best would gain 98 % are enough; none is near a pose that was taken."""
    seen = []

    def scored(now, up, led_by):
        if up is None:
            return np.zeros(1)
        seen.append(up)
        return np.linspace(0.1, share if len(up) < 26 else 1.0, len(up))

    monkeypatch.setattr(next_pose_module, "_score", scored)
    found = best_pose(MODEL, None, TAKEN, {})
    assert_allclose(found.direction, seen[1][-1] if fine else seen[0][-1])
    for up in seen:
        assert (up @ TAKEN.T).max() < math.cos(math.radians(20.0))
    every = mp.read_scheme("fibonacci-2000").up
    assert best_pose(MODEL, None, every, {}) is None


@pytest.mark.parametrize(
    ("size", "found"),
    [(9.0, True), (11.1, True), (8.2, False), (11.5, False), (1.1, True), (900.0, True)],
)
def test_a_frame_without_a_centre_is_of_a_known_g(size, found):
    """Within 15 % of 9.80665, 1 or 1000; of many poses their centre tells it."""
    # eq. (1) of capturing.poses
    up = mp.read_scheme("fibonacci-3").up
    frame = poses.find_frame(size * up, (2, 0, 1), "gravity", None)
    assert (frame is not None) is found
    if found:
        assert (frame.size, frame.order, frame.sign) == (pytest.approx(size), (1, 2, 0), -1.0)
    many = mp.read_scheme("fibonacci-12").up
    frame = poses.find_frame(7.0 * many + [3.0, -2.0, 1.0], (0, 1, 2), "force", None)
    assert_allclose(frame.centre, [3.0, -2.0, 1.0], atol=1e-9)
    assert (frame.size, frame.sign) == (pytest.approx(7.0), 1.0)
    assert poses.find_frame(many[:, :2], (0, 1), "force", None) is None


def test_angles_between_directions_near_and_far():
    rng = np.random.default_rng(2)
    up = rng.normal(size=(5, 3))
    up /= np.linalg.norm(up, axis=1)[:, None]
    up[3] = up[0] + 1e-9 * np.cross(up[0], up[1]) / np.linalg.norm(np.cross(up[0], up[1]))
    by_hand = np.degrees(np.arccos(up[[1, 2, 4]] @ up[0]))
    assert_allclose(poses.apart_deg(up, up[0])[[1, 2, 4]], by_hand)
    assert poses.apart_deg(up, up[0])[3] == pytest.approx(math.degrees(1e-9))
    assert poses.apart_deg(-up[:1] * (1.0 + 1e-12), up[0])[0] == pytest.approx(180.0)


def of_plan(scheme=None, targets=None, order="scheme", **fitting):
    return SimpleNamespace(scheme=scheme, targets=targets or {}, order=order, fitting=fitting)


@pytest.mark.parametrize(
    ("asked", "terms"),
    [("1 + own", 6), ("own-quadratic", 15), ("1 + x + y + z + temperature", 12), ("own.toml", 12),
     ("a = b*x", 12), (len, 12)],
)  # fmt: skip
def test_the_model_by_which_poses_are_chosen(asked, terms):
    """The one asked for, or the linear one; without a scheme less the rotations of the case."""
    outputs = ("az", "ax", "ay")
    scheme = mp.read_scheme("fibonacci-9")
    model = evaluation.model_of(of_plan(scheme, model=asked), outputs, "g")
    assert (len(model.names), model.axes, model.gauge) == (terms, ("z", "x", "y"), None)
    assert model.environment == ()
    free = evaluation.model_of(of_plan(model=asked, axes=["y", "z", "x"]), outputs, "g")
    assert (free.axes, free.gauge) == (("y", "z", "x"), "lower")
    assert len(free.names) == (6 if terms == 6 else terms - 3)


class Fitted(SimpleNamespace):
    def __getitem__(self, name):
        return next(entry for entry in self.entries if entry.name == name)


def a_calibration(n, U=0.02, gauge=None):
    entries = [SimpleNamespace(name=name, value=0.5, U=U, unit="g") for name in MODEL.names]
    model = SimpleNamespace(gauge=gauge, names=MODEL.names, outputs=MODEL.outputs, keys=MODEL.keys)
    return Fitted(
        entries=entries, names=MODEL.names, model=model, reference=np.zeros((n, 3)),
        outputs=MODEL.outputs, parameters=np.zeros(12),
    )  # fmt: skip


def test_degrees_of_freedom_and_targets_that_are_met(monkeypatch):
    """3 n − 12, n − 12 of unknown orientation; a target is met twice on six at least."""
    assert evaluation._dof(a_calibration(9)) == 15.0
    assert evaluation._dof(a_calibration(17, gauge="lower")) == 5.0
    monkeypatch.setattr(evaluation, "spread_targets", lambda targets, model: targets)
    plan = of_plan(targets={"bias_ax": 0.0201, "scale_ay": 0.0199})
    for n, before, met in (
        (6, a_calibration(6), True), (5, a_calibration(6), False), (6, a_calibration(5), False),
        (6, a_calibration(6, U=0.021), False), (6, None, False),
    ):  # fmt: skip
        last = None if before is None else SimpleNamespace(calibration=before)
        said = {each.name: each for each in evaluation._progress(plan, a_calibration(n), last)}
        assert (said["bias_ax"].met, said["scale_ay"].met) == (met, False)
        assert (said["bias_ay"].met, said["bias_ay"].target) == (None, None)


@pytest.mark.parametrize(
    ("ratio", "n", "said"), [(0.999, 9, False), (1.001, 9, True), (1.7, 6, True), (1.7, 5, False)]
)
def test_targets_out_of_reach_by_the_noise_that_the_fit_finds(ratio, n, said, monkeypatch):
    monkeypatch.setattr(evaluation, "spread_targets", lambda targets, model: targets)
    seen = []

    def expected(calibration, targets, further):
        seen.append(further)
        return np.array([0.4, ratio]), 0 if further is not None and not len(further) else 7

    monkeypatch.setattr(evaluation, "expected", expected)
    scheme = mp.read_scheme("fibonacci-9")
    taken = [SimpleNamespace(position=label) for label in scheme.names[:4]]
    targets = {"scale_ay": 0.1, "bias_ax": 0.2}
    for plan, done, where in (
        (of_plan(targets=targets), taken, "after 7 more poses all over"),
        (of_plan(scheme, targets), taken, "after the last 7 positions of the scheme"),
        (of_plan(scheme, targets), [SimpleNamespace(position=x) for x in scheme.names], "its end"),
    ):
        found = evaluation._unreachable(plan, a_calibration(n), done)
        assert bool(found) is said
        if said:
            assert f"target of scale_ay is out of reach: U would be {ratio:.2g}" in found[0].text
            assert where in found[0].text
    if said:
        assert_allclose(seen[1], scheme.up[4:])
    assert evaluation._unreachable(of_plan(), a_calibration(9), taken) == ()
    assert evaluation._unreachable(of_plan(targets=targets), None, taken) == ()


@pytest.mark.parametrize("order", ["scheme", "travel"])
def test_the_next_position_of_a_scheme(order, monkeypatch):
    scheme = mp.read_scheme("fibonacci-9")
    given = []
    monkeypatch.setattr(evaluation, "gain_at", lambda *those: given.append(those) or 0.7)
    taken = [SimpleNamespace(position=scheme.names[i]) for i in (3, 0)]
    plan, found = of_plan(scheme, order=order), SimpleNamespace(calibration="c")
    pose = evaluation._next_of_scheme(plan, scheme, MODEL, found, taken)
    left = [i for i in range(9) if i not in (0, 3)]
    nearest = left[int(np.argmax(scheme.up[left] @ scheme.up[0]))]
    i = left[0] if order == "scheme" else nearest
    assert (pose.label, pose.gain) == (scheme.names[i], 0.7)
    assert_allclose(given[0][2], scheme.up[[3, 0]])
    assert_allclose(given[0][4], scheme.up[i])
    first = evaluation._next_of_scheme(plan, scheme, MODEL, found, [])
    assert first.label in scheme.names
    assert given[1][2].shape == (0, 3)
    every = [SimpleNamespace(position=name) for name in scheme.names]
    assert evaluation._next_of_scheme(plan, scheme, MODEL, found, every) is None


def test_a_stream_that_begins_has_seen_no_version():
    session = SimpleNamespace(changed=threading.Condition(), version=1, ticks=0)
    seen = []
    server = SimpleNamespace(ending=True, session=session, event=lambda v: seen.append(v) or b"e")
    handler = SimpleNamespace(server=server, wfile=io.BytesIO())
    serving._Handler._send_events(handler)
    assert seen == [-1]
    assert handler.wfile.getvalue() == b"e"


def test_rows_are_counted_for_their_rate_from_the_first_look_on(monkeypatch):
    """Eleven lines waited; 31 more in 3.1 s are ten a second, and before 3 s nothing is said."""
    clock = iter([100.0, 102.99, 103.1])
    monkeypatch.setattr(arrivals.time, "monotonic", lambda: next(clock))
    head = SimpleNamespace(_begun=None, _lines=["x"] * 11, _rate=None)
    assert not arrivals._Head._is_counted(head)
    head._lines = ["x"] * 42
    assert not arrivals._Head._is_counted(head)
    assert head._rate is None
    assert arrivals._Head._is_counted(head)
    assert head._rate == pytest.approx(10.0)


@pytest.mark.parametrize("untimed", [True, False])
def test_rows_without_a_time_wait_for_their_rate(monkeypatch, untimed):
    clock = iter([100.0, 103.0])
    monkeypatch.setattr(arrivals.time, "monotonic", lambda: next(clock))
    head = arrivals._Head(SimpleNamespace(name="serial", untimed=untimed), None)
    rows = "0.01,0.02,1.0\n" * 60
    assert head.take(rows) is not untimed
    assert not untimed or head.take(rows)
    assert head._rate == (20.0 if untimed else None)


@pytest.mark.parametrize(
    ("speed", "rate", "rows"), [(2.0, 100.0, 10), (3.0, 4.0, 1), (0.0, 9.0, 0)]
)
def test_a_replay_sends_rows_when_they_would_have_come(speed, rate, rows, monkeypatch):
    """So many in .05 s, at least one; the clock of the test goes as far as it is slept."""
    clock, table = [50.0], np.arange(33.0)
    monkeypatch.setattr(sources.time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(sources.time, "sleep", lambda s: clock.__setitem__(0, clock[0] + s))
    piece = SimpleNamespace(table=SimpleNamespace(columns={"a": table, "b": -table}))
    log = SimpleNamespace(numeric=("a", "b"), source="log", read=lambda *a, **k: iter([piece]))
    monkeypatch.setattr(sources, "open_log", lambda path, columns: log)
    source = SimpleNamespace(path="log", rate=rate)
    head, *arrivals = sources._replay(source, None, speed)
    assert head.columns.shape == (2, 33)
    sent, waits = 0, 0
    for arrival in arrivals:
        waits += not arrival.columns.shape[1]
        sent += arrival.columns.shape[1]
        assert arrival.columns.shape[1] in (0, rows or 33, 33 % (rows or 34))
    assert sent == 33
    last = 33 // rows * rows if rows and 33 % rows else 33 - rows if rows else 0
    assert clock[0] - 50.0 == pytest.approx(last / (rate * speed) if speed else 0.0)
    if speed:
        assert waits >= last / (rate * speed) / 0.05 - 1e-6


def test_rows_of_the_log_that_a_rest_is_count_those_left_out():
    """Five are bad, of which two are forgotten; of the others 40 and 41 come before the rest."""
    rows = SimpleNamespace(bad=5, _left_out=[40, 41, 57], rate=8.0)
    found = live_rows.LiveRows.in_log(rows, Rest(41, 58))
    assert (found.start, found.end) == (41 + 4, 58 + 5)
    assert live_rows.LiveRows.time(rows, Rest(41, 58)) == (5.125, 7.125)


def test_a_terminal_shows_the_state_again_and_again(monkeypatch):
    """Each picture is written in place of the one before, and none stays at the end."""
    pictures, seen = iter([["a", "b"], ["c"], ["d"]]), threading.Event()

    def picture_of(state):
        assert state == "state of session"
        lines = next(pictures, None)
        if lines is None:
            seen.set()
        return lines or []

    terminal = SimpleNamespace(isatty=lambda: True, write=(said := []).append, flush=lambda: None)
    monkeypatch.setattr(screen.sys, "stderr", terminal)
    monkeypatch.setattr(screen, "_OFTEN", 1e-4)
    monkeypatch.setattr(screen, "state_of", lambda session: "state of session")
    monkeypatch.setattr(screen, "picture_of", picture_of)
    session = SimpleNamespace(changed=threading.Lock())
    with screen.text_screen(session, commands=False):
        assert seen.wait(10.0)
    wanted = ["a\nb\n", "\x1b[2F\x1b[Jc\n", "\x1b[1F\x1b[Jd\n", "\x1b[1F\x1b[J"]
    assert said[:4] == wanted
    assert "".join(said[4:]) == ""


@pytest.mark.parametrize(("rate", "count"), [(200.0, 10), (None, 5), (3.0, 1)])
def test_a_live_value_is_the_mean_of_fifty_milliseconds(rate, count):
    outputs = np.random.default_rng(1).normal(size=(3, 33))
    session = SimpleNamespace(rows=SimpleNamespace(rate=rate))
    session_module.Session._show_live(session, outputs)
    assert_allclose(session.newest, outputs[:, -count:].mean(axis=1))


def test_samples_left_until_a_stretch_is_a_rest():
    """Still since row 60, of blocks of 5 and windows of 8 blocks: 24 windows end with block 31."""
    rests = SimpleNamespace(
        _finder=None, _provisional=SimpleNamespace(still_since=60), _seen=24, _newest=0.3,
        grid=SimpleNamespace(shortest=110, block=5),
    )  # fmt: skip
    assert live_rests.LiveRests.motion(rests) == (0.3, True, 110 - (31 * 5 - 60))
    rests.grid.shortest = 90
    assert live_rests.LiveRests.motion(rests).samples_left == 0
    rests._finder = SimpleNamespace(still_since=None)
    assert live_rests.LiveRests.motion(rests) == (0.3, False, 90)


def test_poses_are_offered_anew_where_rests_moved_or_the_threshold_is_fixed():
    def session(kept, threshold=None, fixed=False, enough=9):
        made = SimpleNamespace(
            rests=SimpleNamespace(settled=[SimpleNamespace(rows=r) for r in ("p", "q", "r")]),
            poses=[SimpleNamespace(still=SimpleNamespace(rows=r)) for r in kept],
            threshold=threshold, _is_fixed=fixed, _known=None, judged=[], told=[],
        )  # fmt: skip
        made._judge = lambda still, number: (
            made.judged.append((still.rows, number)) or (SimpleNamespace(still=still))
        )
        made._evaluate = lambda: setattr(made, "is_enough", len(made.poses) >= enough)
        made._tell = lambda still: made.told.append(still.rows)
        made.is_enough = False
        session_module.Session._offer_settled(made)
        return made

    assert session("p").judged == [("q", "2"), ("r", "3")]
    assert session("x").judged == [("p", "1"), ("q", "2"), ("r", "3")]
    assert session("p", threshold=0.1).told == ["p", "q", "r"]
    assert session("p", threshold=0.1, fixed=True).told == ["q", "r"]
    assert session("p", enough=2).told == ["q"]


def test_a_log_that_is_begun_anew_is_read_from_its_beginning(tmp_path, monkeypatch):
    rested = []
    monkeypatch.setattr(sources.time, "sleep", rested.append)
    log = tmp_path / "log.csv"
    log.write_bytes(b"ax,ay,az\n1,2,3\n")
    chunks = sources._growing(log)
    assert [next(chunks), next(chunks)] == [b"ax,ay,az\n1,2,3\n", b""]
    with log.open("ab") as stream:
        stream.write(b"4,5,6\n")
    assert next(chunks) == b"4,5,6\n"
    log.write_bytes(b"7,8,9\n")
    assert [next(chunks), next(chunks), next(chunks)] == [None, b"", b"7,8,9\n"]
    assert rested == [sources._TICK] * 2  # where there was nothing to read
    chunks.close()


@pytest.mark.parametrize(
    ("part", "value"),
    [("threshold", "0.1"), ("rate_by_arrival", []), ("taken_back", None), ("taken_back", ["p"])],
)
def test_a_session_of_other_kinds_is_refused(part, value, monkeypatch):
    found = {"threshold": 0.1, "rate_by_arrival": None, "taken_back": {"1": "p"}}
    monkeypatch.setattr(keeping, "read_json", lambda path, schema: found)
    assert keeping._read("s.json") == found
    found = found | {part: value}
    with pytest.raises(mp.MultiposError, match="is of another kind; begin a new session"):
        keeping._read("s.json")
