"""Raw logs, read piece by piece and in any length, to rests and their averages.

Open `opening` first, which decides what reads a file; `averaging` is the front door.
"""
