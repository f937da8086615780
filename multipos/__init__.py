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
    "Averages": "averages",
    "Calibration": "calibration",
    "Check": "verdicts",
    "ConvergenceError": "errors",
    "Model": "model",
    "MultiposError": "errors",
    "RankError": "errors",
    "Readings": "readings",
    "Regression": "regression",
    "Scheme": "scheme",
    "Tumble": "single_axis",
    "UsageError": "errors",
    "apply": "compensation",
    "average": "averaging",
    "compare": "comparison",
    "correct": "correction",
    "check": "checks",
    "demo": "song_qin",
    "design": "designs",
    "export": "exporters",
    "fit": "fitting",
    "load": "calibration",
    "load_check": "verdicts",
    "load_regression": "regression",
    "normal_gravity": "units",
    "over_temperature": "temperature",
    "read_readings": "readings",
    "read_scheme": "scheme",
    "regress": "regressing",
    "schemes": "assessment",
    "simulate": "simulation",
    "simulate_log": "simulation",
    "state_bench": "turntable",
    "table_errors": "turntable",
    "tumble": "single_axis",
    "verify_export": "exporters",
    "worth": "prospects",
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
    from multipos.assessment import schemes
    from multipos.averages import Averages
    from multipos.averaging import average
    from multipos.calibration import Calibration, load
    from multipos.checks import check
    from multipos.comparison import compare
    from multipos.compensation import apply
    from multipos.correction import correct
    from multipos.designs import design
    from multipos.errors import ConvergenceError, MultiposError, RankError, UsageError
    from multipos.exporters import export, verify_export
    from multipos.fitting import fit
    from multipos.model import Model
    from multipos.prospects import worth
    from multipos.readings import Readings, read_readings
    from multipos.regressing import regress
    from multipos.regression import Regression, load_regression
    from multipos.scheme import Scheme, read_scheme
    from multipos.simulation import simulate, simulate_log
    from multipos.single_axis import Tumble, tumble
    from multipos.song_qin import demo
    from multipos.temperature import over_temperature
    from multipos.turntable import state_bench, table_errors
    from multipos.units import normal_gravity
    from multipos.verdicts import Check, load_check


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module 'multipos' has no attribute '{name}'")
    from importlib import import_module

    value = getattr(import_module(f"multipos.{_PUBLIC[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
