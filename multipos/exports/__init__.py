"""A calibration or a regression for its consumer: C, flight controllers, and reading it back.

Open `targets` first; every target is a file, named after it.
"""
