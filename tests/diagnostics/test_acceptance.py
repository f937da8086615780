"""What is not fit for use is not passed on, unless it is accepted; then it says so."""

import pytest
from consumers import read_back

import multipos as mp
from tests.cli_bench import SIX, run
from tests.diagnostics.test_gross_errors import sense


@pytest.fixture(scope="module")
def absurd():
    up = mp.read_scheme("all-26").up
    values = sense(up)
    values[:, 0] *= -1.0
    return mp.fit(mp.Readings(values, up=up, unit="g"))


@pytest.mark.parametrize("to", ["c", "px4", "ros-imu-calib", "ardupilot"])
def test_an_export_is_refused_and_says_what_was_accepted(absurd, to):
    with pytest.raises(mp.MultiposError, match=r"not fit for use: 'ax' decreases.*--force"):
        mp.export(absurd, to)
    made = mp.export(absurd, to, force=True, allow_lossy=True)
    assert "EXPORTED WITH --force" in made.text
    assert "sign: 'ax' decreases" in made.text
    assert "ACCEPTED" not in mp.export(good(), to, force=True, allow_lossy=True).text


def good():
    up = mp.read_scheme("all-26").up
    return mp.fit(mp.Readings(sense(up), up=up, unit="g"))


def test_what_was_accepted_is_read_back(absurd, tmp_path):
    (file,) = mp.export(absurd, "px4", force=True, allow_lossy=True).save(tmp_path / "p")
    assert read_back(file, absurd).rms < 0.1


def test_the_command_refuses_and_accepts(tmp_path, capsys):
    path, cal, out = tmp_path / "six.csv", tmp_path / "cal.json", tmp_path / "cal.c"
    rows = [row.split(",") for row in SIX.splitlines()]
    path.write_text("\n".join(",".join([*r[:2], r[3], r[2], r[4]]) for r in rows[1:]))
    path.write_text("position,direction,ax,ay,az\n" + path.read_text())
    assert run(capsys, "fit", path, "-o", cal)[0] == 3
    status, said, err = run(capsys, "export", cal, "--to", "c", "-o", out)
    assert (status, said, out.exists()) == (1, "", False)
    assert err.splitlines()[-1].startswith("multipos: error: the export to c is refused")
    assert run(capsys, "export", cal, "--to", "c", "--force", "-o", out)[0] == 0
    assert "permuted-outputs: outputs are interchanged" in out.read_text()


def test_calibrate_writes_the_calibration_and_refuses_the_export(tmp_path, capsys):
    up = mp.read_scheme("faces-6").up
    true = mp.fit(mp.Readings(9.8 * sense(up), up=up, unit="m/s^2"))
    log = tmp_path / "log.csv"
    mp.write_table(log, mp.simulate_log(true, "faces-6", sample_sd=1e-3, seed=1))
    cal = tmp_path / "cal.json"
    options = ("calibrate", log, "--scheme", "faces-6", "--to", "px4", "--allow-lossy")
    options += ("--unit", "g", "-o", cal)
    status, _, err = run(capsys, *options)
    assert (status, cal.exists(), (tmp_path / "cal_px4.params").exists()) == (1, True, False)
    assert "--force" in err
    assert run(capsys, *options, "--force")[0] == 3
    assert "EXPORTED WITH --force" in (tmp_path / "cal_px4.params").read_text()
