"""Validation by blocks of time: what a model is worth on data it has not seen.

Leaving out single rows of a log proves nothing, since the neighbours that stay know the answer. So
the rows are cut into consecutive blocks of time; each is predicted by a model whose terms were
chosen and fitted on the other blocks alone,

    rms_cv² = Σ (y_k − ŷ_k without the block of k)² / n,       R²_cv = 1 − n rms_cv² / Σ (y − ȳ)².

Edges that were found stay where they are: they are not judged by this.

Sources: P. Burman, E. Chow, D. Nolan, Biometrika 81, 1994 (blocks for dependent data).
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from multipos.errors import MultiposError
from multipos.regression.observations import Data
from multipos.regression.result import Regression


def check_by_blocks(data: Data, blocks: int, fit: Callable[[Data], Regression]) -> dict[str, Any]:
    """Return {blocks, rms, r2, rms_of_blocks} of predictions of blocks left out in turn.

    Parameters
    ----------
    data : Data
        Rows in the order of time where they have one, else as they stand.
    blocks : int
    fit : function
        Chooses and fits a model on some of the rows.

    Raises
    ------
    MultiposError
        There are fewer rows than blocks, or a model cannot be fitted without one of them.
    """
    if blocks > len(data):
        raise MultiposError(
            f"--cross-validate {blocks} takes a row or more a block, but there are {len(data)} "
            "rows; give fewer blocks."
        )
    order = np.arange(len(data)) if data.order is None else data.order.order
    errors = np.empty(len(data))
    parts = np.array_split(order, blocks)
    for number, left_out in enumerate(parts, start=1):
        kept = np.setdiff1d(np.arange(len(data)), left_out)
        try:
            model = fit(data.take(kept))
        except MultiposError as error:
            raise MultiposError(
                f"--cross-validate, without block {number} of {blocks}: {error}"
            ) from None
        unseen = {name: column[left_out] for name, column in data.columns.items()}
        errors[left_out] = data.response[left_out] - model.predict(unseen)
    total = float(((data.response - data.response.mean()) ** 2).sum())
    return {
        "blocks": blocks,
        "rms": float(np.sqrt(np.mean(errors**2))),
        # A response that never changes, told without an intercept, has nothing to compare with.
        "r2": 1.0 - float((errors**2).sum()) / total if total > 0.0 else np.nan,
        "rms_of_blocks": [float(np.sqrt(np.mean(errors[part] ** 2))) for part in parts],
    }
