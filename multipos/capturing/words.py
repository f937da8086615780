"""A pose in words, which axis points up, how far the case leans; and what is said, in Chinese.

Of the direction up, u in case axes, the largest component names the axis to point up. What is left
is a lean by acos|u_largest| towards the axes that rise with it.
"""

import math
from functools import lru_cache

from multipos.numerics.arrays import Array
from multipos.reports.translations import Translator

_LEVEL_DEG = 3.0  # nothing a hand can tell
_SMALL_SHARE = 0.35  # of the lean, below which an axis is not named


def pose_words(up: Array) -> dict[str, str]:
    """Return the words for a pose, by language: "+z up, leaning 35° towards −x"."""
    main = max(range(3), key=lambda i: abs(round(float(up[i]), 9)))
    lean = math.degrees(math.acos(min(1.0, abs(float(up[main])))))
    axis = _axis(main, float(up[main]))
    if lean < _LEVEL_DEG:
        return {"en": f"{axis} straight up", "zh": f"{axis} 轴竖直向上"}
    rest = [i for i in range(3) if i != main]
    size = math.hypot(*(float(up[i]) for i in rest))
    named = [i for i in rest if abs(float(up[i])) >= _SMALL_SHARE * size]
    named.sort(key=lambda i: -abs(round(float(up[i]), 9)))
    risen = [_axis(i, float(up[i])) for i in named]
    return {
        "en": f"{axis} up, leaning {lean:.0f}° so that {' and '.join(risen)} rises"
        if len(risen) == 1
        else f"{axis} up, leaning {lean:.0f}° so that {' and '.join(risen)} rise",
        "zh": f"{axis} 轴向上，倾斜 {lean:.0f}°，使 {'、'.join(risen)} 抬高",
    }


@lru_cache(1024)
def chinese(text: str) -> str:
    """Return what a session says of poses and of the fit, in Chinese."""
    return Translator("zh").message(text)


def _axis(i: int, value: float) -> str:
    return f"{'+' if value >= 0.0 else '−'}{'xyz'[i]}"
