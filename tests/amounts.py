"""How much of a simulation runs: at once enough to fail for the same fault, and all as slow."""

import pytest


def few_and_many(few: object, many: object) -> list[object]:
    """Return two values of a parameter, or of several, of which the second is slow."""
    several = many if isinstance(many, tuple) else (many,)
    return [few, pytest.param(*several, marks=pytest.mark.slow)]
