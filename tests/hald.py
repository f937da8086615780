"""Hald's cement data: heat of hardening against four compounds.

Source: A. Hald, Statistical Theory with Engineering Applications, Wiley 1952, p. 647; N. R. Draper,
H. Smith, Applied Regression Analysis, 2nd ed., Wiley 1981, appendix B (data), chapter 6 (F of the
stepwise path).
"""

import numpy as np

_ROWS = """
     7 26  6 60  78.5
     1 29 15 52  74.3
    11 56  8 20 104.3
    11 31  8 47  87.6
     7 52  6 33  95.9
    11 55  9 22 109.2
     3 71 17  6 102.7
     1 31 22 44  72.5
     2 54 18 22  93.1
    21 47  4 26 115.9
     1 40 23 34  83.8
    11 66  9 12 113.3
    10 68  8 12 109.4
"""
TABLE = np.array([row.split() for row in _ROWS.split("\n") if row.strip()], dtype=float)
COLUMNS = {f"x{i + 1}": TABLE[:, i] for i in range(4)} | {"y": TABLE[:, 4]}
DESIGN = np.column_stack((np.ones(13), TABLE[:, :4]))
RESPONSE = TABLE[:, 4]

# enter .06: action, term, F
PATH = [
    ("add", "x4", 22.7985),
    ("add", "x1", 108.2239),
    ("add", "x2", 5.0259),
    ("remove", "x4", 1.8633),
]
COEFFICIENTS = {"1": 52.57735, "x1": 1.46831, "x2": 0.66225}
