"""What U of compensated force covers where the model lacks a term, and what a fit says of it.

Readings come from a generator of their own: a sensor with bias, scale factors and cross terms,
normal noise of .1 mg, and a term that the fit does not know. Force is compensated at 200 new
directions and held against its U (95 %) of parameters and budget; of unknown orientations its size
is. Printed are how often it holds, the error over u, and how often each caution comes up; then the
same cautions on sets that lack nothing.
"""

import argparse
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

import multipos as mp
from multipos.numerics.quantiles import coverage_factor
from multipos.sensor.inverse import sensitivities

BIAS = np.array([0.012, -0.021, 0.034])
MATRIX = np.array([[1.012, 0.007, -0.003], [0.005, 0.99, 0.007], [-0.007, 0.004, 1.003]])
NOISE = 1e-4
SIZE = 2e-3
CAUTIONS = ("missing-term", "hidden-terms", "denied-noise", "placement", "unequal-noise")
UNSEEN = {"own^2": SIZE, "own^3": SIZE, "own*|own|": SIZE, "own*other": SIZE}
TABLES = str.maketrans({"|": "\\|"})  # a bar in a cell
Row = tuple[str, float, str, str, dict[str, Any]]


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.model_error", description=__doc__)
    parser.add_argument("--runs", type=int, default=60)
    parser.add_argument(
        "--good", type=int, default=400, help="sets that lack nothing, of each kind"
    )
    parser.add_argument("--seed", type=int, default=1)
    chosen = parser.parse_args()
    rng = np.random.default_rng(chosen.seed)
    print("| truth beyond the fit | fit, positions | covered % | error / u |", end=" ")
    print(" | ".join(CAUTIONS), "|\n|---|---|---|---|---|---|---|---|---|")
    for name, size, scheme, said, options in rows():
        runs = chosen.runs if "400" not in scheme else max(chosen.runs // 5, 1)
        made = [one(name, size, scheme, options, rng) for _ in range(runs)]
        held, ratio, found = zip(*made, strict=True)
        error = np.sqrt(np.mean(np.square(ratio)))
        print(f"| {name.translate(TABLES)} {1e3 * size:g} mg |", end=" ")
        print(f"{said.translate(TABLES)}, {scheme} | {100 * np.mean(held):.1f} |", end=" ")
        print(f"{error:.1f} | {shares(found)}", flush=True)
    print_good(chosen.good, rng)


def print_good(runs: int, rng: np.random.Generator) -> None:
    """Print how often each caution comes up where nothing is lacking; those that never do, not."""
    said: dict[str, list[set[str]]] = {}
    for scheme, how, options in good_sets():
        name = f"{scheme} | {how}"
        said[name] = [fitted("nothing", 0.0, scheme, options, rng)[1] for _ in range(runs)]
    codes = sorted({code for sets in said.values() for each in sets for code in each})
    print("\n| good sets | fit |", " | ".join(codes), "|\n" + "|---" * (2 + len(codes)) + "|")
    for name, found in said.items():
        print(f"| {name} |", shares(found, codes), flush=True)


def rows() -> Iterator[Row]:
    """Yield the term that is missing, its size [g], the scheme, the fit in words, its options."""
    sets = "faces-6", "icosahedron-12", "fibonacci-24", "fibonacci-400"
    for scheme in (sets[0], *sets[2:]):
        yield "nothing", 0.0, scheme, "linear", {}
    for name in ("own^3", "own*other", "own*|own|"):
        yield name, SIZE, sets[0], "linear", {}
        yield name, SIZE, sets[0], "linear, [unseen]", {"budget": {"unseen": UNSEEN}}
    yield "own^3", SIZE, sets[0], "own-quadratic", {"model": "own-quadratic"}
    budget = {"budget": {"unseen": UNSEEN}}
    yield "own^3", SIZE, sets[0], "own-quadratic, [unseen]", {"model": "own-quadratic", **budget}
    for name in ("own^3", "own*other"):
        yield name, SIZE, "faces-6+faces-6+faces-6", "linear", {}
        yield name, SIZE, "faces-6+faces-6+faces-6", "linear, [unseen]", budget
    for name in ("own^3", "own*other"):
        yield name, SIZE, sets[1], "linear", {}
    yield "own^3", SIZE, "faces-corners-14", "linear", {}
    for name in ("own^3", "own*other", "own^2"):
        yield name, SIZE, sets[2], "linear", {}
    yield "own^3", SIZE, "fibonacci-100", "linear", {}
    yield "own^3", SIZE, sets[3], "linear", {}
    yield "own^3", SIZE, sets[2], "u stated", {"reading_sd": NOISE}
    yield "own^3", SIZE / 4.0, sets[2], "u stated", {"reading_sd": NOISE}
    yield "own*other", SIZE, sets[2], "orientation sd auto", {"orientation_sd": "auto"}
    yield "own^2", SIZE, sets[2], "orientation sd .1°", {"orientation_sd": 0.1}
    for name in ("own^2", "own^3", "own*other"):
        yield name, SIZE, sets[2], "unknown", {"unknown_orientation": True}
    for name in ("own^3", "own*other"):
        drawn = {"budget": {"unseen": {name: SIZE}}}
        yield f"{name} drawn", SIZE, sets[0], f"linear, [unseen] {name} alone", drawn


def good_sets() -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Yield scheme, fit in words and options of sets that lack nothing."""
    for scheme in ("faces-6", "icosahedron-12", "fibonacci-24"):
        yield scheme, "linear", {}
        yield scheme, "u stated", {"reading_sd": NOISE}
    for scheme in ("icosahedron-12", "fibonacci-24"):
        yield scheme, "robust", {"robust": "huber"}
    yield "fibonacci-24", "orientation sd .1°", {"orientation_sd": 0.1, "reading_sd": NOISE}
    yield "fibonacci-24", "orientation sd auto", {"orientation_sd": "auto"}
    yield "fibonacci-24", "unknown", {"unknown_orientation": True}


def one(
    name: str, size: float, scheme: str, options: dict[str, Any], rng: np.random.Generator
) -> tuple[float, float, set[str]]:
    """Return the share of new directions that U holds, the error over u, and the cautions."""
    cal, codes, terms = fitted(name, size, scheme, options, rng)
    up = rng.standard_normal((200, 3))
    up /= np.linalg.norm(up, axis=1)[:, None]
    raw = sense(up, name, size, terms)
    if "unknown_orientation" in options:
        force = cal.compensate(raw)
        inverse, slopes = sensitivities(cal.model, cal.parameters, force, {})
        moved = inverse @ slopes
        covariance = moved @ cal.covariance @ moved.transpose(0, 2, 1)
        error = np.linalg.norm(force, axis=1) - 1.0
        u = np.sqrt(np.einsum("ni,nij,nj->n", force, covariance, force))
        U = coverage_factor(0.95, float(cal.dof[0])) * u
    else:
        columns = dict(zip(cal.outputs, raw.T, strict=True))
        told = mp.apply(cal, columns, uncertainty=True, parameters_only=True)
        error, u, U = (
            np.column_stack([told[f"{kind}_{axis}"] for axis in "xyz"])
            for kind in ("f", "u_f", "U_f")
        )
        error = error - up
    ratio = np.sqrt(np.mean(error**2) / np.mean(u**2))
    return float(np.mean(np.abs(error) <= U)), float(ratio), codes


def fitted(
    name: str, size: float, scheme: str, options: dict[str, Any], rng: np.random.Generator
) -> tuple[mp.Calibration, set[str], np.ndarray]:
    """Return a calibration, the codes of its cautions, and how large the term was."""
    up = mp.read_scheme(scheme).up
    drawn = rng.standard_normal(3) if name.endswith("drawn") else np.ones(3)
    stood = up
    if options.get("orientation_sd") == 0.1:
        stood = up + np.cross(np.radians(0.1) * rng.standard_normal(up.shape), up)
        stood /= np.linalg.norm(stood, axis=1)[:, None]
    values = sense(stood, name, size, drawn) + NOISE * rng.standard_normal(up.shape)
    readings = mp.Readings(values, outputs=("ax", "ay", "az"), up=up, unit="g")
    if "unknown_orientation" not in options:
        options = {"orientation_sd": 0} | options
    cal = mp.fit(readings, exclude="none", **options)
    return cal, {finding.code for finding in cal.diagnostics.findings}, drawn


def sense(force: np.ndarray, name: str, size: float, drawn: np.ndarray) -> np.ndarray:
    terms = {
        "nothing": 0.0 * force,
        "own^2": force**2,
        "own^3": force**3,
        "own*|own|": force * np.abs(force),
        "own*other": force * np.roll(force, -1, axis=1),
    }
    return np.asarray(BIAS + force @ MATRIX.T + size * drawn * terms[name.removesuffix(" drawn")])


def shares(found: Any, codes: Sequence[str] = CAUTIONS) -> str:
    counts = Counter(code for each in found for code in each)
    return " | ".join(f"{100 * counts[code] / len(found):.1f}" for code in codes) + " |"


if __name__ == "__main__":
    import warnings

    warnings.simplefilter("ignore", mp.CalibrationWarning)
    main()
