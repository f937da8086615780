"""Apply a calibration to a table: every column kept, force added.

`apply` does so at once for a table in memory (`multipos.compensation.added_columns`); what it
returns is an `Applied`, a table with the noise of one reading in words and what was found.
"""

from collections.abc import Mapping
from copy import copy
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from multipos.compensation.added_columns import (
    Outside,
    add_columns,
    check_beside,
    check_columns,
    check_outside,
    find_turn,
    found_applying,
    place_outside,
    refusal,
    wanted_columns,
)
from multipos.compensation.applying_logs import apply_log
from multipos.compensation.reading_noise import asked_uncertainty
from multipos.files import handed, tables
from multipos.finding import Findings, in_order
from multipos.logs.opening import open_log
from multipos.positions.headers import plain_names, under_names
from multipos.results import Columns
from multipos.sensor.calibration import Calibration


class AppliedColumns(Columns):
    """A table with what was made of it beside its columns.

    `noise` says which noise of one reading the uncertainties hold, None where there are none, and
    `findings` what was found about them.
    """

    noise: str | None
    findings: Findings

    def __init__(
        self,
        content: Mapping[str, Any],
        noise: str | None = None,
        findings: Findings = (),
    ) -> None:
        super().__init__(content)
        object.__setattr__(self, "noise", noise)
        object.__setattr__(self, "findings", findings)

    def __reduce__(self) -> tuple[type, tuple[Any, ...]]:
        return type(self), (dict(self), self.noise, self.findings)

    def to_dict(self) -> dict[str, Any]:
        """Return ``{"rows": n, "columns": {name: […]}}`` as what JSON can carry.

        With uncertainties ``"noise"`` stands between them.
        """
        said = {} if self.noise is None else {"noise": self.noise}
        findings = [each.to_dict() for each in self.findings]
        return {
            "rows": len(self["outside"]),
            **said,
            "findings": findings,
            **super().to_dict(),
        }


class Applied(AppliedColumns):
    """A table with the compensated force beside its columns.

    Force is in g, NaN where no force explains the reading.
    """


def apply(
    calibration: Calibration,
    data: tables.Source,
    *,
    tilt: bool = False,
    uncertainty: bool = False,
    reading_sd: ArrayLike | None = None,
    parameters_only: bool = False,
    outside: Outside = "flag",
    beside: Calibration | None = None,
) -> Applied:
    """Return the columns of a table with the compensated force beside them.

    Parameters
    ----------
    calibration : Calibration
    data : path, open file, mapping of columns, data frame, or (n, M) array of the outputs
        Of a table, or of a log of any kind that `average` reads. Must have the calibration's
        outputs, and the columns its model uses.
    tilt : bool
        Add ``tilt_x_deg`` …, the angle of each axis above the horizon, for a sensor at rest.
    uncertainty : bool
        Add ``u_f_x`` …, ``U_f_x`` … [g], and with tilt ``u_tilt_x_deg``, ``U_tilt_x_deg`` …: of
        parameters, budget and the noise of one reading together. That noise is ``u_<output>`` of
        the table, else `reading_sd`, else that of an averaged reading of the calibration.
    reading_sd : float or (M,) array, optional
        Standard uncertainty of a reading of the table.
    parameters_only : bool
        Leave the noise of the reading out.
    outside : str
        'flag' rows beyond what was calibrated, 'clamp' the model's other columns (such as
        temperature) to the calibrated range as well, or 'refuse' the table.
    beside : Calibration, optional
        Of the accelerometer beside a magnetometer, whose outputs the table has as well: add
        ``heading_deg``, of case axis x from magnetic north, at rest.

    Returns
    -------
    Applied

    Raises
    ------
    MultiposError
        A column is missing or has a bad cell, or a row is outside under 'refuse'.
    TypeError
        `calibration` is something else: for a regression `multipos.correct` does this.

    Examples
    --------
    >>> import multipos as mp
    >>> cal = mp.demo().calibration
    >>> log = {"ax": [0.5], "ay": [0.0], "az": [-0.86]}
    >>> found = mp.apply(cal, log, tilt=True, uncertainty=True)
    >>> list(found)[3:6]
    ['f_x', 'f_y', 'f_z']
    >>> print(f"{found.tilt_x_deg[0]:.1f} degrees, U of f_x {found.U_f_x[0]:.3f} g")
    -30.7 degrees, U of f_x 0.017 g
    """
    if not isinstance(calibration, Calibration):
        raise TypeError(
            f"needs a Calibration, got {type(calibration).__name__}; for a regression call "
            "`multipos.correct`, and `multipos.load` reads a calibration from its file."
        )
    check_outside(outside)
    check_beside(calibration, beside, tilt)
    data = handed.take_in(data, "data", calibration.outputs)
    if not isinstance(data, Mapping):  # a log of any kind that the command reads
        whole = apply_log(
            calibration,
            open_log(data),
            tilt=tilt,
            uncertainty=uncertainty,
            reading_sd=reading_sd,
            parameters_only=parameters_only,
            outside=outside,
            beside=beside,
        )
        columns = whole.columns()
        return Applied(columns, whole.noise, in_order((*whole.log.left_out, *whole.findings)))
    given = tables.read_table(data, what="data")
    table, units = plain_names(given)
    asked = wanted_columns(calibration)
    table, _ = under_names(table, asked if beside is None else (*asked, *wanted_columns(beside)))
    wanted = asked_uncertainty(
        calibration, table.source, table.columns, uncertainty, reading_sd, parameters_only
    )
    check_columns(calibration, table.source, table.columns, tilt, wanted, units, beside)
    added = add_columns(
        calibration, table, tilt=tilt, uncertainty=wanted, outside=outside, beside=beside
    )
    if outside == "refuse" and added["outside"].any():
        where = place_outside(calibration, table, int(np.argmax(added["outside"])))
        raise refusal(where, int(added["outside"].sum()), table.rows)
    kept = {name: copy(column) for name, column in given.columns.items()}  # the caller's own stay
    said: Findings = ()
    if wanted is not None:
        said = (*wanted.held, *wanted.find_samples(table, table.columns))
    said = (*said, *find_turn(calibration, beside))
    findings = found_applying(calibration, said, int(added["outside"].sum()), table.rows)
    noise = None if wanted is None else wanted.noise.text
    return Applied({**kept, **added}, noise, findings)
