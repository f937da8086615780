"""Numbers read by the block: the same as one by one, and nothing else is taken."""

import warnings

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from multipos.errors import MultiposError
from multipos.logs.opening import open_log

SEPARATORS = ("", ",", ";", "\t")
WIDTH = 4


def bits(values):
    """Doubles as integers, for -0.0 is not 0.0 here."""
    return np.ascontiguousarray(values, dtype=np.float64).view(np.int64)


def random_cell(rng):
    """A number as loggers write them: of any length, with a point anywhere, seldom an exponent."""
    digits = "".join(map(str, rng.integers(0, 10, rng.integers(1, 20)).tolist()))
    place = rng.integers(0, len(digits) + 1)
    cell = digits if rng.random() < 0.3 else f"{digits[:place]}.{digits[place:]}"
    cell = f"-{cell}" if rng.random() < 0.4 else cell
    return f"{cell}e{rng.integers(-30, 30)}" if rng.random() < 0.05 else cell


def random_rows(rng, count):
    return [[random_cell(rng) for _ in range(WIDTH)] for _ in range(count)]


def read(tmp_path, text, mark, columns):
    """The wanted columns of a text whose columns are called a, b, c and d."""
    path = tmp_path / "log.txt"
    path.write_text((mark or " ").join("abcd") + "\n" + text, encoding="utf-8")
    names = ["abcd"[i] for i in columns]
    pieces = [piece.table for piece in open_log(path).read(names)]
    return np.concatenate([[table.columns[name] for name in names] for table in pieces], axis=1)


@pytest.mark.parametrize("mark", SEPARATORS)
def test_numbers_are_the_nearest_doubles(tmp_path, mark):
    """Bit by bit what `float` makes of every cell."""
    rows = random_rows(np.random.default_rng(1), 500)
    text = "\n".join((mark or " ").join(row) for row in rows)
    expected = bits([[float(cell) for cell in row] for row in rows])
    for columns in ([0, 1, 2, 3], [2], [3, 0]):
        assert_array_equal(bits(read(tmp_path, text, mark, columns)), expected[:, columns].T)


@pytest.mark.parametrize(
    "cell",
    [
        *("0", "-0", "0.0", "-0.000", "007", "1.", ".5", "-.5", "+2", "1e3", "-1.5E-07", "5e-324"),
        *("9007199254740992", "9007199254740993", "90071992547409.93", "0.30000000000000004"),
        *("9999999999999999999", "9223372036854775809", "1698765432123456789", "99999999"),
        *("100000000", "1234567890123456", "12345678901234567", "1698765432.123456789"),
        *("18446744073709551616", "0.1234567890123456789", "123456789012345678901234567890"),
    ],
)
def test_single_numbers_at_the_borders(tmp_path, cell):
    """Beyond 2^53, 19 digits, 8 and 16 digits, and zeros of both signs."""
    found = read(tmp_path, f"{cell},1,2,3\n-4,5.5,6,7\n", ",", [0, 1])
    assert_array_equal(bits(found), bits([[float(cell), -4.0], [1.0, 5.5]]))


@pytest.mark.parametrize(
    "text", ["1 2  3   4\n5\t6 7 8\n", "   1 2 3 4   \n 5 6 7 8", "1 2 3 4\n5 6 7 8"]
)
def test_white_space_in_any_amount(tmp_path, text):
    assert_array_equal(read(tmp_path, text, "", [0, 3]), [[1.0, 5.0], [4.0, 8.0]])


def test_blanks_around_separators(tmp_path):
    text = " 1, 2,  3 ,4\n5 ,6 , 7, 8 \n"
    assert_array_equal(read(tmp_path, text, ",", [0, 2, 3]), [[1, 5], [3, 7], [4, 8]])


def test_no_columns_of_some_rows(tmp_path):
    (tmp_path / "log.csv").write_text("1.5,2\n3,4\n")
    (piece,) = open_log(tmp_path / "log.csv").read(())
    assert (piece.table.rows, dict(piece.table.columns)) == (2, {})


OTHERS = (
    *("", "-", ".", "-.", "--1", "1-", "1-2", "1.2.3", ".-1", "1_0", "inf", "e5"),
    *("1e", "1e5.0", "1 2", '"1', "a", "+-1"),
)


@pytest.mark.parametrize("place", [1, 2])
@pytest.mark.parametrize("cell", OTHERS)
def test_anything_else_is_refused_by_its_place(tmp_path, cell, place):
    row = ["1", "2", "3", "4"]
    row[place] = cell
    text = "1,2,3,4.5\n" * 20 + ",".join(row) + "\n" + "1,2,3,4\n" * 20
    with pytest.raises(MultiposError, match=r"line 22"):
        read(tmp_path, text, ",", [1, 2])


@pytest.mark.parametrize("row", ["1,2,3", "1,2,3,4,", "1,2,3,4,5,6,7,8", "1,2,3\n4,5,6,7,8"])
def test_rows_of_another_width_are_refused_by_their_line(tmp_path, row):
    text = "1,2,3,4.5\n" * 20 + row + "\n" + "1,2,3,4\n" * 20
    with pytest.raises(MultiposError, match=r"line 22.*has \d cells where there are 4"):
        read(tmp_path, text, ",", [0])


@pytest.mark.parametrize("line", ["", "  ", "# 9,9,9,9", "//9,9,9,9", "%9,9,9,9"])
def test_comments_and_empty_lines_are_no_rows(tmp_path, line):
    text = f"1,2,3,4.5\n{line}\n5,6,7,8\n"
    assert_array_equal(read(tmp_path, text, ",", [1, 2]), [[2.0, 6.0], [3.0, 7.0]])


def outcome(path, *, lenient):
    """All that comes of reading a file: bits, lines of rows, or the error."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # an old NumPy warns of what it cannot read
            log = open_log(path)
            names = log.numeric if not lenient else ()
            pieces = [*log.read(names, log.numeric if lenient else (), lenient=lenient)]
    except MultiposError as error:
        return str(error)
    columns = [
        bits([each.table.columns[name] for each in [piece] for name in log.numeric]).tolist()
        for piece in pieces
    ]
    places = [[*piece.table.lines] for piece in pieces]
    return (
        columns,
        places,
        [piece.lines() for piece in pieces],
        [piece.table.first for piece in pieces],
    )


@pytest.mark.parametrize("mark", SEPARATORS)
def test_damaged_text_gives_the_same_by_both_ways(monkeypatch, tmp_path, mark):
    """Random characters into random rows: numbers, rows and errors as cell by cell."""
    rng = np.random.default_rng(2)
    taken = 0
    for case in range(40):
        rows = random_rows(rng, 40)
        text = "time,ax,ay,az\n".replace(",", mark or " ")
        text += "".join((mark or " ").join(row) + "\n" for row in rows)
        for _ in range(rng.integers(0, 3)):
            at = rng.integers(len(text) // 2, len(text))
            damage = rng.choice([*' \t,;.-+eE_#"0123456789\nnax\r%/', "", "nan", "\n\n", "# 1\n"])
            text = text[:at] + str(damage) + text[at + rng.integers(0, 2) :]
        path = tmp_path / f"{case}.txt"
        path.write_text(text, encoding="utf-8", newline="")
        for lenient in (False, True):
            monkeypatch.setattr("multipos.logs.text_logs._PIECE", 700)
            quick = outcome(path, lenient=lenient)
            with monkeypatch.context() as patch:
                patch.setattr("multipos.logs.text_logs._parse_at_once", lambda *_: None)
                assert quick == outcome(path, lenient=lenient)
            taken += not isinstance(quick, str)
    assert taken > 27  # most of them are read after all
