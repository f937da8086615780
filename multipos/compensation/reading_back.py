"""Read an exported file back as its consumer would, and show what is left of the readings."""

import os

from multipos.compensation.target import GivenFile, Verification
from multipos.compensation.targets import recognised_target
from multipos.errors import MultiposError
from multipos.files.whole import read_bytes
from multipos.sensor.calibration import Calibration

_LONGEST = 10 << 20  # [byte], far above any file that export writes


def verify_export(
    path: str | os.PathLike[str], calibration: Calibration, *, run_foreign_code: bool = False
) -> Verification:
    """Apply an exported file to the readings of a calibration, by the consumer's own law.

    Parameters
    ----------
    path : path
    calibration : Calibration
    run_foreign_code : bool
        Compile and run C that is not what `export` writes of this calibration.

    Raises
    ------
    MultiposError
        The file is of no known kind, does not come from this calibration, or is C and there is
        no compiler.
    """
    raw = read_bytes(path, "export")
    where = str(path)
    if len(raw) > _LONGEST:
        raise MultiposError(
            f"{where}: {len(raw)} bytes are more than any file of multipos export has."
        )
    text = raw.decode("utf-8", errors="replace")
    target = recognised_target(text)
    if target is None:
        raise MultiposError(
            f"{path}: neither C nor parameters that export writes; give a file of multipos export."
        )
    return target.read_back(GivenFile(where, raw, text, run_foreign_code), calibration)
