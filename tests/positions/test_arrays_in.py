"""What only looks like numbers is refused by every door that takes arrays."""

import gzip

import numpy as np
import pytest

import multipos as mp
from multipos.files import pipes

UP = mp.read_scheme("all-26").up
VALUES = UP + 1e-3 * np.random.default_rng(1).normal(size=UP.shape)
READINGS = mp.Readings(VALUES, up=UP, unit="g")
CAL = mp.fit(READINGS)
MASKED = np.ma.array(VALUES, mask=UP == 1.0)
HOSTILE = {
    "hides numbers behind a mask": MASKED,
    "behind a mask; leave their rows out": [*MASKED],
    "must hold real numbers, got complex128": VALUES + 0j,
    "got datetime64": np.full(VALUES.shape, np.datetime64("2026-01-01T00:00:00")),
    "must hold numbers, in double precision": [[10**400, 1, 1], *VALUES[1:].tolist()],
}
DOORS = {
    "values": lambda x: mp.Readings(x, up=UP),
    "up": lambda x: mp.Readings(VALUES, up=x),
    "environment": lambda x: mp.Readings(VALUES, environment={"t": [row[0] for row in x]}),
    "compensate": CAL.compensate,
    "other columns": lambda x: CAL.compensate(VALUES, {"t": x}),
    "reading_sd": lambda x: mp.fit(READINGS, reading_sd=x),
    "simulate": lambda x: mp.simulate(CAL, "faces-6", reading_sd=x),
    "outputs": lambda x: mp.Readings(VALUES, outputs={"ax", "ay", "az"}),
}


@pytest.mark.parametrize("door", DOORS)
@pytest.mark.parametrize("said", HOSTILE)
def test_what_only_looks_like_numbers_is_refused(door, said):
    with pytest.raises((mp.MultiposError, mp.UsageError)) as raised:
        DOORS[door](HOSTILE[said])
    assert said in str(raised.value) or door in ("environment", "outputs")


def test_a_mask_that_hides_nothing_is_none():
    open_ = np.ma.array(VALUES, mask=False)
    assert mp.fit(mp.Readings(open_, up=UP, unit="g")) == CAL
    np.testing.assert_array_equal(CAL.compensate(open_), CAL.compensate(VALUES))


@pytest.mark.parametrize(
    "options",
    [{"nominal": 0}, {"range": 5}, {"range": (0, 10**400)}, {"range": "ab"}, {"gravity": "9.8"},
     {"confidence": "0.95"}, {"level_sd": "1"}, {"latitude": [1]}, {"outputs": {"ax", "ay", "az"}},
     {"outputs": 3}, {"exclude": 3}, {"reading_sd": "x"}],
)  # fmt: skip
def test_options_of_another_kind_are_said_in_words(options):
    with pytest.raises(mp.UsageError, match=f"--{next(iter(options)).replace('_', '-')}|names"):
        mp.fit(READINGS, **options)


def test_names_may_be_an_array():
    assert mp.Readings(VALUES, outputs=np.array(["ax", "ay", "az"])) == mp.Readings(VALUES)


def test_files_joined_of_files_have_several_byte_order_marks(tmp_path):
    mp.write_table(tmp_path / "one.csv", READINGS.columns())
    raw = (tmp_path / "one.csv").read_bytes()
    (tmp_path / "two.csv").write_bytes(b"\xef\xbb\xbf" * 2 + raw)
    two = mp.read_readings(tmp_path / "two.csv")
    np.testing.assert_array_equal(two.values, READINGS.values)


def test_what_unpacks_to_more_than_can_be_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(pipes.Unpacked.__init__, "__defaults__", (1 << 21, ""))
    (tmp_path / "zeros.csv.gz").write_bytes(gzip.compress(bytes(1 << 22)))
    with pytest.raises(mp.MultiposError, match="more than 2 MiB came, and no end"):
        mp.read_readings(tmp_path / "zeros.csv.gz")


def test_a_fit_of_unknown_orientations_is_the_same_from_its_file(tmp_path):
    free = mp.fit(mp.Readings(VALUES, unit="g"), unknown_orientation=True)
    free.save(tmp_path / "cal.json")
    again = mp.load(tmp_path / "cal.json")
    assert again.to_dict() == free.to_dict()
    assert again == free
