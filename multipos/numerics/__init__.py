"""Algebra and statistics that know no accelerometer.

Open `least_squares` first: every linear problem of the package is solved there. `terms` are the
products that a formula is made of.
"""
