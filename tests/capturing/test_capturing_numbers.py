"""Numbers of a session by hand or by a second route, at points without symmetry."""

import math
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
    poses,
    sources,
)
from multipos.capturing.next_pose import _ratios, _score, _State, gain_of
from multipos.designs.information import Setting
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


def of_plan(scheme=None, targets=None, order="scheme", **fitting):
    return SimpleNamespace(scheme=scheme, targets=targets or {}, order=order, fitting=fitting)


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
