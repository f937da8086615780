"""The front doors: from readings, columns or raw logs to a finished result.

Open `readings` for `fit`; `columns` has `regress`, and `logs` has `calibrate`.
"""
