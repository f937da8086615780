"""Switch-ons: a constant that is not the same in every run, and what the next run may have.

`within_runs` takes from columns and response what differs between runs, `runs_lost` counts the
degrees of freedom that this costs. `find_between` returns the scatter between runs, `add_between`
puts it into the covariance of a segment.

A sensor comes back from each switch-on with another zero. With a run of its own for each,

    y_ij = a_i + x_ij' b + e_ij,        a_i = a + o_i,                                      (1)

run i, row j: the slopes b come from what changes within the runs alone, which is least squares of
columns and response less their means over the run, and the constant is the mean of the m zeros,
every run counting once. The zeros scatter by

    s² = Σ o_i²/(m − 1),        u²(a) = s²/m + x̄' C_b x̄.                                   (2)

A slope of the variable v (that of the segments, else the first) may differ from run to run as well:
o_i + c_i (v − v̄). It is identifiable where the scatter of the c_i is beyond what the noise within
the runs gives them (F at 95 % on m − 1), and v itself is a term. Ψ is the covariance of o_i and
c_i. A prediction for a run that nobody has seen, at terms x, with z = (1, v − v̄),

    u² = x' C x + z' Ψ z + rms²,        U² = t²(m − 1) (1 + 1/m) z' Ψ z + t²(ν) · the rest,      (3)

expanded part by part: with three runs the scatter of the zeros has two degrees of freedom, and one
effective number for both parts covers down to 92 % at a stated 95 %, eq. (3) never less than 95 %.

Sources: JCGM 100, 4.2 and 5.1; F. A. Graybill, C.-M. Wang, J. Am. Stat. Assoc. 75, 1980 (limits
for a sum of variances, part by part).
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from multipos.errors import MultiposError
from multipos.numerics.arrays import Array
from multipos.numerics.quantiles import f_quantile
from multipos.numerics.terms import linear_term
from multipos.regression.observations import Data
from multipos.regression.segment import Between, Segment


def runs_lost(data: Data) -> int:
    """Return how many degrees of freedom the zeros of the runs take beside the constant."""
    return 0 if data.run is None else len(np.unique(data.run)) - 1


def within_runs(design: Array, data: Data, where: str = "") -> tuple[Array, Data]:
    """Return columns and response less what differs between runs; as they are without runs.

    Their means over a run become the mean of these means, so that the constant is that of eq. (1).

    Raises
    ------
    MultiposError
        There is one run only.
    """
    if data.run is None:
        return design, data
    labels, run, count = np.unique(data.run, return_inverse=True, return_counts=True)
    if len(labels) < 2:
        raise MultiposError(
            f"{where or 'the table'} has rows of one run only, which cannot show what runs differ "
            "by; move the edge, give more runs, or leave out --run."
        )
    both = np.column_stack([design, data.response])
    means = np.stack([np.bincount(run, column) / count for column in both.T], axis=1)
    adjusted = both - means[run] + means.mean(axis=0)
    return adjusted[:, :-1], replace(data, response=adjusted[:, -1])


def find_between(
    original: Array,
    data: Data,
    terms: Sequence[object],
    values: Array,
    variable: str,
    n_effective: float,
) -> Between:
    """Return the scatter between runs, eq. (2).

    Parameters
    ----------
    original : (n, q) array
        The columns of the terms, with what differs between runs still in them.
    data : Data
        The rows, with the response as it was read.
    terms, values
        What was fitted: of joined segments some columns are no terms.
    variable : str
        Whose slope may differ.
    n_effective : float
        The effective number of rows.
    """
    assert data.run is not None  # which is what there is to tell about
    v = data.columns[variable]
    centre = float(v.mean())
    left = data.response - original @ values
    offsets, slopes, noise = [], [], []
    for label in np.unique(data.run):
        mine = data.run == label
        x, e = v[mine] - v[mine].mean(), left[mine]
        spread = float(x @ x)
        slope = float(x @ e) / spread if spread > 0.0 else 0.0
        offsets.append(float(e.mean()) + slope * (centre - float(v[mine].mean())))
        slopes.append(slope)
        rest = e - e.mean()
        variance = float(rest @ rest) / max(len(e) - 2, 1) * len(left) / n_effective
        noise.append(variance / spread if spread > 0.0 else np.inf)
    m = len(slopes)
    varies = linear_term(variable) in terms
    varies &= np.var(slopes, ddof=1) > np.mean(noise) * f_quantile(0.95, m - 1, n_effective)
    if varies:
        return Between(m, variable, centre, np.cov(offsets, slopes))
    means = [float(left[data.run == label].mean()) for label in np.unique(data.run)]
    return Between(m, None, centre, np.array([[np.var(means, ddof=1)]]))


def add_between(segment: Segment, between: Between) -> Segment:
    """Return a segment whose coefficients are uncertain by what differs between runs as well."""
    added = between.of_coefficients(segment.terms)
    robust = segment.robust
    if robust is not None:
        robust = replace(robust, covariance=robust.covariance + added)
    return replace(segment, covariance=segment.covariance + added, robust=robust, between=between)
