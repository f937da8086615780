"""What does not look right in a finished calibration.

Open `criticism` first.
"""
