"""How many lines changed on purpose the tests catch: `python -m tests.mutation [ROOM …]`."""
