"""Many units at once: each one's calibration, and what only all of them together can tell.

Open `fit_many` first.
"""
