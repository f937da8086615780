"""Guided, live: rows as they come, rests as they happen, the next pose, and when it is enough.

Open `session` first.
"""
