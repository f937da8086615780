"""Settings that all tests share."""

import os

# As the commands do: threads of linear algebra that wait for each other beside other processes
# take ten times the time. Said before NumPy is imported, which reads it once.
if not any(f"{name}_NUM_THREADS" in os.environ for name in ("OMP", "OPENBLAS", "MKL")):
    os.environ["OPENBLAS_NUM_THREADS"] = "1"

import pytest
from hypothesis import HealthCheck, settings

# Wall-clock never decides a test; on a shared machine the same examples are drawn every time.
settings.register_profile(
    "multipos",
    max_examples=20,  # a fault of units, order or edges shows in most of them
    deadline=None,
    derandomize="CI" in os.environ,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("multipos")


@pytest.fixture
def without_findings(monkeypatch: pytest.MonkeyPatch) -> None:
    """Findings change no number, and take as long as the fit: simulations of claims leave them."""
    for finds in ("examine", "_with_rolls"):
        monkeypatch.setattr(f"multipos.fitting.fit_readings.{finds}", lambda c, **_: c)
