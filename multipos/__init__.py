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

__version__ = "0.2.0"

_PUBLIC = {
    "Averages": "logs.averages",
    "Calibration": "sensor.calibration",
    "CalibrationWarning": "errors",
    "Captured": "capturing.running",
    "Check": "verification.verdicts",
    "ConvergenceError": "errors",
    "Finding": "finding",
    "Fleet": "fleets.fleet",
    "Formula": "numerics.terms",
    "Model": "sensor.model",
    "MultiposError": "errors",
    "RankError": "errors",
    "Readings": "positions.readings",
    "Regression": "regression.regression",
    "Regressions": "regression.regression",
    "Scheme": "positions.scheme",
    "Stability": "bias_stability.stability_result",
    "Tumble": "verification.tumbling",
    "Tumbles": "verification.tumbling",
    "UsageError": "errors",
    "apply": "compensation.applying",
    "average": "logs.averaging",
    "calibrate": "fitting.calibrate_logs",
    "capture": "capturing.running",
    "check": "verification.checks",
    "compare": "verification.comparison",
    "correct": "compensation.correction",
    "demo": "song_qin",
    "design": "designs.designing",
    "evaluate_budget": "uncertainty.propagation",
    "evaluate_sphere": "uncertainty.validity",
    "export": "exports.targets",
    "fit": "fitting.fit_readings",
    "fit_many": "fleets.fit_many",
    "fleet": "fleets.fleet",
    "load": "sensor.calibration_file",
    "load_check": "verification.verdicts",
    "load_regression": "regression.regression_file",
    "load_stability": "bias_stability.stability_result",
    "normal_gravity": "units",
    "over_temperature": "sensor.temperature",
    "read_readings": "positions.reading_tables",
    "read_scheme": "positions.scheme",
    "read_table": "files.tables",
    "regress": "fitting.regress_columns",
    "report": "reports.documents",
    "schemes": "designs.assessment",
    "simulate": "sensor.simulation",
    "simulate_budget": "uncertainty.monte_carlo",
    "simulate_log": "sensor.simulation",
    "stability": "bias_stability.analysis",
    "state_bench": "uncertainty.turntable",
    "state_budget": "uncertainty.propagation",
    "table_errors": "uncertainty.turntable",
    "tumble": "verification.tumbling",
    "verify_export": "exports.targets",
    "worth": "designs.prospects",
    "write_table": "files.tables",
}

__all__ = sorted([*_PUBLIC, "__version__"])

if TYPE_CHECKING:
    from multipos.bias_stability.analysis import stability as stability
    from multipos.bias_stability.stability_result import Stability as Stability
    from multipos.bias_stability.stability_result import load_stability as load_stability
    from multipos.capturing.running import Captured as Captured
    from multipos.capturing.running import capture as capture
    from multipos.compensation.applying import apply as apply
    from multipos.compensation.correction import correct as correct
    from multipos.designs.assessment import schemes as schemes
    from multipos.designs.designing import design as design
    from multipos.designs.prospects import worth as worth
    from multipos.errors import CalibrationWarning as CalibrationWarning
    from multipos.errors import ConvergenceError as ConvergenceError
    from multipos.errors import MultiposError as MultiposError
    from multipos.errors import RankError as RankError
    from multipos.errors import UsageError as UsageError
    from multipos.exports.targets import export as export
    from multipos.exports.targets import verify_export as verify_export
    from multipos.files.tables import read_table as read_table
    from multipos.files.tables import write_table as write_table
    from multipos.finding import Finding as Finding
    from multipos.fitting.calibrate_logs import calibrate as calibrate
    from multipos.fitting.fit_readings import fit as fit
    from multipos.fitting.regress_columns import regress as regress
    from multipos.fleets.fit_many import fit_many as fit_many
    from multipos.fleets.fleet import Fleet as Fleet
    from multipos.fleets.fleet import fleet as fleet
    from multipos.logs.averages import Averages as Averages
    from multipos.logs.averaging import average as average
    from multipos.numerics.terms import Formula as Formula
    from multipos.positions.reading_tables import read_readings as read_readings
    from multipos.positions.readings import Readings as Readings
    from multipos.positions.scheme import Scheme as Scheme
    from multipos.positions.scheme import read_scheme as read_scheme
    from multipos.regression.regression import Regression as Regression
    from multipos.regression.regression import Regressions as Regressions
    from multipos.regression.regression_file import load_regression as load_regression
    from multipos.reports.documents import report as report
    from multipos.sensor.calibration import Calibration as Calibration
    from multipos.sensor.calibration_file import load as load
    from multipos.sensor.model import Model as Model
    from multipos.sensor.simulation import simulate as simulate
    from multipos.sensor.simulation import simulate_log as simulate_log
    from multipos.sensor.temperature import over_temperature as over_temperature
    from multipos.song_qin import demo as demo
    from multipos.uncertainty.monte_carlo import simulate_budget as simulate_budget
    from multipos.uncertainty.propagation import evaluate_budget as evaluate_budget
    from multipos.uncertainty.propagation import state_budget as state_budget
    from multipos.uncertainty.turntable import state_bench as state_bench
    from multipos.uncertainty.turntable import table_errors as table_errors
    from multipos.uncertainty.validity import evaluate_sphere as evaluate_sphere
    from multipos.units import normal_gravity as normal_gravity
    from multipos.verification.checks import check as check
    from multipos.verification.comparison import compare as compare
    from multipos.verification.tumbling import Tumble as Tumble
    from multipos.verification.tumbling import Tumbles as Tumbles
    from multipos.verification.tumbling import tumble as tumble
    from multipos.verification.verdicts import Check as Check
    from multipos.verification.verdicts import load_check as load_check


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module 'multipos' has no attribute '{name}'")
    from importlib import import_module

    value = getattr(import_module(f"multipos.{_PUBLIC[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
