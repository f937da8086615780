"""multipos calibrates accelerometers from static positions in gravity.

A scheme gives references, readings are averaged, a model is fitted, a calibration comes out
with its uncertainty, and everything else reads that calibration.

Conventions
-----------
Case axes x, y, z are right-handed; `u` is the unit vector pointing up, in case axes. Under the
convention 'specific-force' the reference of a position is +u (the axis that points up reads
+1), under 'gravity' it is −u. References are in g, angles inside are radians; degrees carry
``_deg`` in their names. Residual = reading − model.

The names below are imported when they are first used, so that the command line starts quickly.
"""

from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

_PUBLIC = {
    "Averages": "logs.averages",
    "Calibration": "sensor.calibration",
    "Check": "verification.verdicts",
    "ConvergenceError": "errors",
    "Model": "sensor.model",
    "MultiposError": "errors",
    "RankError": "errors",
    "Readings": "positions.readings",
    "Regression": "regression.result",
    "Scheme": "positions.scheme",
    "Tumble": "verification.single_axis",
    "UsageError": "errors",
    "apply": "compensation.applying",
    "average": "logs.averaging",
    "compare": "verification.comparison",
    "correct": "compensation.correction",
    "check": "verification.checks",
    "demo": "song_qin",
    "design": "designs.designing",
    "export": "compensation.targets",
    "fit": "fitting",
    "load": "sensor.calibration_file",
    "load_check": "verification.check_file",
    "load_regression": "regression.regression_file",
    "normal_gravity": "units",
    "over_temperature": "sensor.temperature",
    "read_readings": "positions.readings",
    "read_scheme": "positions.scheme",
    "regress": "regressing",
    "schemes": "designs.assessment",
    "simulate": "sensor.simulation",
    "simulate_log": "sensor.simulation",
    "state_bench": "uncertainty.turntable",
    "table_errors": "uncertainty.turntable",
    "tumble": "verification.single_axis",
    "verify_export": "compensation.reading_back",
    "worth": "designs.prospects",
}

__all__ = [
    "Averages",
    "Calibration",
    "Check",
    "ConvergenceError",
    "Model",
    "MultiposError",
    "RankError",
    "Readings",
    "Regression",
    "Scheme",
    "Tumble",
    "UsageError",
    "__version__",
    "apply",
    "average",
    "check",
    "compare",
    "correct",
    "demo",
    "design",
    "export",
    "fit",
    "load",
    "load_check",
    "load_regression",
    "normal_gravity",
    "over_temperature",
    "read_readings",
    "read_scheme",
    "regress",
    "schemes",
    "simulate",
    "simulate_log",
    "state_bench",
    "table_errors",
    "tumble",
    "verify_export",
    "worth",
]

if TYPE_CHECKING:
    from multipos.compensation.applying import apply
    from multipos.compensation.correction import correct
    from multipos.compensation.reading_back import verify_export
    from multipos.compensation.targets import export
    from multipos.designs.assessment import schemes
    from multipos.designs.designing import design
    from multipos.designs.prospects import worth
    from multipos.errors import ConvergenceError, MultiposError, RankError, UsageError
    from multipos.fitting import fit
    from multipos.logs.averages import Averages
    from multipos.logs.averaging import average
    from multipos.positions.readings import Readings, read_readings
    from multipos.positions.scheme import Scheme, read_scheme
    from multipos.regressing import regress
    from multipos.regression.regression_file import load_regression
    from multipos.regression.result import Regression
    from multipos.sensor.calibration import Calibration
    from multipos.sensor.calibration_file import load
    from multipos.sensor.model import Model
    from multipos.sensor.simulation import simulate, simulate_log
    from multipos.sensor.temperature import over_temperature
    from multipos.song_qin import demo
    from multipos.uncertainty.turntable import state_bench, table_errors
    from multipos.units import normal_gravity
    from multipos.verification.check_file import load_check
    from multipos.verification.checks import check
    from multipos.verification.comparison import compare
    from multipos.verification.single_axis import Tumble, tumble
    from multipos.verification.verdicts import Check


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module 'multipos' has no attribute '{name}'")
    from importlib import import_module

    value = getattr(import_module(f"multipos.{_PUBLIC[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
