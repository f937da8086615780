"""What a calibration is worth: the budget, its sensitivities, Monte Carlo, profiles, the sphere.

Open `propagation` first.
"""
