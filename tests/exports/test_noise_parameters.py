"""Noise parameters of a static record, as Kalibr and ROS define them."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

import multipos as mp
from multipos import cli
from multipos.errors import MultiposError, UsageError
from multipos.exports import target_matrices

RATE, SD = 50.0, 2e-3  # [Hz], of one sample [g]


@pytest.fixture(scope="module")
def stability():
    rng = np.random.default_rng(2)
    record = {"time": np.arange(20000) / RATE}
    record |= {f"a{axis}": SD * rng.standard_normal(20000) for axis in "xyz"}
    return mp.stability(record, unit="g")


def values(text):
    lines = (line.partition("#")[0].partition(":") for line in text.splitlines())
    return {key: json.loads(value) for key, _, value in lines if key}


def test_kalibr_takes_densities_in_metres(stability):
    # eq. (2) of exports.target_matrices
    found = values(mp.export(stability, to="kalibr").text)
    # white noise of one sample: N = sd/√f; 20,000 samples know it to a percent or so
    density = SD * 9.80665 / np.sqrt(RATE)
    assert found["accelerometer_noise_density"] == pytest.approx(density, rel=0.05)
    assert found["update_rate"] == pytest.approx(RATE)
    assert 0.0 <= found["accelerometer_random_walk"] < density / 10.0


def test_ros_takes_the_variance_of_one_message(stability):
    # eq. (3) of exports.target_matrices
    found = values(mp.export(stability, to="ros").text)
    covariance = np.array(found["linear_acceleration_covariance"]).reshape(3, 3)
    np.testing.assert_allclose(np.diag(covariance), (SD * 9.80665) ** 2, rtol=0.1)
    assert (covariance == np.diag(np.diag(covariance))).all()
    assert found["orientation_covariance"][0] == found["angular_velocity_covariance"][0] == -1.0


def test_the_command_reads_the_file(stability, tmp_path):
    stability.save(tmp_path / "s.json")
    out = tmp_path / "imu.yaml"
    assert cli.main(["export", str(tmp_path / "s.json"), "--to", "kalibr", "-o", str(out)]) == 0
    assert out.read_text("utf-8") == mp.export(stability, to="kalibr").text


def test_counts_and_other_targets_are_refused(stability):
    with pytest.raises(UsageError, match="kalibr or ros"):
        mp.export(stability, to="px4")
    record = {"time": np.arange(2000) / RATE, "ax": np.random.default_rng(1).normal(size=2000)}
    with pytest.raises(MultiposError, match="--calibration"):
        mp.export(mp.stability(record, unit="count"), to="kalibr")


@pytest.mark.parametrize("to", ["kalibr", "ros"])
def test_a_density_of_zero_is_none(to):
    """A random walk, sampled, has no white noise: 0 would be no noise at all, or unknown in ROS."""
    walk = np.cumsum(np.random.default_rng(1).standard_normal((6000, 3)), axis=0)
    log = {"time": np.arange(6000) / 100.0, **dict(zip(("ax", "ay", "az"), walk.T, strict=True))}
    found = mp.stability(log, unit="g")
    assert min(each.white_noise.value for each in found.outputs.values()) == 0.0
    with pytest.raises(mp.MultiposError, match=r"hides the white noise of 'a[xyz]'.*at rest"):
        mp.export(found, to=to)


def test_densities_of_raw_outputs_are_turned_into_metres_by_the_calibration(monkeypatch):
    """At 2 V a g: 4e-3 V/√Hz and 6e-5 V/s/√Hz are 2e-3 and 3e-5 of g, of the noisiest output."""
    monkeypatch.setattr(target_matrices, "in_metres", lambda calibration, to: 9.80665 / 2.0)
    of = {"ax": (4e-3, 1e-5), "ay": (1e-3, 6e-5), "f_x": (4e-3, 1e-5)}
    laws = {
        name: SimpleNamespace(
            white_noise=SimpleNamespace(value=N), random_walk=SimpleNamespace(value=K)
        )
        for name, (N, K) in of.items()
    }
    calibration = SimpleNamespace(outputs=("ax", "ay"), model=SimpleNamespace(unit="V"))
    record = SimpleNamespace(outputs={name: laws[name] for name in ("ax", "ay")}, unit="V")
    found = target_matrices.densities(calibration, record)
    assert found == pytest.approx((2e-3 * 9.80665, 3e-5 * 9.80665))
    for outputs, unit in ((record.outputs, "mV"), ({"f_x": laws["f_x"]}, "V")):
        other = SimpleNamespace(outputs=outputs, unit=unit)
        with pytest.raises(MultiposError, match=f"stability is in '{unit}'"):
            target_matrices.densities(calibration, other)
