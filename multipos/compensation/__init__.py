"""What a calibration is for: compensated columns, C, flight controllers, and reading back.

Open `applying` first for tables and `targets` for exports, whose targets are a file each.
"""
