"""The errors of a run beside its own columns: what `regress` describes by temperature and rates.

- `errors_table` returns the columns of a run with its errors.

A run whose rows say where the sensor stood gives for every row and axis the compensated force f and

    error = f − f_ref   [g],        nominal_error = (raw − bias)/scale − f_ref              (1)

of the nominal conversion; all other columns stay, time and temperatures among them.
"""

from multipos.compensation.correction import correct
from multipos.errors import MultiposError, UsageError
from multipos.files.tables import Column, Source, read_table
from multipos.regression.regression import Regression, Regressions
from multipos.results import Columns
from multipos.sensor.calibration import Calibration
from multipos.verification.verdicts import Check


def errors_table(
    calibration: Calibration | Regression | Regressions, readings: Source, found: Check
) -> Columns:
    """Return the columns of a run with its errors beside them, eq. (1).

    Parameters
    ----------
    calibration : Calibration or Regression
        What was checked; of a regression the columns are those of `correct`.
    readings : path, mapping of columns, or data frame
        The run that was checked.
    found : Check
        What `check` found of it, of force.

    Raises
    ------
    MultiposError
        A column of that name is there already.
    UsageError
        The check is of tilt.
    """
    if isinstance(calibration, Regression | Regressions):
        return correct(calibration, readings, uncertainty=True)
    if found.quantity != "force":
        raise UsageError("errors of tilt are no errors to correct; check force, without --tilt.")
    table = read_table(readings, what="run")
    added: dict[str, Column] = {}
    for name, values in (
        ("f", found.reference + found.after),
        ("error", found.after),
        ("nominal_error", found.before),
    ):
        added |= {f"{name}_{axis}": values[:, k] for k, axis in enumerate(found.axes)}
    twice = [name for name in added if name in table]
    if twice:
        raise MultiposError(
            f"{table.source}: column '{twice[0]}' is there already; rename it, check writes it."
        )
    return Columns({**table.columns, **added})
