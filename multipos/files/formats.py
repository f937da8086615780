"""What calibration, regression and check files hold, key by key; `multipos.files.records` says how.

What a result derives again when it is read (its rms, the labels of its parameters, the summary of a
check) is not read and not described here; what every key means is in `docs/reference/formats`.
"""

from multipos.files.records import (
    ANY_NUMBER,
    ANY_TEXT,
    INPUT,
    LARGEST_SQUARE,
    NOT_NEGATIVE,
    POSITIVE,
    SHARE,
    TEXTS,
    AnyOf,
    Entries,
    Fields,
    Flag,
    Kind,
    Listed,
    Maybe,
    Named,
    Number,
    Numbers,
    Text,
    Whole,
)
from multipos.numerics.terms import COMPONENTS

_AXIS = Text(COMPONENTS)
_VARIANCES = Numbers(2, gaps=True, low=-LARGEST_SQUARE, high=LARGEST_SQUARE)
# Null is infinite, 0 none; less than a millionth of one is neither.
_DOF = Maybe(AnyOf((Number(0.0, 0.0), Number(1e-6))))
_FIGURE = Maybe(Number(-LARGEST_SQUARE, LARGEST_SQUARE))  # a statistic; null where there is none
_P = Maybe(Number(0.0, 1.0))
_SETTING = AnyOf((ANY_TEXT, Flag(), Listed(Whole()), ANY_NUMBER))  # of a table in a budget

# One number a position, or one an output as well where the outputs were fitted apart.
_BY_POSITION = AnyOf((Numbers(2, gaps=True), Numbers(1, gaps=True)))
_TESTED = Fields({"term": ANY_TEXT, "F": _FIGURE, "p": _P})

CALIBRATION = Fields(
    {
        "multipos_version": ANY_TEXT,
        "created": ANY_TEXT,
        "input": INPUT,
        "convention": Text(("specific-force", "gravity")),
        "gravity": Maybe(Fields({"value": Number(1.0, 100.0), "u": NOT_NEGATIVE})),
        "estimator": Text(
            ("closed-form", "linear", "uncertain-orientation", "unknown-orientation")
        ),
        "criterion": ANY_TEXT,
        "gauge": Maybe(Text(("lower", "symmetric"))),
        "model": ANY_TEXT,
        "outputs": Listed(ANY_TEXT, 1),
        "axes": Listed(_AXIS, 1),
        "inputs": Listed(_AXIS, 1, len(COMPONENTS)),
        "unit": ANY_TEXT,
        "confidence": SHARE,
        "status": Fields(
            {"converged": Flag(), "iterations": Whole(), "message": ANY_TEXT},
            {"last_step": Maybe(ANY_NUMBER), "gradient": Maybe(ANY_NUMBER)},
        ),
        "positions": Listed(ANY_TEXT, 1),
        "parameters": Listed(
            Fields(
                {
                    "output": ANY_TEXT,
                    "term": ANY_TEXT,
                    "value": ANY_NUMBER,
                    "u": Maybe(NOT_NEGATIVE),
                    "dof": _DOF,
                    "k": Maybe(NOT_NEGATIVE),
                }
            ),
            1,
        ),
        "covariance": _VARIANCES,
        "residuals": Numbers(2),
        "residual_sd": Named(Maybe(NOT_NEGATIVE)),
        "dof": Named(_DOF),
        "readings": Numbers(2),
        "reference": Numbers(2),
        "diagnostics": Fields(
            {
                "rank": Whole(),
                "parameters": Whole(),
                "condition": _FIGURE,
                "leverage": Numbers(2, gaps=True),
                "lack_of_fit": Named(
                    Fields({"F": _FIGURE, "dof": Maybe(Numbers(1)), "p": _P}),
                ),
                "outliers": TEXTS,
                "unidentifiable": TEXTS,
                "warnings": TEXTS,
            }
        ),
        "cross_check": Maybe(Fields({"closed_form_max_difference": ANY_NUMBER})),
    },
    {
        "reading_u": Numbers(2),
        "reading_covariance": Numbers(2, low=-LARGEST_SQUARE, high=LARGEST_SQUARE),
        "reading_sd": Numbers(2),
        "samples": Numbers(1),
        "orientation_sd_deg": Numbers(1, gaps=True),
        "group": TEXTS,
        "environment": Named(Numbers(1, gaps=True)),
        "attitude": Numbers(3, gaps=True),
        "up": Numbers(2, gaps=True),
        "robust_weight": _BY_POSITION,
        "orientation_error_deg": _BY_POSITION,
        "group_rotation_deg": Named(Listed(ANY_NUMBER, 3, 3)),
        "level_sd_deg": NOT_NEGATIVE,
        "level_tilt_deg": Numbers(1),
        "variance_components": Named(Fields({"value": POSITIVE, "u": POSITIVE})),
        "selection": Named(
            Fields(
                {
                    "terms": Listed(ANY_TEXT, 1),
                    "path": Listed(_TESTED),
                    "runner_up": Maybe(_TESTED),
                    "collinear": TEXTS,
                }
            )
        ),
        "budget": Fields(
            {
                "tables": Named(Named(_SETTING)),
                "rows": Listed(Fields({"quantity": ANY_TEXT, "contribution": Named(_FIGURE)})),
            },
            {"scatter": _VARIANCES},
        ),
        "expression": Fields(
            {
                "functions": Listed(Listed(Listed(AnyOf((ANY_TEXT, ANY_NUMBER)), 2), 1), 1),
                "columns": TEXTS,
                "parameters": Listed(ANY_TEXT, 1),
            }
        ),
    },
)

_PAIR = Listed(ANY_NUMBER, 2, 2)
_FUNCTION = AnyOf((ANY_TEXT, Flag()))  # which are known is said in `numerics.factors`
_POWER = Whole(0, 300)  # a power is so many multiplications in every row
_STEP: dict[str, Kind] = {
    "action": Text(("add", "remove")),
    "term": ANY_TEXT,
    "F": _FIGURE,
    "p": _P,
}

REGRESSION = Fields(
    {
        "multipos_version": ANY_TEXT,
        "created": ANY_TEXT,
        "input": INPUT,
        "response": ANY_TEXT,
        "variables": TEXTS,
        "candidates": TEXTS,
        "method": Text(("full", "stepwise", "backward", "subsets")),
        "thresholds": Named(ANY_NUMBER),
        "confidence": SHARE,
        "n": Whole(1),
        "dropped": Whole(),
        "segment_variable": Maybe(ANY_TEXT),
        "edges": Listed(ANY_NUMBER),
        "continuous": Flag(),
        "branch_column": Maybe(ANY_TEXT),
        "time": Maybe(ANY_TEXT),
        "rates": Named(POSITIVE),
        "hysteresis": Maybe(
            Fields(
                {
                    "column": ANY_TEXT,
                    "F": _FIGURE,
                    "dof": _PAIR,
                    "p": _P,
                    "significant": Flag(),
                }
            )
        ),
        "cross_validation": Maybe(
            Fields({"blocks": Whole(1), "rms": NOT_NEGATIVE, "r2": ANY_NUMBER})
        ),
        "warnings": TEXTS,
        "segments": Listed(
            Fields(
                {
                    "range": _PAIR,
                    "branch": Maybe(Text(("heating", "cooling"))),
                    "n": Whole(),
                    "terms": Listed(
                        Fields(
                            {
                                "value": ANY_NUMBER,
                                "u": Maybe(NOT_NEGATIVE),
                                "factors": Listed(Entries((ANY_TEXT, _POWER, _FUNCTION))),
                            }
                        )
                    ),
                    "covariance": _VARIANCES,
                    "r2": _FIGURE,
                    "adjusted_r2": _FIGURE,
                    "rms": Maybe(NOT_NEGATIVE),
                    "aicc": _FIGURE,
                    "press": Maybe(NOT_NEGATIVE),
                    "F": _FIGURE,
                    "F_critical": _FIGURE,
                    "p": _P,
                    "dof": Listed(Whole(), 2, 2),
                    "significant": Flag(),
                    "path": Listed(
                        Fields(
                            {
                                "step": Whole(),
                                **_STEP,
                                "dof": Whole(),
                                "runner_up": Maybe(Fields(_STEP)),
                                "tested": Listed(Fields(_STEP)),
                            }
                        )
                    ),
                    "runner_up": Maybe(
                        Fields({"term": ANY_TEXT, "F": _FIGURE, "p": _P, "F_to_enter": _FIGURE})
                    ),
                    "collinear": TEXTS,
                    "limits": Named(_PAIR),
                },
                {
                    "subsets": Listed(
                        Fields(
                            {
                                "terms": TEXTS,
                                "rss": _FIGURE,
                                "r2": _FIGURE,
                                "adjusted_r2": _FIGURE,
                                "aicc": _FIGURE,
                                "bic": _FIGURE,
                            }
                        )
                    ),
                    "robust": Text(("hac", "cluster", "effective")),
                    "covariance_robust": _VARIANCES,
                    "F_robust": _FIGURE,
                    "p_robust": _P,
                    "dof_robust": Listed(_FIGURE, 2, 2),
                    "t_dof_robust": _FIGURE,
                    "n_effective": ANY_NUMBER,
                    "lag_one": ANY_NUMBER,
                },
            ),
            1,
        ),
    }
)

_BY_AXIS = Named(ANY_NUMBER)
_BY_AXIS_OR_NONE = Named(Maybe(ANY_NUMBER))
_LINEARITY = Fields({"linearity_percent": Maybe(NOT_NEGATIVE)})

CHECK = Fields(
    {
        "input": INPUT,
        "calibration": ANY_TEXT,
        "quantity": Text(("force", "tilt")),
        "unit": Text(("g", "deg")),
        "limit": Maybe(POSITIVE),
        "confidence": SHARE,
        "nominal": Fields({"bias": ANY_NUMBER, "scale": ANY_NUMBER}),
        "axes": Listed(_AXIS, 1, len(COMPONENTS)),
        "positions": Listed(
            Fields(
                {
                    "position": ANY_TEXT,
                    "reference": _BY_AXIS,
                    "before": _BY_AXIS_OR_NONE,
                    "after": _BY_AXIS_OR_NONE,
                    "u": _BY_AXIS_OR_NONE,
                    "U": _BY_AXIS_OR_NONE,
                    "counted": Named(Flag()),
                }
            ),
            1,
        ),
        "by_axis": Named(Fields({"before": _LINEARITY, "after": _LINEARITY})),
        "warnings": TEXTS,
    }
)
