"""Read an exported file back as its consumer would, and show what is left of the readings."""

import os

from multipos.errors import MultiposError, UsageError
from multipos.exports.parts import Parts, split_parts
from multipos.exports.target import GivenFile, Verification
from multipos.exports.target_correction import Replay, replay
from multipos.exports.targets import recognised_target
from multipos.files.tables import Source
from multipos.files.whole import read_bytes

_LONGEST = 10 << 20  # [byte], far above any file that export writes


def verify_export(
    path: str | os.PathLike[str],
    calibration: Parts,
    *,
    data: Source | None = None,
    run_foreign_code: bool = False,
) -> Verification | Replay:
    """Apply an exported file to the readings of a calibration, by the consumer's own law.

    The C of regressions is run on rows instead and held to what Python makes of them.

    Parameters
    ----------
    path : path
    calibration : Calibration or Regression, or a sequence of them
        What the file was exported from.
    data : path, optional
        What the regressions were fitted to; without, rows are made up over all that was fitted.
    run_foreign_code : bool
        Compile and run C that is not what `export` writes of this calibration.

    Raises
    ------
    MultiposError
        The file is of no known kind, does not come from this calibration, or is C and there is
        no compiler; or `data` are not those of the fit.
    UsageError
        `data` without a regression.

    Examples
    --------
    >>> import multipos as mp
    >>> run = mp.simulate(mp.demo().calibration, "faces-6", reading_sd=1e-4, seed=1)
    >>> cal = mp.fit(run, convention="gravity", unit="g")
    >>> mp.export(cal, to="px4", allow_lossy=True).save("px4.params")
    ('px4.params',)
    >>> found = mp.verify_export("px4.params", cal)
    >>> found.target
    'px4'
    """
    first, regressions = split_parts(calibration)
    if data is not None and not regressions:
        raise UsageError("--data are rows of a regression; a calibration holds its own readings.")
    raw = read_bytes(path, "export")
    where = str(path)
    if len(raw) > _LONGEST:
        raise MultiposError(
            f"{where}: {len(raw)} bytes are more than any file of multipos export has."
        )
    text = raw.decode("utf-8", errors="replace")
    given = GivenFile(where, raw, text, run_foreign_code)
    if regressions:
        return replay(given, first, regressions, data)
    target = recognised_target(text)
    if target is None:
        raise MultiposError(
            f"{path}: neither C nor parameters that export writes; give a file of multipos export."
        )
    assert first is not None  # or there would be regressions
    return target.read_back(given, first)
