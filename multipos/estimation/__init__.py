"""From readings to a solution: the closed form, least squares, and the one likelihood.

Open `known` for orientations that are known, `likelihood` for those known badly or not at all. The
front door is `multipos.fitting`.
"""
