"""Regressions of several responses, one for each axis, on the same columns."""

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

from multipos.doubt import Doubt
from multipos.files.trees import to_json
from multipos.files.whole import write_text
from multipos.regression.result import Regression
from multipos.results import Result, Tabular, stacked


@dataclass(frozen=True, eq=False)
class Regressions(Result, Tabular, Mapping[str, Regression]):
    """Regressions by the response that each describes: ``found["error_x"]``.

    Attributes
    ----------
    responses : mapping of str to Regression

    Examples
    --------
    >>> import numpy as np
    >>> import multipos as mp
    >>> T = np.linspace(-20.0, 60.0, 81)
    >>> hum = 1e-4 * np.sin(7.0 * T)
    >>> table = {"T": T, "zero_x": 0.01 + 5e-4 * T + hum, "zero_y": 0.02 - 1e-4 * T + hum}
    >>> found = mp.regress(table, response="zero_x,zero_y", variables="T")
    >>> list(found.responses), found["zero_x"].response
    (['zero_x', 'zero_y'], 'zero_x')
    """

    responses: Mapping[str, Regression]

    def __getitem__(self, response: str) -> Regression:
        return self.responses[response]

    def __iter__(self) -> Iterator[str]:
        return iter(self.responses)

    def __len__(self) -> int:
        return len(self.responses)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What there is to say, each with its response."""
        return tuple(f"{name}: {said}" for name, r in self.items() for said in r.warnings)

    @property
    def doubts(self) -> tuple[Doubt, ...]:
        """The doubts about each, with its response before the text."""
        return tuple(
            replace(doubt, text=f"{name}: {doubt.text}")
            for name, r in self.items()
            for doubt in r.doubts
        )

    def columns(self) -> dict[str, Any]:
        """Return the terms of every regression: response, then as of one."""
        return stacked("response", {name: r.columns() for name, r in self.items()})

    def to_dict(self) -> dict[str, Any]:
        """Return everything as what JSON can carry, keys as in the formats reference."""
        # Imported here, for the file's module makes regressions and so imports this one.
        from multipos.regression.regression_file import SCHEMA

        return {"schema": SCHEMA, "responses": {name: r.to_dict() for name, r in self.items()}}

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the regressions as JSON, whole or not at all."""
        write_text(path, to_json(self.to_dict()))

    def __str__(self) -> str:
        return "\n\n".join(str(r) for r in self.values())


def all_of(regression: Regression | Regressions) -> tuple[Regression, ...]:
    """Return the regressions, one or several."""
    return (regression,) if isinstance(regression, Regression) else tuple(regression.values())
