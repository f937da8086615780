"""Tables of thousands of columns: read in a time that grows as they do, refused in one line."""

import time

import pytest

from multipos.cli import main


def wide(path, count, rows=("1.5",) * 3):
    header = ",".join(f"c{i}" for i in range(count))
    path.write_text("\n".join([header, *(",".join([row] * count) for row in rows)]) + "\n")
    return str(path)


def seconds(path):
    before = time.process_time()
    assert main(["fit", path]) == 2
    return time.process_time() - before


def test_reading_is_linear_in_the_columns(tmp_path, capsys):
    few, many = wide(tmp_path / "few.csv", 2_000), wide(tmp_path / "many.csv", 16_000)
    seconds(few)  # imports
    # 8 where linear, 64 where quadratic; one run may collect what all tests before it left
    assert any(seconds(many) < 24 * seconds(few) for _ in range(3))


@pytest.mark.parametrize("command", ["fit", "calibrate", "average", "tumble"])
def test_a_refusal_is_one_line_of_300_characters(tmp_path, capsys, command):
    rows = [f"{value}" for value in (0.1, 0.5, 0.9)] * 20
    path = wide(tmp_path / "wide.csv", 10_000, rows)
    assert main([command, path]) in (1, 2)
    (said,) = [line for line in capsys.readouterr().err.splitlines() if "error" in line]
    assert len(said) <= 300
    assert "only a header" not in said
