"""Apply a calibration to a table: every column kept, force added.

`apply` does so at once for a table in memory (`multipos.compensation.added_columns`); what it
returns is an `Applied`, a table with the noise of one reading in words and what was found.
"""

from collections.abc import Mapping
from copy import copy
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from multipos.compensation.added_columns import Outside, prepare, refusal, wanted_columns
from multipos.compensation.applying_logs import apply_log
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
    options: dict[str, Any] = {
        "tilt": tilt,
        "uncertainty": uncertainty,
        "reading_sd": reading_sd,
        "parameters_only": parameters_only,
        "outside": outside,
        "beside": beside,
    }
    data = handed.take_in(data, "data", calibration.outputs)
    if not isinstance(data, Mapping):  # a log of any kind that the command reads
        whole = apply_log(calibration, open_log(data), **options)
        columns = whole.columns()
        return Applied(columns, whole.noise, in_order((*whole.log.left_out, *whole.findings)))
    given = tables.read_table(data, what="data")
    table, units = plain_names(given)
    table, _ = under_names(table, wanted_columns(calibration, beside))
    asked = prepare(calibration, table.source, table.columns, units, **options)
    added = asked.columns(table)
    beyond = int(added["outside"].sum())
    if outside == "refuse" and beyond:
        where = asked.place(table, int(np.argmax(added["outside"])))
        raise refusal(where, beyond, table.rows)
    kept = {name: copy(column) for name, column in given.columns.items()}  # the caller's own stay
    findings = asked.findings(asked.samples(table, table.columns), beyond, table.rows)
    return Applied({**kept, **added}, asked.noise, findings)
