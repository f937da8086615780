"""What a calibration is for: force from raw readings with its U, and corrected columns.

Open `applying` first.
"""
