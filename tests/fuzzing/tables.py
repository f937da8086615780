"""Damage to tables: readings, schemes, logs, sections and data as comma-separated text.

A mutator takes the rows, header first, as lists of cells, and returns rows. The order in which it
draws is fixed, so that a case is the same each time.
"""

import random
from collections.abc import Callable

from . import hostile, raw
from .hostile import listed

Rows = list[list[str]]
Mutator = Callable[[random.Random, Rows], Rows]

# Names that one of the readers gives a meaning.
HEADERS = (
    *("a b", "a*b"),
    *listed("position direction up_x up_y up_z roll_deg pitch_deg yaw_deg f_x f_y f_z roll_axis"),
    *listed("reference_u_x reference_u_y reference_u_z qw qx qy qz angle_deg n sd_ax u_ax u_ay"),
    *listed("dof_ax orientation_sd_deg group temperature time ambient_p x_rate T_rate ax ay az gx"),
    *listed("x y z own start end outside predicted T AX Time time_ms"),
)
DIRECTIONS = ("E-U-S", "EUS", "东天南", "E-E-E", "U", "d-e-s", "U-E", "E-N-U-S", "N-E-U", "X-Y-Z")
FACTORS = (0.0, -1.0, 9.80665, 1e-3, 1e3, 1e-46, 1e38, 1e150, 1e-150, 1e300, 1e-300, 1e-320)
OFFSETS = (1e-9, 1.0, 1e3, 1e9, 1e16, -1e30)


def _cell(rng: random.Random, rows: Rows) -> tuple[int, int]:
    """Where a cell is, mostly below the header."""
    first = 0 if rng.random() < 0.1 or len(rows) < 2 else 1
    i = rng.randrange(first, len(rows))
    return i, rng.randrange(max(len(rows[i]), 1))


def _column(rng: random.Random, rows: Rows) -> int:
    return rng.randrange(max(len(rows[0]), 1))


def _change_column(rows: Rows, j: int, change: Callable[[str], str]) -> Rows:
    """Change the cells of a column below its header."""
    return rows[:1] + [
        [change(cell) if place == j else cell for place, cell in enumerate(row)] for row in rows[1:]
    ]


def _arithmetic(change: Callable[[float], float]) -> Callable[[str], str]:
    def changed(cell: str) -> str:
        try:
            return repr(change(float(cell)))
        except ValueError:
            return cell

    return changed


def _replace_cell(rng: random.Random, rows: Rows) -> Rows:
    i, j = _cell(rng, rows)
    value = rng.choice((hostile.number, hostile.number, hostile.text_with_controls))(rng)
    rows[i][j : j + 1] = [value]
    return rows


def _replace_direction(rng: random.Random, rows: Rows) -> Rows:
    i, j = _cell(rng, rows)
    rows[i][j : j + 1] = [rng.choice(DIRECTIONS)]
    return rows


def _fill_column(rng: random.Random, rows: Rows) -> Rows:
    value = hostile.number(rng)
    return _change_column(rows, _column(rng, rows), lambda _: value)


def _fill_column_at_random(rng: random.Random, rows: Rows) -> Rows:
    values = [hostile.number(rng) for _ in range(rng.choice((2, 3, 10)))]
    return _change_column(rows, _column(rng, rows), lambda _: rng.choice(values))


def _empty_some_cells(rng: random.Random, rows: Rows) -> Rows:
    share = rng.choice((0.1, 0.5, 1.0))
    return _change_column(
        rows, _column(rng, rows), lambda cell: "" if rng.random() < share else cell
    )


def _compute_column(rng: random.Random, rows: Rows) -> Rows:
    factor, offset, digits = rng.choice(FACTORS), rng.choice(OFFSETS), rng.choice((0, 1, 2))
    size = rng.choice((1e-12, 1e-3, 1.0, 1e6))
    changes = (
        lambda value: value * factor,
        lambda value: value + offset,
        lambda value: round(value, digits),
        lambda value: value + rng.gauss(0, size),
    )
    return _change_column(rows, _column(rng, rows), _arithmetic(rng.choice(changes)))


def _scale_all(rng: random.Random, rows: Rows) -> Rows:
    factor = rng.choice(FACTORS)
    change = _arithmetic(lambda value: value * factor)
    skipped = rng.choice((0, 1, 4))  # the first columns say where the sensor stood
    return rows[:1] + [row[:skipped] + [change(cell) for cell in row[skipped:]] for row in rows[1:]]


def _copy_column(rng: random.Random, rows: Rows) -> Rows:
    source, target = _column(rng, rows), _column(rng, rows)
    for row in rows[1:]:
        if max(source, target) < len(row):
            row[target] = row[source]
    return rows


def _drop_column(rng: random.Random, rows: Rows) -> Rows:
    j = _column(rng, rows)
    return [row[:j] + row[j + 1 :] for row in rows]


def _repeat_column(rng: random.Random, rows: Rows) -> Rows:
    j = _column(rng, rows)
    return [row[: j + 1] + row[j:] for row in rows]


def _name_column(rng: random.Random, rows: Rows) -> Rows:
    j = _column(rng, rows)
    known = rng.random() < 0.7
    rows[0][j : j + 1] = [rng.choice(HEADERS) if known else hostile.text_with_controls(rng)]
    return rows


def _add_column(rng: random.Random, rows: Rows) -> Rows:
    values = rng.choices(hostile.PLAIN_NUMBERS, k=rng.choice((1, 2, 5)))
    if rng.random() < 0.3:
        values.append(hostile.number(rng))
    return [[*rows[0], rng.choice(HEADERS)], *([*row, rng.choice(values)] for row in rows[1:])]


def _shuffle_columns(rng: random.Random, rows: Rows) -> Rows:
    order = list(range(len(rows[0])))
    rng.shuffle(order)
    return [[row[j] for j in order if j < len(row)] for row in rows]


def _drop_rows(rng: random.Random, rows: Rows) -> Rows:
    share = rng.choice((0.1, 0.5, 0.9))
    return rows[:1] + [row for row in rows[1:] if rng.random() > share]


def _keep_first_rows(rng: random.Random, rows: Rows) -> Rows:
    return rows[: rng.choice((0, 1, 2, 3, 4, 5, 7, 10))]


def _repeat_rows(rng: random.Random, rows: Rows) -> Rows:
    times = rng.choice((2, 3, 20)) if len(rows) < 100 else 2
    return rows[:1] + [list(row) for row in rows[1:] * times]


def _repeat_one_row(rng: random.Random, rows: Rows) -> Rows:
    i = rng.randrange(len(rows))
    return rows[:i] + [list(rows[i]) for _ in range(rng.choice((2, 50)))] + rows[i:]


def _shuffle_rows(rng: random.Random, rows: Rows) -> Rows:
    below = rows[1:]
    rng.shuffle(below)
    return rows[:1] + below


def _reverse_rows(_: random.Random, rows: Rows) -> Rows:
    return rows[:1] + rows[:0:-1]


def _all_rows_alike(rng: random.Random, rows: Rows) -> Rows:
    return rows[:1] + [list(rows[-1]) for _ in rows[1:]]


def _drop_header(_: random.Random, rows: Rows) -> Rows:
    return rows[1:]


def _ragged(rng: random.Random, rows: Rows) -> Rows:
    i, j = _cell(rng, rows)
    rows[i] = rng.choice((rows[i][:j], [*rows[i], ""], [*rows[i], "1", "2"], [], rows[i] * 2))
    return rows


def _wide(rng: random.Random, rows: Rows) -> Rows:
    extra = rng.choice((30, 300, 3000)) if len(rows) < 100 else 30
    new = [[f"c{j}" for j in range(extra)], *([rng.choice("012x")] * extra for _ in rows[1:])]
    return [row + more for row, more in zip(rows, new, strict=True)]


def _long_cell(rng: random.Random, rows: Rows) -> Rows:
    i, j = _cell(rng, rows)
    rows[i][j : j + 1] = [rng.choice(("A", "1", "é")) * rng.choice((1000, 140_000))]
    return rows


def _comment(rng: random.Random, rows: Rows) -> Rows:
    i, _ = _cell(rng, rows)
    rows.insert(i, [rng.choice(("#", "# x", "//", "%", "", "unit,g", "<!--"))])
    return rows


MUTATORS: tuple[Mutator, ...] = (  # each as often as it stands here
    *[_replace_cell, _name_column, _add_column] * 2,
    *[_compute_column] * 4,
    *(_replace_cell, _replace_direction, _fill_column, _fill_column_at_random, _empty_some_cells),
    *(_scale_all, _copy_column, _drop_column, _repeat_column, _shuffle_columns, _drop_rows),
    *(_keep_first_rows, _repeat_rows, _repeat_one_row, _shuffle_rows, _reverse_rows),
    *(_all_rows_alike, _drop_header, _ragged, _wide, _long_cell, _comment),
)


def _written_with_semicolons(_: random.Random, rows: Rows) -> str:
    return "\n".join(";".join(cell.replace(".", ",") for cell in row) for row in rows)


def _written_with_tabs(_: random.Random, rows: Rows) -> str:
    return "\n".join("\t".join(row) for row in rows)


def _written_with_spaces(_: random.Random, rows: Rows) -> str:
    return "\n".join("  ".join(row) for row in rows)


def _written_with_mixed_separators(rng: random.Random, rows: Rows) -> str:
    return "\n".join(rng.choice(",,,;\t").join(row) for row in rows)


def _written_with_quotes(_: random.Random, rows: Rows) -> str:
    return "\n".join(",".join('"' + cell + '"' for cell in row) for row in rows)


def _written_with_open_quote(rng: random.Random, rows: Rows) -> str:
    i, j = _cell(rng, rows)
    rows[i][j : j + 1] = ['"' + "".join(rows[i][j : j + 1])]
    return "\n".join(",".join(row) for row in rows)


WRITERS: tuple[Callable[[random.Random, Rows], str], ...] = (
    _written_with_semicolons,
    _written_with_tabs,
    _written_with_spaces,
    _written_with_mixed_separators,
    _written_with_quotes,
    _written_with_open_quote,
)


def mutate(rng: random.Random, data: bytes) -> bytes:
    """Return a table with one to three things changed, and now and then written otherwise."""
    mark = ";" if b";" in data.splitlines()[0] else ","
    rows = [line.split(mark) for line in data.decode("utf-8").splitlines()]
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        if rows:
            rows = rng.choice(MUTATORS)(rng, rows)
    if rows and rng.random() < 0.15:
        written = rng.choice(WRITERS)(rng, rows)
    else:
        written = "\n".join(mark.join(row) for row in rows)
    changed = f"{written}\n".encode("utf-8", "surrogatepass")
    return raw.damage(rng, changed) if rng.random() < 0.15 else changed
