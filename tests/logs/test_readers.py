"""A format of logs is one entry in the list of readers."""

import struct
from pathlib import Path

import numpy as np
import pytest

import multipos as mp
from multipos.cli import command_parser
from multipos.logs import readers
from multipos.logs.opening import open_log
from multipos.logs.readers import READERS, _undo

PAGE = Path(__file__).resolve().parents[2] / "docs" / "reference" / "logs.md"


def test_every_format_is_on_the_page():
    page = PAGE.read_text(encoding="utf-8")
    for reader in READERS:
        assert not reader.listed or all(f"`{suffix}`" in page for suffix in reader.suffixes)


def test_a_new_format_is_one_entry(tmp_path, monkeypatch):
    def read_counts(path):
        return {"counts": np.frombuffer(Path(path).read_bytes()[4:], "<i2").reshape(-1, 3)}

    known = (*READERS, readers.Reader(".cnt", (".cnt",), b"CNT\0", read_counts))
    monkeypatch.setattr(readers, "READERS", known)
    (tmp_path / "log.cnt").write_bytes(b"CNT\0" + struct.pack("<6h", 1, 2, 3, -4, -5, -6))
    log = open_log(tmp_path / "log.cnt")
    assert log.columns == ("counts_x", "counts_y", "counts_z")
    (piece,) = log.read(log.columns, ())
    assert piece.table.columns["counts_z"].tolist() == [3.0, -6.0]
    (tmp_path / "strange").write_bytes(b"ax\0ay\n")
    with pytest.raises(mp.MultiposError, match=r"\.mcap, \.cnt\)"):
        open_log(tmp_path / "strange")
    assert ".cnt" in command_parser("average").format_help()


def test_a_text_among_the_numbers_of_an_array_is_named(tmp_path):
    cells = np.array(["1.0", "0.5", "1.0005e-", "0.1"])
    numbers = {name: np.linspace(0.0, 1.0, 4) for name in ("ay", "az")}
    from scipy.io import savemat

    savemat(tmp_path / "log.mat", {"ax": cells[:, None], **numbers})
    with pytest.raises(mp.MultiposError, match=r"'1\.0005e-' is not a number"):
        list(open_log(tmp_path / "log.mat").read(("ax", "ay", "az"), ()))


@pytest.mark.parametrize(
    ("parameters", "x", "said"),
    [
        ({"INS_ACCOFFS_X": 0.5, "INS_ACCSCAL_X": 2.0}, 5.5, "are undone"),
        ({"INS_ACCOFFS_X": 0.5}, 10.5, "are undone"),
        ({"INS_ACCSCAL_X": 2.0, "AHRS_ORIENTATION": 4.0}, 10.0, "are not undone"),
        ({"INS_ACCSCAL_X": 0.0}, 10.0, "are not undone"),
        ({}, 10.0, "the first of the log"),
    ],
)
def test_what_an_autopilot_corrected_is_undone(parameters, x, said):
    """ArduPilot flies on (raw − offset) scale."""
    found = {f"Acc{axis}": np.array([10.0]) for axis in "XYZ"}
    (text,) = _undo(found, parameters)
    assert text.endswith(said)
    assert [found[f"Acc{axis}"][0] for axis in "XYZ"] == [x, 10.0, 10.0]
