"""What does not look right in a finished calibration.

Open `examination` first, which asks them all.
"""
