"""Where the sensor stood and what it said.

Open `readings` first. `attitudes` holds the forms in which people write an orientation, `scheme`
the ordered set of positions, by name or from a file.
"""
