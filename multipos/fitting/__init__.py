"""The front doors: from readings, columns or raw logs to a finished result.

Open `fit_readings` for `fit`; `regress_columns` has `regress`, and `calibrate_logs` has
`calibrate`.
"""
