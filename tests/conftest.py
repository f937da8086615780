"""Settings that all tests share."""

import gc
import os
import pickle
from typing import Any

# As the commands do: threads of linear algebra that wait for each other beside other processes
# take ten times the time. Said before NumPy is imported, which reads it once.
if not any(f"{name}_NUM_THREADS" in os.environ for name in ("OMP", "OPENBLAS", "MKL")):
    os.environ["OPENBLAS_NUM_THREADS"] = "1"

import pytest
from hypothesis import HealthCheck, settings

gc.disable()  # what collecting makes stays: there is no rubbish to look for


def pytest_collection_finish() -> None:
    """Leave what all tests share out of what each collection of rubbish looks through."""
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)  # rubbish is little, and each look for it walks all results
    gc.enable()


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Say how long the tests took of all processors together, what they started included."""
    terminalreporter.write_line(f"CPU time of the tests: {sum(os.times()[:4]):.0f} s")


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


_OPTIMA: dict[bytes, Any] = {}


@pytest.fixture
def optima_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Find the optimum of a setting once: a design is judged by the same three again and again."""
    from multipos.designs import assessment, designing, optimum

    def found(*what: Any, **options: Any) -> Any:
        key = pickle.dumps((what, options))
        if key not in _OPTIMA:
            _OPTIMA[key] = optimum.optimise_sphere(*what, **options)
        return _OPTIMA[key]

    monkeypatch.setattr(assessment, "optimise_sphere", found)
    monkeypatch.setattr(designing, "optimise_sphere", found)


@pytest.fixture
def without_drawing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures are made but not drawn, which takes half the time of a report: words need none."""
    drawn = '<svg width="1" height="1" xmlns="http://www.w3.org/2000/svg"></svg>'
    monkeypatch.setattr("multipos.plots.style.to_svg", lambda figure, words=str: drawn)
