"""One step of an exported regression in C, against C written by hand for the same regression.

The peer is what an engineer writes: coefficients and limits in tables, the same low passes for the
rate, Horner's rule, the same limits, the same leverage beyond which a row is told to be none of
those that were fitted, by a triangle of products, and return codes. Both are compiled with -O2, by
gcc and by clang where these are installed, and make two million steps in a process of their own;
the steps end at the same sum, of codes too.
"""

import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np

import multipos as mp
from benchmarks.timing import Ratio, paired_process_ratio, time_of_children
from multipos.regression.regression import Regression

TERMS = "1 + T + V + T^2 + T*V + T_rate + T*T_rate"
COLUMNS = ("1", "T", "V", "T^2", "T*V", "T_rate", "T*T_rate")
GOAL = 1.1
COMPILERS = ("gcc", "clang")

DRIVER = """\
#include <stdio.h>
#include <math.h>
#include "declared.h"
int main(void)
{
    static double T[4096], V[4096];
    multipos_state state;
    double sum = 0.0, in[2], out[1];
    for (int i = 0; i < 4096; ++i) {
        T[i] = 20.0 + 29.0 * sin(i * 0.01);
        V[i] = 5.0 + 0.1 * sin(i * 0.03);
    }
    multipos_start(&state);
    for (int i = 0; i < 2000000; ++i) {
        in[0] = T[i & 4095];
        in[1] = V[i & 4095];
        sum += multipos_correct(&state, i, in, out);
        sum += out[0];
    }
    printf("%.9g\\n", sum);
    return 0;
}
"""

PEER = """\
#include "declared.h"
static const double edge[2] = EDGES;
static const double limit[3][3][2] = LIMITS;
static const double c[3][7] = COEFFICIENTS;
static const double factor[3][7][7] = FACTORS;

void multipos_start(multipos_state *s) { *s = (multipos_state){0}; }

static double held(double v, const double ends[2], int *beyond)
{
    if (!(v >= ends[0])) { *beyond = 1; return ends[0]; }
    if (v > ends[1]) { *beyond = 1; return ends[1]; }
    return v;
}

int multipos_correct(multipos_state *s, double time, const double in[2], double out[1])
{
    int beyond = 0;
    if (!(time > -1e40 && time < 1e40) || !(in[0] > -1e40 && in[0] < 1e40)) return 2;
    if (s->started) {
        if (!(time > s->time)) return 2;
        const double dt = time - s->time, share = 1.0 / (WINDOW + dt);
        const double whole = s->behind[0] + in[0] - s->last[0];
        const double taken = whole * dt * share;
        s->behind[0] = whole - taken;
        s->rate[0] += (taken - s->rate[0] * dt) * share;
    }
    s->last[0] = in[0];
    s->time = time;
    s->started = 1;
    const int k = in[0] < edge[0] ? 0 : in[0] < edge[1] ? 1 : 2;
    const double T = held(in[0], limit[k][0], &beyond);
    const double V = held(in[1], limit[k][1], &beyond);
    const double R = held(s->rate[0], limit[k][2], &beyond);
    const double *b = c[k];
    const double row[7] = {1.0, T, V, T * T, T * V, R, T * R};
    double leverage = 0.0;
    for (int i = 0; i < 7; ++i) {
        double z = 0.0;
        for (int j = 0; j <= i; ++j) z += factor[k][i][j] * row[j];
        leverage += z * z;
    }
    if (leverage > MOST) beyond = 1;
    out[0] = b[0] + b[2] * V + b[5] * R + T * (b[1] + b[3] * T + b[4] * V + b[6] * R);
    return beyond;
}
"""


def run() -> list[Ratio]:
    regression = fitted()
    text = mp.export(regression, "c").text
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        state = text[text.index("typedef struct") : text.index("void multipos_start")]
        declared = (
            f"{state}void multipos_start(multipos_state *);\n"
            "int multipos_correct(multipos_state *, double, const double[2], double[1]);\n"
        )
        (folder / "declared.h").write_text(declared, encoding="utf-8")
        (folder / "driver.c").write_text(DRIVER, encoding="utf-8")
        found = []
        for compiler in filter(shutil.which, COMPILERS):
            ours = compiled(compiler, folder, "ours", text)
            peer = compiled(compiler, folder, "peer", by_hand(regression))
            sums = [float(subprocess.check_output([program])) for program in (ours, peer)]
            if not np.isclose(*sums, rtol=1e-8):
                raise RuntimeError(f"the two do not compute the same: {sums[0]:.9g}, {sums[1]:.9g}")
            pairs = paired_process_ratio([ours], [peer], timer=time_of_children)
            what = f"regression in C, one step, {compiler}"
            found.append(Ratio(what, "the same written by hand", pairs, GOAL))
    return found


def fitted() -> Regression:
    rng = np.random.default_rng(1)
    time = np.arange(2000.0)
    T = 20.0 + 30.0 * np.sin(time / 300.0)
    error = 1e-3 * T + 1e-6 * T**2 + 0.01 * np.gradient(T) + 1e-4 * rng.standard_normal(2000)
    columns = {"time": time, "T": T, "V": 5.0 + 0.1 * np.sin(time / 77.0), "error": error}
    found = mp.regress(
        columns,
        response="error",
        variables="T,V,T_rate",
        terms=TERMS,
        causal=True,
        segment="T:0,25",
    )
    assert isinstance(found, Regression)
    return found


def by_hand(regression: Regression) -> str:
    """Return the peer with the numbers of a regression."""
    coefficients, limits, factors = [], [], []
    for segment in regression.segments:
        value = {c.term: c.value for c in segment.coefficients}
        coefficients.append([value[term] for term in COLUMNS])
        beside = [list(segment.limits[name]) for name in ("V", "T_rate")]
        limits.append([list(segment.range), *beside])
        assert segment.region is not None
        assert tuple(map(str, segment.region.terms)) == COLUMNS
        factors.append(segment.region.factor.tolist())
        most = segment.region.limit  # the same of all segments
    return (
        PEER.replace("EDGES", braces(list(regression.edges)))
        .replace("LIMITS", braces(limits))
        .replace("COEFFICIENTS", braces(coefficients))
        .replace("FACTORS", braces(factors))
        .replace("MOST", repr(most))
        .replace("WINDOW", repr(regression.rates["T_rate"] / 4.0))
    )


def braces(value: object) -> str:
    """Return nested lists of numbers as an initialiser of C."""
    if isinstance(value, list):
        return "{" + ", ".join(map(braces, value)) + "}"
    return repr(float(value))  # type: ignore[arg-type]


def compiled(compiler: str, folder: Path, name: str, text: str) -> str:
    source, program = folder / f"{name}.c", folder / name
    source.write_text(text, encoding="utf-8")
    files = [str(source), str(folder / "driver.c")]
    subprocess.run([compiler, "-std=c99", "-O2", *files, "-lm", "-o", str(program)], check=True)
    return str(program)
