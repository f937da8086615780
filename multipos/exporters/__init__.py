"""Calibrations in the form that a consumer takes: a C function, or the parameters of a program.

Each target is a module that writes the file and knows the consumer's law; `verify_export` reads a
written file back, applies that law to the readings of the calibration and shows what is left.
"""

from multipos.exporters.targets import TARGETS, Exported, export, self_test
from multipos.exporters.verification import Verification, verify_export

__all__ = ["TARGETS", "Exported", "Verification", "export", "self_test", "verify_export"]
