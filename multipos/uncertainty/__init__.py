"""What a calibration is worth: the budget, its sensitivities, Monte Carlo, the sphere.

Open `propagation` first.
"""
