"""The measurement equation, its inverse, and the calibration that holds its numbers.

Open `model` first, then `calibration`, the one result of every estimator.
"""
