"""Ordinary situations at a desk: the error of multipos' first command beside those of others.

Every row simulates logs of a hand that puts a triad down, by a generator of its own: rests turned
between, reading f K' + b [m/s²] at 100 Hz with white noise, and what the row adds. The first
command is `mp.calibrate(log)` and nothing else. Its error is that of force [mg], rms over the
sphere but for a rotation of the case, or where the row says so that of the zero; the table has the
median over logs. Beside it the best of the peers that answered half of the logs, and the ratio to
it, which is the geometric mean over the logs that both answered: of one log errors are alike.

Peers are written from what is published of them, and given nothing of the truth:

- imu_tk: rests by a threshold of 1 … 10 times the variance of the first, at rest for 30 s, all
  of its thresholds tried, (|f|² − 1)² over their means by LM from nominal numbers [1]_;
- mag_cal: the algebraic ellipsoid through the means of the detector below [2]_;
- up/down: mean and half the difference of opposite faces, as imucal [3]_;
- LM: |f| − 1 by SciPy over the rests of multipos, unweighted; `own LM` over those of a detector
  of ten lines: .5-s windows whose sd is below twice that of the quietest half, for 1.5 s;
- soft_l1: as `own LM` with SciPy's robust loss at 1.48 median residuals;
- option: multipos with an option that its user would have to know.

References
----------
.. [1] Tedaldi, Pretto, Menegatti, ICRA 2014, 3042–3049.
.. [2] Heeb, IEEE Trans. Magn. 45 (2009); the fit of circuitpython-mag-cal.
.. [3] Ferraris, Grimaldi, Parvis, Sensors and Materials 7 (1995), 311–330.
"""

import argparse
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

import multipos as mp

Array = np.ndarray[Any, Any]
G = 9.80665  # [m/s²]
RATE = 100  # [Hz]
ZERO = np.array([0.12, -0.21, 0.33])  # [m/s²]
K = G * np.array([[1.012, 0.0, 0.0], [0.003, 0.991, 0.0], [0.004, -0.007, 1.008]])
AXES = ("x", "y", "z")
LOWER = np.tril_indices(3)
FACES = np.vstack([np.eye(3), -np.eye(3)])
WINDOW, LONG = RATE // 2, 3 * RATE // 2  # [samples], of the detector of ten lines
LIMIT = 1.05  # of the ratio to the best peer


@dataclass(frozen=True)
class Recording:
    """One simulated log, and the truth of it."""

    values: Array  # (N, 3) [m/s²]
    rest: Array  # (N,), which rest a sample is of, -1 while turned
    up: Array  # (n, 3)
    odd: tuple[str, ...] = ()  # labels of the rests that are off

    @property
    def log(self) -> dict[str, Array]:
        named = {f"a{axis}": np.round(self.values[:, i], 5) for i, axis in enumerate(AXES)}
        return {"time": np.arange(len(self.values)) / RATE, **named}


Line = tuple[Array, Array]  # zero (3,) and K (3, 3) [m/s²]


@dataclass(frozen=True)
class Row:
    """A situation: how its logs are made, who is asked, and what is wanted [mg]."""

    make: Callable[[np.random.Generator], Recording]
    wanted: float | None = None
    peers: tuple[str, ...] = ("imu_tk", "mag_cal", "LM", "own LM", "soft_l1")
    options: Mapping[str, Any] = field(default_factory=dict)  # of `option`
    of_zero: bool = False


# --- logs


def spread(rng: np.random.Generator, n: int) -> Array:
    """Return n directions spread over the sphere, turned and in order by chance."""
    height = 1.0 - 2.0 * (np.arange(n) + 0.5) / n
    angle = np.pi * (1.0 + 5.0**0.5) * np.arange(n)
    flat = np.sqrt(1.0 - height**2)
    points = np.column_stack([np.cos(angle) * flat, np.sin(angle) * flat, height])
    turn = Rotation.from_quat(rng.standard_normal(4))
    return np.asarray(turn.apply(points)[rng.permutation(n)])


def unit(v: Array) -> Array:
    return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True))


def tremor(rng: np.random.Generator, n: int, memory: float, sd: float) -> Array:
    """Return low-passed noise (n, 3) of a memory [s] and a standard deviation."""
    a = np.exp(-1.0 / (memory * RATE))
    return np.asarray(
        sd * lfilter([np.sqrt(1.0 - a * a)], [1.0, -a], rng.standard_normal((n, 3)), 0)
    )


def recorded(
    rng: np.random.Generator,
    up: Array,
    rests: float | Array = 4.0,
    *,
    K: Array = K,
    noise: float = 0.02,
    sway: float = 0.0,
    shake: float = 0.0,
    memory: float = 0.2,
    push: Mapping[int, Array] | None = None,
    drift: float = 0.0,
    clip: float = np.inf,
    spikes: float = 0.0,
    step: float = 0.0,
    vibration: float = 0.0,
    second: float = 0.0,
    first: float = 30.0,
) -> Recording:
    """Return the log of a sensor put down at each direction for so many seconds.

    Sway [°] and shake [m/s²] of the hand have `memory` [s]; `push` is off single rests [m/s²],
    drift [m/s²] goes through the log, spikes hit a share of cells, `second` is a K2 [g/g²].
    """
    seconds = np.array(np.broadcast_to(rests, len(up)), float)
    seconds[0] = max(first, seconds[0])
    force, rest, before = [], [], unit(np.array([0.6, 0.6, 0.5]))
    for i, there in enumerate(up):
        ramp = (1.0 - np.cos(np.linspace(0.0, np.pi, LONG)))[:, None] / 2.0
        way = unit((1.0 - ramp) * before + ramp * there + 1e-3 * rng.standard_normal(3))
        n = int(seconds[i] * RATE)
        still = np.repeat(there[None], n, axis=0)
        if sway:
            still = Rotation.from_rotvec(np.radians(tremor(rng, n, 0.3, sway))).apply(still)
        if shake:
            still = still + tremor(rng, n, memory, shake) / G
        if push is not None and i in push:
            still = still + push[i] / G
        if vibration:
            phase = 2.0 * np.pi * 23.7 * np.arange(n) / RATE + rng.uniform(0.0, 6.0)
            still = still + vibration / G * np.sin(phase)[:, None] * unit(rng.standard_normal(3))
        force += [way + 0.15 * rng.standard_normal(way.shape), still]
        rest += [np.full(LONG, -1), np.full(n, i)]
        before = there
    force.append(
        unit(before + 0.3 * rng.standard_normal(3)) + 0.15 * rng.standard_normal((LONG, 3))
    )
    rest.append(np.full(LONG, -1))
    f = np.concatenate(force)
    y = ZERO + f @ K.T + G * second * f**2 + noise * rng.standard_normal(f.shape)
    y += drift * np.linspace(-0.5, 0.5, len(y))[:, None] * np.array([1.0, -1.0, 1.0])
    y += (rng.random(y.shape) < spikes) * rng.choice([-5.0, 5.0], y.shape)
    y = np.clip(y, -clip, clip)
    y = np.round(y / step) * step if step else y
    odd = tuple(str(i + 1) for i in sorted(push or ()))
    return Recording(y, np.concatenate(rest), up, odd)


def pushed(count: int, size: float, n: int = 24) -> Callable[[np.random.Generator], Recording]:
    """Return what makes logs of which some rests are off by a size [m/s²] along gravity."""

    def make(rng: np.random.Generator) -> Recording:
        up = spread(rng, n)
        odd = rng.choice(n, count, replace=False)
        push = {int(i): size * unit(up[i] + 0.3 * rng.standard_normal(3)) for i in odd}
        return recorded(rng, up, push=push)

    return make


def by_hand(degrees: float) -> Callable[[np.random.Generator], Recording]:
    """Return what makes logs of six faces put down by hand, of a sensor with cross terms."""

    def make(rng: np.random.Generator) -> Recording:
        turn = Rotation.from_rotvec(np.radians(degrees) * rng.standard_normal((6, 3)))
        cross = 3e-3 * rng.standard_normal((3, 3)) * (1.0 - np.eye(3))
        return recorded(rng, turn.apply(FACES), 6.0, K=np.diag(np.diag(K)) + G * cross)

    return make


def plain(n: int = 24, **more: Any) -> Callable[[np.random.Generator], Recording]:
    return lambda rng: recorded(rng, spread(rng, n), **more)


def near_one_face(rng: np.random.Generator) -> Recording:
    near = unit(np.array([0.0, 0.0, 1.0]) + 0.2 * rng.standard_normal((14, 3)))
    return recorded(rng, np.vstack([near, spread(rng, 10)]))


def unequal(**more: Any) -> Callable[[np.random.Generator], Recording]:
    """Return what makes logs of rests of 2.2 to 20 s."""
    return lambda rng: recorded(
        rng, spread(rng, 24), rng.choice([2.2, 3.0, 6.0, 20.0], 24), first=20.0, **more
    )


def short(rng: np.random.Generator) -> Recording:
    return recorded(rng, spread(rng, 24), rng.uniform(1.0, 2.0, 24))


OFF = ("imu_tk", "mag_cal", "LM", "own LM", "soft_l1", "option")
HUBER = {"robust": "huber"}
HAND: dict[str, Any] = {"sway": 0.3, "shake": 0.1}
ROWS: dict[str, Row] = {
    "plain": Row(plain()),
    "one-off-102mg": Row(pushed(1, 1.0), 0.2, OFF, HUBER),
    "two-off-10mg": Row(pushed(2, 0.1), 0.2, OFF, HUBER),
    "two-off-41mg": Row(pushed(2, 0.4), 0.2, OFF, HUBER),
    "two-off-102mg": Row(pushed(2, 1.0), 0.2, OFF, HUBER),
    "five-off-41mg": Row(pushed(5, 0.4), 0.2, OFF, HUBER),
    "faces-1deg": Row(by_hand(1.0), 0.2, ("up/down", "option"), {"model": "1 + own"}, True),
    "faces-3deg": Row(by_hand(3.0), 0.5, ("up/down", "option"), {"model": "1 + own"}, True),
    "tremor": Row(plain(**HAND), 4.25),
    "tremor-unequal": Row(unequal(**HAND)),
    "ten-rests": Row(plain(10), 0.14),
    "one-face": Row(near_one_face, 0.15),
    "spikes": Row(plain(spikes=0.003), 0.15),
    "noise": Row(plain(noise=0.5), 2.7),
    "vibration": Row(plain(vibration=1.0), 1.4),
    "short": Row(short, None, ("imu_tk", "mag_cal", "LM", "option"), {"min_duration": 1.0}),
    "hand-held": Row(plain(sway=0.3, shake=0.01 * G, first=4.0)),
    "unequal": Row(unequal()),
    "saturated": Row(plain(clip=9.9)),
    "second-order": Row(plain(second=0.005)),
    "drift": Row(plain(drift=0.15)),
    "coarse": Row(plain(step=0.15, noise=0.03)),
}


# --- peers


def kept(values: Array, window: int) -> Array:
    """Return the sum of variances (N,) over windows centred on each sample."""
    sums = np.cumsum(np.vstack([np.zeros((1, 6)), np.hstack([values, values**2])]), axis=0)
    mean = (sums[window:] - sums[:-window]) / window
    return np.asarray(np.sqrt(np.sum((mean[:, 3:] - mean[:, :3] ** 2) ** 2, axis=1)))


def stretches(still: Array, least: int) -> list[tuple[int, int]]:
    """Return from where to where at least so many are still."""
    edge = np.flatnonzero(np.diff(np.concatenate([[0], still.astype(int), [0]])))
    return [(a, b) for a, b in edge.reshape(-1, 2).tolist() if b - a >= least]


def own_means(made: Recording) -> Array:
    """Return the means of the rests of a detector of ten lines."""
    y = made.values - made.values.mean(axis=0)
    sums = np.cumsum(np.vstack([np.zeros((1, 6)), np.hstack([y, y**2])]), axis=0)
    mean = (sums[WINDOW:] - sums[:-WINDOW]) / WINDOW
    sd = np.sqrt(np.maximum((mean[:, 3:] - mean[:, :3] ** 2).sum(axis=1), 0.0))
    limit = 2.0 * np.median(np.sort(sd)[: len(sd) // 2])
    found = stretches(sd < limit, LONG - WINDOW)
    return np.array([made.values[a + 5 : b + WINDOW - 5].mean(axis=0) for a, b in found])


def solved(y: Array, power: int = 1, start: Line | None = None, **more: Any) -> Line:
    """Return zero and lower K from |f|^power − 1 over readings (n, 3), by SciPy."""

    def misfit(x: Array) -> Array:
        inverse = np.zeros((3, 3))
        inverse[LOWER] = x[3:]
        return np.asarray(np.linalg.norm((y / G - x[:3]) @ inverse.T, axis=1) ** power - 1.0)

    if len(y) < 9:
        raise ValueError("too few rests")
    zero, line = (np.zeros(3), G * np.eye(3)) if start is None else start
    x0 = np.concatenate([zero / G, np.linalg.inv(line / G)[LOWER]])
    if more:
        more["f_scale"] = max(1.4826 * float(np.median(np.abs(misfit(x0)))), 1e-9)
    else:
        more["method"] = "lm"
    x = least_squares(misfit, x0, **more).x
    inverse = np.zeros((3, 3))
    inverse[LOWER] = x[3:]
    return x[:3] * G, G * np.linalg.inv(inverse)


def ellipsoid(y: Array) -> Line:
    """Return zero and lower K of the algebraic ellipsoid through readings (n, 3)."""
    if len(y) < 9:
        raise ValueError("too few rests")
    x, pairs = y / G, [(0, 1), (0, 2), (1, 2)]
    design = np.column_stack([x**2, *(2.0 * x[:, i] * x[:, j] for i, j in pairs), 2.0 * x])
    p = np.linalg.lstsq(design, np.ones(len(x)), rcond=None)[0]
    A = np.array([[p[0], p[3], p[4]], [p[3], p[1], p[5]], [p[4], p[5], p[2]]])
    centre = -np.linalg.solve(A, p[6:])
    size = 1.0 + centre @ A @ centre
    return G * centre, G * np.linalg.cholesky(np.linalg.inv(A / size))


def imu_tk(made: Recording) -> Line:
    """Return what imu_tk's thresholds make of a log; 101 samples are its window."""
    y, window = made.values[LONG:], 101
    size = kept(y, window)
    level = float(kept(y[: 25 * RATE], 25 * RATE)[0])
    best: tuple[float, Line] | None = None
    for times in range(1, 11):
        found = stretches(size < times * level, window)
        means = [y[a + window // 2 : b + window // 2].mean(axis=0) for a, b in found]
        if len(means) < 12:
            continue
        each = np.array(means)
        line = solved(each, 2)
        misfit = float(np.mean((np.sum(force(each, line) ** 2, axis=1) - 1.0) ** 2))
        if best is None or misfit < best[0]:
            best = misfit, line
    if best is None:
        raise ValueError("fewer than 12 rests")
    return best[1]


def up_down(made: Recording) -> Line:
    """Return zero and scales of six rests, by the faces they are nearest to."""
    y = own_means(made)
    if len(y) != 6:
        raise ValueError("not six rests")
    high, low = y[np.argmax(y, axis=0)], y[np.argmin(y, axis=0)]
    return np.diag(high + low) / 2.0, ((high - low) / 2.0).T


def soft_l1(made: Recording) -> Line:
    y = own_means(made)
    return solved(y, start=solved(y), loss="soft_l1")


PEERS: dict[str, Callable[[Recording], Line]] = {
    "imu_tk": imu_tk,
    "mag_cal": lambda made: ellipsoid(own_means(made)),
    "own LM": lambda made: solved(own_means(made)),
    "soft_l1": soft_l1,
    "up/down": up_down,
}


# --- the table


@dataclass
class Tally:
    """What came of the logs of one row."""

    errors: dict[str, dict[int, float]] = field(default_factory=dict)  # [mg], by who and log
    rests: list[float] = field(default_factory=list)  # found over true
    held: list[float] = field(default_factory=list)  # of zero and scales, by U
    named: list[bool] = field(default_factory=list)  # all that are off, and no others
    failures: list[str] = field(default_factory=list)

    def answered(self, who: str) -> int:
        return len(self.errors.get(who, {}))

    def error(self, who: str) -> float:
        return float(np.median(list(self.errors[who].values()))) if who in self.errors else np.nan

    def ratio(self, who: str) -> float:
        """Return our error over that of a peer; infinite where no log has both."""
        mine, theirs = self.errors.get("multipos", {}), self.errors[who]
        both = sorted(mine.keys() & theirs.keys())
        if not both:
            return float("inf")
        return float(np.exp(np.mean([np.log(mine[i] / theirs[i]) for i in both])))


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.ordinary", description=__doc__)
    parser.add_argument("rows", nargs="*", metavar="ROW", help=f"of {', '.join(ROWS)}")
    parser.add_argument("--logs", type=int, default=5, help="of each row")
    parser.add_argument("--seed", type=int, default=1)
    chosen = parser.parse_args()
    if unknown := set(chosen.rows) - set(ROWS):
        parser.error(f"no row {', '.join(sorted(unknown))}; there are {', '.join(ROWS)}")
    warnings.simplefilter("ignore", mp.CalibrationWarning)
    print("| row | first command [mg] | best peer [mg] | ratio | wanted | rests | U held | named |")
    print("|---" * 8 + "|")
    for name in chosen.rows or ROWS:
        found = measured(name, chosen.logs, chosen.seed)
        print(line_of(name, found, chosen.logs), flush=True)


def measured(name: str, logs: int, seed: int) -> Tally:
    """Return what came of so many logs of a row; the same logs whatever other rows are asked."""
    row, found = ROWS[name], Tally()
    for i in range(logs):
        made = row.make(np.random.default_rng([seed, i, *name.encode()]))
        averages = None
        try:
            calibration = mp.calibrate(made.log)
        except mp.MultiposError as error:
            found.failures.append(str(error))
        else:
            note_own(found, row, made, calibration, i)
            averages = calibration.readings.values
        for who in row.peers:
            try:
                line = asked(who, row, made, averages)
            except (mp.MultiposError, ValueError, np.linalg.LinAlgError):
                continue
            found.errors.setdefault(who, {})[i] = error_of(line, made, row)
    return found


def asked(who: str, row: Row, made: Recording, averages: Array | None) -> Line:
    """Return what a peer makes of a log; the means of multipos' rests are for `LM`."""
    if who == "option":
        return line_from(mp.calibrate(made.log, **row.options))
    if who == "LM":
        if averages is None:
            raise ValueError("no rests")
        return solved(averages)
    return PEERS[who](made)


def note_own(found: Tally, row: Row, made: Recording, c: mp.Calibration, i: int) -> None:
    """Note what the first command made of the i-th log."""
    zero, line = line_from(c)
    found.errors.setdefault("multipos", {})[i] = error_of((zero, line), made, row)
    found.rests.append((len(c.readings) + len(c.excluded)) / len(made.up))
    truth = np.linalg.cholesky(K @ K.T)
    for k, (output, axis) in enumerate(zip(c.outputs, AXES, strict=True)):
        found.held.append(abs(zero[k] - ZERO[k]) <= c[output, "1"].U)
        if not row.of_zero:
            found.held.append(abs(line[k, k] - truth[k, k]) <= c[output, axis].U)
    if made.odd:
        found.named.append(tuple(sorted((each.label for each in c.excluded), key=int)) == made.odd)


def line_from(c: mp.Calibration) -> Line:
    """Return zero and K of a calibration; a term that its model has not is zero."""
    at = {(p.output, p.term): p.value for p in c.entries}
    zero = np.array([at[output, "1"] for output in c.outputs])
    return zero, np.array([[at.get((output, x), 0.0) for x in AXES] for output in c.outputs])


def force(y: Array, line: Line) -> Array:
    """Return force (n, 3) [g] of readings (n, 3)."""
    return np.asarray(np.linalg.solve(line[1], (y - line[0]).T).T)


def error_of(line: Line, made: Recording, row: Row) -> float:
    """Return the error [mg] of force but for a rotation of the case, or of the zero."""
    zero, matrix = line
    if row.of_zero:
        return 1e3 * float(np.linalg.norm(zero - ZERO)) / G
    f = spread(np.random.default_rng(1), 300)
    off = (
        force(
            ZERO + f @ np.linalg.cholesky(K @ K.T).T, (zero, np.linalg.cholesky(matrix @ matrix.T))
        )
        - f
    )
    return 1e3 * float(np.sqrt(np.mean(np.sum(off**2, axis=1))))


def line_of(name: str, found: Tally, logs: int) -> str:
    """Return the row of the table."""
    row = ROWS[name]
    ratios = {who: found.ratio(who) for who in row.peers if found.answered(who) * 2 > logs}
    best = max(ratios, key=lambda who: ratios[who]) if ratios else ""
    mine = found.error("multipos")
    lost = f" ({len(found.failures)} of {logs} refused)" if found.failures else ""
    peer = f"{found.error(best):.3g} {best}" if best else "–"
    ratio = f"{ratios[best]:.2f}" if best and np.isfinite(ratios[best]) else "–"
    missed = bool(lost)
    # What no peer reaches on these logs is decided by the ratio.
    reached = max(row.wanted or np.inf, found.error(best) if best else 0.0)
    missed |= not mine <= reached
    missed |= bool(best) and not ratios[best] <= LIMIT
    wanted = "–" if row.wanted is None else f"≤ {row.wanted:g}"
    rests = f"{100.0 * np.mean(found.rests):.0f} %" if found.rests else "–"
    held = f"{100.0 * np.mean(found.held):.0f} %" if found.held else "–"
    named = f"{sum(found.named)} of {len(found.named)}" if found.named else "–"
    cells = (name, f"{mine:.3g}{lost}", peer, ratio, wanted, rests, held, named)
    return f"| {' | '.join(cells)} |{' missed' if missed else ''}"


if __name__ == "__main__":
    main()
