"""Apply a calibration to a table of raw readings: every column kept, force added.

What is added stands in `multipos.compensation.added_columns`. A table in memory is done at once, a
file as a log (`multipos.compensation.applied_logs`).
"""

import os
from collections.abc import Mapping
from copy import copy
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from multipos.compensation.added_columns import (
    Outside,
    add_columns,
    check_columns,
    check_outside,
    refusal,
)
from multipos.compensation.applied_logs import apply_log
from multipos.compensation.reading_noise import asked_uncertainty
from multipos.doubts.model_error import said_of_hidden
from multipos.files.tables import Source, read_table
from multipos.logs.opening import open_log
from multipos.positions.headers import plain_names
from multipos.results import Columns
from multipos.sensor.calibration import Calibration


class AppliedColumns(Columns):
    """A table with what was made of it beside its columns.

    `noise` says which noise of one reading the uncertainties hold, None where there are none, and
    `warnings` what there is to say of them.
    """

    noise: str | None
    warnings: tuple[str, ...]

    def __init__(
        self,
        content: Mapping[str, Any],
        noise: str | None = None,
        warnings: tuple[str, ...] = (),
    ) -> None:
        super().__init__(content)
        object.__setattr__(self, "noise", noise)
        object.__setattr__(self, "warnings", warnings)

    def __reduce__(self) -> tuple[type, tuple[Any, ...]]:
        return type(self), (dict(self), self.noise, self.warnings)

    def to_dict(self) -> dict[str, Any]:
        """Return ``{"rows": n, "columns": {name: […]}}`` as what JSON can carry.

        With uncertainties ``"noise"`` stands between them.
        """
        said = {} if self.noise is None else {"noise": self.noise}
        return {"rows": len(self["outside"]), **said, **super().to_dict()}


class Applied(AppliedColumns):
    """A table with the compensated force beside its columns.

    Force is in g, NaN where no force explains the reading.
    """


def apply(
    calibration: Calibration,
    data: Source,
    *,
    tilt: bool = False,
    uncertainty: bool = False,
    reading_sd: ArrayLike | None = None,
    parameters_only: bool = False,
    outside: Outside = "flag",
) -> Applied:
    """Return the columns of a table with the compensated force beside them.

    Parameters
    ----------
    calibration : Calibration
    data : path, mapping of columns, or data frame
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
    if isinstance(data, str | os.PathLike):  # a log of any kind that the command reads
        whole = apply_log(
            calibration,
            open_log(data),
            tilt=tilt,
            uncertainty=uncertainty,
            reading_sd=reading_sd,
            parameters_only=parameters_only,
            outside=outside,
        )
        columns = whole.columns()
        return Applied(columns, whole.noise, (*whole.log.left_out, *whole.warnings))
    given = read_table(data, what="data")
    table, units = plain_names(given)
    wanted = asked_uncertainty(
        calibration, table.source, table.columns, uncertainty, reading_sd, parameters_only
    )
    check_columns(calibration, table.source, table.columns, tilt, wanted, units)
    added = add_columns(calibration, table, tilt=tilt, uncertainty=wanted, outside=outside)
    if outside == "refuse" and added["outside"].any():
        where = table.where(int(np.argmax(added["outside"])), calibration.outputs[0])
        raise refusal(where, int(added["outside"].sum()), table.rows)
    kept = {name: copy(column) for name, column in given.columns.items()}  # the caller's own stay
    said = said_of_hidden(calibration)
    if wanted is None:
        return Applied({**kept, **added}, warnings=said)
    said += (*wanted.said, *wanted.cautions(table, table.columns))
    return Applied({**kept, **added}, wanted.noise.text, said)
