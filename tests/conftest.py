"""Settings that all tests share."""

import os

from hypothesis import HealthCheck, settings

# Wall-clock never decides a test; on a shared machine the same examples are drawn every time.
settings.register_profile(
    "multipos",
    max_examples=40,  # a fault of units, order or edges shows in most of them
    deadline=None,
    derandomize="CI" in os.environ,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("multipos")
