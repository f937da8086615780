"""What guidance is worth: poses to a target, guided and not, and coverage of U at the stop.

`poses`: how many poses each way of choosing them takes until U of every bias and scale factor is
what the D-optimal design of N poses has, U = k(n − 9) u by the information of the directions alone,
so that the luck of one session's noise stays out. Guided poses miss the asked direction by up to
10°. `stop`: sessions with noise, a sensor of their own each, that end by the rule of capture, or at
the first fit that claims the target; the share of parameters whose U holds the truth.
"""

import argparse
import math
import warnings
from collections.abc import Callable, Iterator

import numpy as np

import multipos as mp
from multipos.capturing.evaluation import FEWEST_DOF
from multipos.capturing.next_pose import best_pose
from multipos.designs.information import make_setting
from multipos.designs.prospects import information_of
from multipos.numerics.quantiles import coverage_factor
from multipos.sensor.model import build_model

MODEL = build_model("linear", ("ax", "ay", "az"), ("x", "y", "z")).with_gauge("lower")
SETTING = make_setting(
    build_model("linear", ("ax", "ay", "az"), ("x", "y", "z")), unknown_orientation=True
)
WANTED = [i for i, name in enumerate(MODEL.names) if name.startswith(("bias", "scale"))]
MISS_DEG = 10.0
MOST = 60
ZERO_NORM, SCATTER = 5e-5, 2e-4  # [g]: what a rest claims, and what it really is


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.coverage_capture")
    parser.add_argument("what", choices=["poses", "stop"])
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--target", type=float, default=3e-4, help="U at the stop [g, g/g]")
    chosen = parser.parse_args()
    rng = np.random.default_rng(chosen.seed)
    if chosen.what == "stop":
        stop(chosen.runs, rng, chosen.target)
    else:
        poses(chosen.runs, rng)


def poses(runs: int, rng: np.random.Generator) -> None:
    print("| optimum | way | median | 95 % | within 2 or 15 % | fewer than random |")
    print("|---|---|---|---|---|---|")
    for count in (12, 15, 18):
        best = mp.design("linear", count, unknown_orientation=True, seed=1).positions
        limit = expanded(np.asarray(best))
        targets = dict(zip([MODEL.names[i] for i in WANTED], limit.tolist(), strict=True))
        worst = {name: max(limit.tolist()) for name in targets}
        goal = np.full(len(WANTED), max(limit.tolist()))
        found = {
            name: np.array([reach(way(rng, worst), goal) for _ in range(runs)])
            for name, way in WAYS.items()
        }
        near = max(count + 2, math.floor(1.15 * count))
        for name, n in found.items():
            fewer = 1.0 - np.median(n) / np.median(found["random"])
            late = f"> {MOST}" if np.median(n) > MOST else f"{np.median(n):.0f}"
            print(
                f"| {count} | {name} | {late} | {np.quantile(n, 0.95):.0f} | "
                f"{100 * np.mean(n <= near):.0f} % | {100 * fewer:.0f} % |",
                flush=True,
            )


def expanded(up: np.ndarray) -> np.ndarray:
    """U of the wanted parameters for unit noise; infinite where the poses do not tell them."""
    information = information_of(SETTING, up).sum(axis=0)
    if len(up) <= len(information) or np.linalg.cond(information) > 1e10:
        return np.full(len(WANTED), np.inf)
    u = np.sqrt(np.diag(np.linalg.inv(information)))
    return coverage_factor(0.95, len(up) - len(u)) * u[WANTED]


def reach(directions: Iterator[np.ndarray], goal: np.ndarray) -> int:
    taken: list[np.ndarray] = []
    for up in directions:
        taken.append(up)
        if len(taken) > MOST or (expanded(np.array(taken)) <= goal * (1 + 1e-9)).all():
            break
    return len(taken)


def missed(up: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A direction within `MISS_DEG` of one, evenly over that cap."""
    away = np.arccos(1.0 - rng.uniform() * (1.0 - math.cos(math.radians(MISS_DEG))))
    side = np.cross(up, rng.standard_normal(3))
    return math.cos(away) * up + math.sin(away) * side / np.linalg.norm(side)


def guided(rng: np.random.Generator, targets: dict[str, float]) -> Iterator[np.ndarray]:
    taken = np.empty((0, 3))
    while True:
        asked = best_pose(MODEL, None, taken, targets)
        if asked is None:
            return
        up = missed(asked.direction, rng)
        taken = np.concatenate([taken, up[None]])
        yield up


def random(rng: np.random.Generator, _: dict[str, float]) -> Iterator[np.ndarray]:
    while True:
        up = rng.standard_normal(3)
        yield up / np.linalg.norm(up)


def faces(rng: np.random.Generator, _: dict[str, float]) -> Iterator[np.ndarray]:
    while True:
        yield from (missed(up, rng) for up in mp.read_scheme("faces-6").up)


def figure_eight(rng: np.random.Generator, _: dict[str, float]) -> Iterator[np.ndarray]:
    """Held still along the figure that wizards ask for: rolls of 90°, pitches of 45°."""
    while True:
        t = rng.uniform(0.0, 2.0 * math.pi)
        roll, pitch = math.radians(90.0) * math.sin(t), math.radians(45.0) * math.sin(2.0 * t)
        up = [math.sin(pitch), math.sin(roll) * math.cos(pitch), math.cos(roll) * math.cos(pitch)]
        yield missed(np.array(up), rng)


WAYS: dict[str, Callable[[np.random.Generator, dict[str, float]], Iterator[np.ndarray]]] = {
    "guided": guided,
    "random": random,
    "six faces": faces,
    "figure-eight": figure_eight,
}


def stop(runs: int, rng: np.random.Generator, target: float) -> None:
    held: dict[str, list[np.ndarray]] = {"capture": [], "first claim": []}
    counts: dict[str, list[int]] = {name: [] for name in held}
    for _ in range(runs):
        for name, (covered, n) in session(rng, target).items():
            held[name].append(covered)
            counts[name].append(n)
    print("| stop | poses, median | coverage, mean % | worst % |\n|---|---|---|---|")
    for name, each in held.items():
        share = 100.0 * np.mean(each, axis=0)
        print(
            f"| {name} | {np.median(counts[name]):.0f} | {share.mean():.1f} | {share.min():.1f} |"
        )


def session(rng: np.random.Generator, target: float) -> dict[str, tuple[np.ndarray, int]]:
    """One session, and where each rule ends it: which parameters U holds, and after how many."""
    bias = 0.03 * rng.standard_normal(3)
    matrix = np.eye(3) + np.tril(0.01 * rng.standard_normal((3, 3)))
    truth = np.concatenate([[bias[i], *matrix[i, : i + 1]] for i in range(3)])
    up = np.empty((0, 3))
    values = np.empty((0, 3))
    small = 0
    ended: dict[str, tuple[np.ndarray, int]] = {}
    targets = {name: target for name in MODEL.names if name.startswith(("bias", "scale"))}
    while len(ended) < 2:
        asked = best_pose(MODEL, None, up, targets)
        new = random(rng, {}).__next__() if asked is None else missed(asked.direction, rng)
        up = np.concatenate([up, new[None]])
        reading = bias + matrix @ new + SCATTER * rng.standard_normal(3)
        values = np.concatenate([values, reading[None]])
        if len(up) < 11:
            continue
        readings = mp.Readings(values, outputs=MODEL.outputs, u=np.full_like(values, ZERO_NORM))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            cal = mp.fit(readings)
        U = np.array([entry.U for entry in cal.entries])
        covered = np.abs(cal.parameters - truth) <= U
        stated_noise = bool((U[WANTED] <= target).all())
        small = small + 1 if stated_noise and len(up) - 9 >= FEWEST_DOF else 0
        if stated_noise and "first claim" not in ended:
            ended["first claim"] = covered, len(up)
        if small == 2:
            ended["capture"] = covered, len(up)
    return ended


if __name__ == "__main__":
    main()
