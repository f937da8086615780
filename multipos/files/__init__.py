"""Tables, JSON and TOML in and out, whole or not at all, and numbers as people read them.

Open `tables` first: it reads every CSV file.
"""
