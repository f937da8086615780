"""Whether it is right: independent runs, repeats, and the tumble of a single axis.

Open `checks` first.
"""
