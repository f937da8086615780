"""Named schemes by their geometry, joins, files and labels."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from multipos.cli import command_parser
from multipos.errors import MultiposError, UsageError
from multipos.positions.attitudes import from_up
from multipos.positions.scheme import SCHEMES, NamedScheme, named_schemes, read_scheme


def angles_deg(up):
    """Angles between all pairs of up vectors, rounded."""
    cosine = np.clip(up @ up.T, -1, 1)
    rows, columns = np.triu_indices(len(up), 1)
    return np.round(np.degrees(np.arccos(cosine[rows, columns])), 4)


def test_song_qin_is_table_1_of_the_paper():
    scheme = read_scheme("song-qin-6")
    # "gravity" of table 1, positions 1 to 6; up is its opposite
    gravity = [[0, -1, 0], [0, 0, -1], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, 0, 1]]
    assert_array_equal(scheme.up, -np.array(gravity) + 0.0)
    assert scheme.labels == tuple("123456")
    assert_allclose(np.linalg.det(scheme.rotation), 1)


@pytest.mark.parametrize(
    ("name", "count", "smallest_deg", "neighbours"),
    [
        ("faces-6", 6, 90, 4),
        ("corners-8", 8, 70.5288, 3),
        ("edges-12", 12, 60, 4),
        ("icosahedron-12", 12, 63.4349, 5),
        ("dodecahedron-20", 20, 41.8103, 3),
    ],
)
def test_solids_have_their_angles(name, count, smallest_deg, neighbours):
    up = read_scheme(name).up
    found = angles_deg(up)
    assert len(up) == count
    assert found.min() == pytest.approx(smallest_deg)
    assert (found == found.min()).sum() * 2 == count * neighbours
    assert_allclose(up.sum(axis=0), 0, atol=1e-14)
    assert_allclose(up.T @ up, np.eye(3) * count / 3, atol=1e-13)  # balanced
    assert_allclose(np.linalg.norm(up, axis=1), 1)


@pytest.mark.parametrize(
    ("name", "parts"),
    [
        ("faces-corners-14", "faces-6+corners-8"),
        ("faces-edges-18", "faces-6+edges-12"),
        ("all-26", "faces-6+edges-12+corners-8"),
        ("dual-axis-48", "roll-y-24+roll-x-24"),
        ("tumble-12", "roll-z-12"),
    ],
)
def test_composed_names_are_their_parts(name, parts):
    whole, joined = read_scheme(name), read_scheme(parts)
    assert_array_equal(whole.up, joined.up)
    assert_array_equal(whole.rotation, joined.rotation)
    assert whole.labels == joined.labels == tuple(str(i + 1) for i in range(len(whole)))


@pytest.mark.parametrize(
    ("name", "up"),
    [
        ("roll-x-4", [[0, 1, 0], [0, 0, 1], [0, -1, 0], [0, 0, -1]]),
        ("roll-y-4", [[1, 0, 0], [0, 0, 1], [-1, 0, 0], [0, 0, -1]]),
        ("roll-z-4", [[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]]),
    ],
)
def test_rolls_are_exact_at_quarter_turns(name, up):
    assert_array_equal(read_scheme(name).up, up)
    family = name.rpartition("-")[0]
    for count in (12, 28, 360):
        quarters = read_scheme(f"{family}-{count}").up[:: count // 4]
        assert_array_equal(quarters, up)


def test_rolls_follow_the_angle():
    t = np.arange(24) * math.tau / 24
    zero = 0 * t
    assert_allclose(
        read_scheme("roll-x-24").up, np.column_stack([zero, np.cos(t), np.sin(t)]), atol=1e-15
    )


@pytest.mark.parametrize("count", [1, 2, 24, 999])
def test_fibonacci_is_even(count):
    up = read_scheme(f"fibonacci-{count}").up
    assert_allclose(np.linalg.norm(up, axis=1), 1)
    assert_allclose(up[:, 2], 1 - (2 * np.arange(count) + 1) / count, atol=1e-15)
    if count >= 24:
        # a hexagonal packing of the sphere would have 3.809/√n between neighbours
        nearest = np.sort(up @ up.T, axis=1)[:, -2]
        assert np.arccos(nearest).min() * math.sqrt(count) > 2.5


def test_every_named_scheme_reads_and_is_proper():
    for name in named_schemes():
        scheme = read_scheme(name)
        assert scheme.name == name
        assert len(scheme.labels) == len(scheme) == len(scheme.rotation)
        known = ~np.isnan(scheme.rotation).any(axis=(1, 2))
        assert_allclose(np.linalg.det(scheme.rotation[known]), 1)
        assert_array_equal(scheme.rotation[known][:, :, 2], scheme.up[known])
        assert not scheme.up.flags.writeable


def test_a_new_scheme_is_one_entry(monkeypatch):
    pair = NamedScheme("up along z, and down", lambda: from_up([[0, 0, 1], [0, 0, -1]]))
    fan = NamedScheme("N times up", lambda count: from_up([[0, 0, 1]] * count), 5)
    monkeypatch.setitem(SCHEMES, "pair-2", pair)
    monkeypatch.setitem(SCHEMES, "fan-N", fan)
    joined = read_scheme("pair-2+fan-3")
    assert joined.up[:, 2].tolist() == [1, -1, 1, 1, 1]
    assert named_schemes()[-2:] == ("pair-2", "fan-5")
    for name in ("pair", "fan-N", "fan-x", "pair-3"):  # none of them is a name
        with pytest.raises(UsageError, match="tumble-N, pair-2, fan-N, joined by"):
            read_scheme(name)
    listed = command_parser("schemes").format_help()
    assert "up along z, and down" in listed
    assert "N times up" in listed


def test_files_and_joins(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.csv").write_text("position,direction\na,E-N-U\nb,东天南\n")
    (tmp_path / "bare.csv").write_text("up_x,up_y,up_z\n0,0,2\n")
    assert read_scheme("mine.csv").labels == ("a", "b")
    joined = read_scheme("mine.csv + faces-6")
    assert joined.labels == ("a", "b", "3", "4", "5", "6", "7", "8")
    assert_array_equal(joined.up[:2], [[0, 0, 1], [0, 1, 0]])
    assert read_scheme("bare.csv+faces-6").labels is None
    assert read_scheme({"position": [7], "up_x": [0], "up_y": [3], "up_z": [4]}).labels == ("7",)
    assert_allclose(read_scheme({"up_x": [0], "up_y": [3], "up_z": [4]}).up, [[0, 0.6, 0.8]])
    with pytest.raises(MultiposError, match="position 'a' appears twice"):
        read_scheme("mine.csv+mine.csv")
    assert len(read_scheme("+".join(["faces-6"] * 60))) == 360  # longer than a file name may be


@pytest.mark.parametrize("forced", [0, 2, 3])
def test_the_columns_of_a_scheme_are_that_scheme(forced):
    # On a centrifuge some positions, or all, have a known force in place of a direction.
    columns = {
        "position": ["a", "b", "c"],
        "f_x": [3.0, 0.0, 0.5],
        "f_y": [0.0, -4.0, 0.5],
        "f_z": [1.0, 1.0, 7.0],
    }
    if forced < 3:
        for name in ("f_x", "f_y", "f_z"):
            columns[name][forced:] = [np.nan] * (3 - forced)
        up = np.array([[np.nan] * 3] * forced + [[0.6, 0.0, 0.8]] * (3 - forced))
        columns |= dict(zip(("up_x", "up_y", "up_z"), up.T, strict=True))
    scheme = read_scheme(columns)
    again = read_scheme(scheme.columns())
    np.testing.assert_array_equal(again.reference, scheme.reference)
    assert again.names == ("a", "b", "c")
    assert (again.force is None) == (forced == 0)


@pytest.mark.parametrize(
    ("name", "error", "message"),
    [
        ("six", UsageError, "unknown scheme 'six'; give a file or one of song-qin-6"),
        ("faces-8", UsageError, "unknown scheme"),
        ("faces-6+", UsageError, "unknown scheme ''"),
        ("", UsageError, "unknown scheme ''"),
        ("roll-x-0", UsageError, "N must lie between 1 and 1000000, got 0"),
        ("fibonacci-9999999", UsageError, "N must lie between"),
        (f"fibonacci-{'9' * 5000}", UsageError, "1000000, got 9{40}.$"),
        ("none.csv", MultiposError, "none.csv: no such file; check the path of the scheme"),
        ("x" * 300, UsageError, "unknown scheme"),
    ],
)
def test_unknown_schemes_are_refused(name, error, message):
    with pytest.raises(error, match=message):
        read_scheme(name)


def test_a_file_without_orientation_is_no_scheme(tmp_path):
    path = tmp_path / "s.csv"
    path.write_text("position,ax\n1,2\n")
    with pytest.raises(MultiposError, match="no orientation columns; give direction"):
        read_scheme(path)


def test_a_file_may_be_called_anything(tmp_path):
    """Its name stands in notes, on one line, and does nothing to a terminal."""
    path = tmp_path / "a\n\x1b[31m.csv"
    path.write_text("position,direction\n1,E-N-U\n")
    assert read_scheme(path).name.endswith(r"a\u000a\u001b[31m.csv")
