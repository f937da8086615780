"""Raw logs, read piece by piece: text, NumPy and MATLAB files, of any length.

A log is a table of samples, one row a sample. Text comes with commas, semicolons (and decimal
commas), tabs or white space between the cells, with or without a header; without one the columns
are called 1, 2, 3, …. Which reader serves a file is decided by its first bytes and then by its
suffix (`READERS`); whatever is neither is text. Only what was asked for is turned into numbers,
in pieces of some megabytes, so that the length of a log does not matter; a `.npz` or `.mat` file
is the exception, because its format holds each array in one piece.
"""

from multipos.logs.opening import open_log, read_log
from multipos.logs.readers import READERS
from multipos.logs.table import Log, Piece

__all__ = ["READERS", "Log", "Piece", "open_log", "read_log"]
