"""Numbers as text, against Python's own: the shortest text, and so many significant digits."""

import numpy as np
import pytest

from multipos.files.decimals import format_numbers

rng = np.random.default_rng(5)
N = 20_000
NUMBERS = {
    "between -1 and 1": rng.uniform(-1.0, 1.0, N),
    "of any size": rng.standard_normal(N) * 10.0 ** rng.integers(-12, 14, N),
    "with few decimals": np.round(rng.uniform(-20.0, 20.0, N), 3),
    "eighths": rng.integers(-1000, 1000, N) / 8.0,
    "powers of two": 2.0 ** np.arange(-60, 60),
    "beside powers of ten": np.nextafter(10.0 ** rng.integers(-8, 10, N), rng.choice([-1, 1e9], N)),
    "any bits": rng.integers(0, 2**53, N) / 2.0 ** rng.integers(20, 60, N),
    "special": np.array([0.0, -0.0, np.nan, np.inf, -np.inf, 5e-324, 1e22, 1e-4, 9.9999999e-5]),
}


@pytest.mark.parametrize("kind", NUMBERS)
def test_every_number_is_written_as_python_does(kind):
    values = NUMBERS[kind]
    wanted = ["" if value != value else repr(value) for value in values.tolist()]
    assert format_numbers([values], ",", [None]).splitlines() == wanted


@pytest.mark.parametrize("kind", NUMBERS)
def test_four_digits_are_the_nearest(kind):
    values = NUMBERS[kind]
    values = values[np.isfinite(values)]
    found = np.array([float(text) for text in format_numbers([values], ",", [4]).splitlines()])
    wanted = np.array([float(f"{value:.3e}") for value in values.tolist()])
    # a tie of decimals may go either way
    tie = np.abs(found - values) <= np.abs(wanted - values) * (1.0 + 1e-9)
    assert (tie | (found == wanted)).all()


def test_columns_side_by_side():
    columns = [np.array([1.5, np.nan]), np.array([1, -12]), np.array([True, False])]
    assert format_numbers(columns, ";", [None] * 3) == "1,5;1;True\n;-12;False\n"
