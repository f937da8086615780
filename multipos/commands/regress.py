"""``multipos regress``."""

import argparse

from multipos.commands.answers import Answer, Output
from multipos.commands.options import names
from multipos.files.tables import Source
from multipos.files.trees import to_json
from multipos.fitting.regress_columns import regress
from multipos.plots.fits import regression_figure
from multipos.regression.observations import join_runs
from multipos.regression.regression import regression_sentence

INPUTS = ("data",)
OUTPUT = Output(
    "REGRESSION.json", "write the result to REGRESSION.json", "json", ("figure", "text")
)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add = parser.add_argument
    add(
        "data",
        nargs="+",
        metavar="DATA.csv",
        help="table with a row per reading; of several each is a run, as with --run",
    )
    add(
        "--response",
        required=True,
        type=names,
        metavar="Y[,Y,Y]",
        help="column to describe; several are described one by one",
    )
    add(
        "--variables",
        type=names,
        metavar="A,B,C",
        help="columns to describe it by; X_rate is "
        "formed from X and the time column where it is no column",
    )
    add("--degree", type=int, metavar="D", help="all products up to this degree (default 1)")
    add("--terms", metavar="FORMULA", help='terms instead, such as "1 + A + A^2 + A*B"')
    add("--drop-missing", action="store_true", help="leave out rows with an empty cell")
    add(
        "--confidence",
        type=float,
        default=0.95,
        metavar="P",
        help="of the critical F (default 0.95)",
    )
    _add_selection(parser.add_argument_group("choosing the terms"))
    _add_segments(parser.add_argument_group("segments"))
    _add_time(parser.add_argument_group("time"))


def _add_selection(group: argparse._ArgumentGroup) -> None:
    add = group.add_argument
    add("--stepwise", action="store_true", help="forward with removal, from the constant")
    add("--backward", action="store_true", help="remove from the full model")
    add("--subsets", action="store_true", help="the best of all subsets")
    add("--enter", type=float, metavar="P", help="p below which a term enters (default .05)")
    add("--remove", type=float, metavar="P", help="p above which it goes (default .10)")
    add("--f-enter", type=float, metavar="F", help="F above which a term enters, instead")
    add("--f-remove", type=float, metavar="F", help="F below which it goes, instead")
    add(
        "--criterion",
        default="aicc",
        metavar="C",
        help="of --subsets: aicc (default), bic or adjusted_r2",
    )
    add("--hierarchy", action="store_true", help="T before T^2, A and B before A*B")
    add(
        "--cross-validate",
        type=int,
        metavar="K",
        help="check by leaving out each of K blocks of time",
    )


def _add_segments(group: argparse._ArgumentGroup) -> None:
    add = group.add_argument
    add("--segment", metavar="VARIABLE:EDGE,…|auto", help="a model for each range of a variable")
    add("--min-rows", type=int, metavar="N", help="fewest rows of a segment that auto finds")
    add("--free", action="store_true", help="each segment by itself, with jumps at the edges")
    add("--continuous", action="store_true", help="no jump at the edges (default)")
    add(
        "--branches",
        metavar="RATE",
        help="separate models for heating and cooling, where they differ",
    )


def _add_time(group: argparse._ArgumentGroup) -> None:
    add = group.add_argument
    add("--time", metavar="COLUMN", help="time column (default time, where there is one)")
    add(
        "--rate-window",
        type=float,
        metavar="W",
        help="width of the smoothed derivative, in the unit of time (default 20 rows)",
    )
    add("--causal", action="store_true", help="rates from past rows only, as the exported C has")
    add("--run", metavar="COLUMN", help="column that numbers the switch-ons")
    add(
        "--robust",
        default="hac",
        metavar="hac|effective",
        help="F_robust by the covariance of correlated rows (default) or their number",
    )
    add("--cluster", metavar="COLUMN", help="rows of equal value here belong together")


def run(arguments: argparse.Namespace) -> Answer:
    """Return what the command found."""
    options = {k: v for k, v in vars(arguments).items() if k not in ("data", "json", "output")}
    data: Source
    if len(arguments.data) > 1:
        data, options["run"] = join_runs(arguments.data, options["run"])
    else:
        (data,) = arguments.data
    regression = regress(data, **options)
    return Answer(
        sentence=lambda: regression_sentence(regression),
        text=lambda: f"{regression}\n",
        json=lambda: to_json(regression.to_dict()),
        forms={"figure": lambda: regression_figure(regression, data)},
        findings=lambda: regression.findings,
    )
