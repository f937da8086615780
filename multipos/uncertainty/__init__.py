"""How well a calibration is determined: the budget, its sensitivities, Monte Carlo, the sphere.

Open `propagation` first.
"""
