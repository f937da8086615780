"""Uncertainty of the force of one reading: parameters, budget and the reading's own noise together.

With the covariance C of the parameters, what unseen terms add (`multipos.uncertainty.unseen_terms`)
and the noise s of one reading, at the force f,

    cov f = (df/dp) C (df/dp)' + cov unseen + J⁺ diag(s²) J⁺'.                              (1)

The degrees of freedom are Welch's and Satterthwaite's over the lines of the budget. A noise that
the calibration's own readings gave stands on the same residuals as C does, so that both are one
line of it; a noise that is stated is known for certain. U = k u, k of Student's t. Over temperature
a reading has the zero of a soak of its own as well (`multipos.sensor.temperature`), a line of q
degrees of freedom.

s is, in this order: `u_<output>` of the table, what `reading_sd` states, or that of an averaged
reading of the calibration, a mean over its positions. The last is too small for rows that are
single samples: where neighbouring rows follow each other closely, as samples do and positions do
not, and yet differ by more than averaged readings would, that is said.

References
----------
JCGM 100:2008, clauses 5.1, 5.2 and G.4.1.
"""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from multipos.errors import MultiposError, UsageError
from multipos.files.spelling import quoted
from multipos.files.tables import Table
from multipos.finding import Finding, Findings
from multipos.numerics.arrays import Array, quadratic
from multipos.numerics.quantiles import coverage_by_tenths
from multipos.positions.reading_tables import nonnegative_column
from multipos.positions.readings import spread_reading_sd
from multipos.results import frozen
from multipos.sensor.calibration import Calibration
from multipos.sensor.inverse import sensitivities
from multipos.sensor.temperature import zeros_of_soaks
from multipos.sensor.tilt import reading_noise
from multipos.uncertainty.propagation import (
    Evaluation,
    evaluate_budget,
    row_dof,
    welch_satterthwaite,
)
from multipos.uncertainty.unseen_terms import unseen_covariance

_ENOUGH = 20  # rows that tell samples from positions
_NEIGHBOURS = 0.05  # [g], by which samples that follow each other differ at most, mostly
_ONE_SD = 0.6827  # of differences are smaller than one standard deviation
_NOTHING = "the calibration has no residuals to estimate the noise of a reading from; u_… are empty"
_TELLING = 2.0  # times the noise of an averaged reading is no chance


@frozen
class Noise:
    """Which noise one reading is taken to have.

    Attributes
    ----------
    text : str
        Where it comes from, in words.
    columns : tuple of M str
        Columns of the table that tell it row by row; none where `sd` does.
    sd : (M,) array
        Zero where it is left out; NaN where nothing tells it.
    own : bool
        Whether the calibration's own readings gave it.
    """

    text: str
    columns: tuple[str, ...]
    sd: Array
    own: bool = False

    def of(self, table: Table) -> Array:
        """Return the noise of every row of a table (n, M)."""
        if self.columns:
            return np.column_stack([nonnegative_column(table, name) for name in self.columns])
        return np.broadcast_to(self.sd, (table.rows, len(self.sd)))


def asked_uncertainty(
    calibration: Calibration,
    source: str,
    columns: Iterable[str],
    uncertainty: bool,
    reading_sd: ArrayLike | None,
    parameters_only: bool,
) -> "ReadingUncertainty | None":
    """Return what tells the uncertainty that is asked for, None where none is.

    Parameters
    ----------
    calibration : Calibration
    source : str
        Of the data, whose columns follow.
    columns : names
    uncertainty, reading_sd, parameters_only
        As of `multipos.apply`.

    Raises
    ------
    MultiposError
        `u_…` stands beside some outputs only.
    UsageError
        Options say nothing, or the opposite; `reading_sd` is no standard deviation.
    """
    check_noise_options(uncertainty, reading_sd, parameters_only)
    if not uncertainty:
        return None
    none = np.zeros(len(calibration.outputs))
    stated = none if reading_sd is None else spread_reading_sd(reading_sd, (1, len(none)))[0]
    if parameters_only:
        noise = Noise("none: parameters and budget only", (), none)
    elif names := _stated_columns(calibration, source, tuple(columns)):
        noise = Noise(f"{', '.join(names)} of the data", names, none)
    elif reading_sd is not None:
        noise = Noise("--reading-sd", (), stated)
    else:
        text = "that of an averaged reading of the calibration"
        noise = Noise(text, (), reading_noise(calibration), own=True)
    return ReadingUncertainty(calibration, noise, evaluate_budget(calibration))


def check_noise_options(
    uncertainty: bool, reading_sd: ArrayLike | None, parameters_only: bool
) -> None:
    """Refuse what says nothing, or the opposite."""
    if reading_sd is not None and not uncertainty:
        raise UsageError("--reading-sd goes with --uncertainty.")
    if parameters_only and not uncertainty:
        raise UsageError("--parameters-only goes with --uncertainty.")
    if reading_sd is not None and parameters_only:
        raise UsageError("--parameters-only leaves out the noise that --reading-sd states.")


def _stated_columns(
    calibration: Calibration, source: str, columns: Sequence[str]
) -> tuple[str, ...]:
    """Return the columns of a table that state the uncertainty of every output, or none."""
    names = tuple(f"u_{output}" for output in calibration.outputs)
    given = [name for name in names if name in columns]
    missing = [name for name in names if name not in columns]
    if given and missing:
        raise MultiposError(
            f"{source}: column {quoted(missing)} is missing next to {quoted(given)}; "
            "give it for every output or for none."
        )
    return names if given else ()


@frozen(eq=True)
class ReadingUncertainty:
    """What eq. (1) needs beside the force: made once, asked for every piece of a log."""

    calibration: Calibration
    noise: Noise
    budget: Evaluation

    @property
    def held(self) -> Findings:
        """Which noise it is."""
        sd = self.noise.sd
        if np.isnan(sd).any():
            action = "State it with --reading-sd, or omit it with --parameters-only."
            return (Finding("no-noise", "warning", _NOTHING, action),)
        size = ""
        if sd.any():
            pairs = zip(self.calibration.outputs, sd.tolist(), strict=True)
            unit = self.calibration.model.unit
            size = f" ({', '.join(f'{name} {each:.3g}' for name, each in pairs)} {unit})"
        text = f"u_… and U_… include the noise of one reading: {self.noise.text}{size}"
        return (Finding("reading-noise", "note", text),)

    def of_force(
        self, force: Array, environment: Mapping[str, Array], sd: Array
    ) -> tuple[Array, Array]:
        """Return u and U (n, K) [g] of compensated force, eq. (1); NaN where no force is.

        Parameters
        ----------
        force : (n, K) array [g]
        environment : mapping of str to (n,) array
        sd : (n, M) array
            Noise of the readings, `Noise.of` their table.
        """
        c, n = self.calibration, len(force)
        sound = np.asarray(np.isfinite(force).all(axis=1))
        full = np.zeros((n, 3))
        full[:, list(c.model.sensed_axes)] = np.where(sound[:, None], force, 0.0)
        inverse, by_parameter = sensitivities(c.model, c.parameters, full, environment)
        gradient = (inverse @ by_parameter).reshape(-1, len(c.parameters))
        rows = self.budget.rows
        variance: list[Array] = [quadratic(gradient, row.added) for row in rows]
        dof = [row_dof(row, gradient) for row in rows]
        own: Array = (inverse**2 * sd[:, None, :] ** 2).reshape(-1, sd.shape[1])
        scatter = [i for i, row in enumerate(rows) if row.evaluation == "A"]
        apart = len(scatter) == own.shape[1]
        if self.noise.own:
            for i in scatter:
                variance[i] = variance[i] + (own[:, i] if apart else own.sum(axis=1))
        else:
            variance.append(own.sum(axis=1))
            dof.append(np.full(len(own), np.inf))
        zeros = zeros_of_soaks(c, by_parameter, None, sd if self.noise.own else np.zeros_like(sd))
        for i, q in enumerate(zeros.dof.tolist()):
            if np.isfinite(q):
                squared = inverse[:, :, i] ** 2
                each = np.sum(zeros.columns[:, i] ** 2, axis=1)
                variance.append((squared * each[:, None]).ravel())
                dof.append(np.full(len(own), q))
                for place in scatter[i : i + 1] if apart else scatter[:1]:
                    variance[place] = variance[place] - (squared * zeros.contained[:, [i]]).ravel()
        unseen = unseen_covariance(c, force, environment)
        variance.append(np.einsum("nkk->nk", unseen).ravel())
        dof.append(np.full(len(own), np.inf))
        parts = np.sqrt(np.maximum(np.array(variance), 0.0))
        u = np.sqrt(np.sum(parts**2, axis=0)).reshape(n, -1)
        nu = welch_satterthwaite(parts, np.array(dof)).reshape(n, -1)
        u[~sound] = np.nan
        return u, coverage_by_tenths(c.confidence, nu) * u

    def find_samples(self, table: Table, columns: Iterable[str]) -> Findings:
        """Return a warning where rows look like single samples, and their noise is not stated.

        Parameters
        ----------
        table : Table
            With the outputs.
        columns : names
            All that stand in the data; `n` among them says that rows are means.
        """
        if not self.noise.own or table.rows < _ENOUGH or "n" in columns:
            return ()
        c = self.calibration
        raw = np.column_stack([table.number(name) for name in c.outputs])
        with np.errstate(all="ignore"):  # what nothing measures is refused by its row
            step = np.quantile(np.abs(np.diff(raw, axis=0)), _ONE_SD, axis=0) / np.sqrt(2.0)
        close = step < _NEIGHBOURS * np.linalg.norm(c.sensitivity, axis=1)
        if not close.all() or not (step > _TELLING * self.noise.sd).any():
            return ()
        listed = ",".join(f"{each:.2g}" for each in step.tolist())
        text = (
            f"rows look like single samples (noise {listed}), noisier than the means of the "
            "calibration; u_… and U_… are too small"
        )
        action = "State the noise of a sample with --reading-sd."
        return (Finding("single-samples", "warning", text, action),)
