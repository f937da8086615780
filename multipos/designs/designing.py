"""Schemes made: the best positions for a model on a bench, with the proof.

`design` makes a `Design`, and `smaller_designs` those of fewer positions beside one. `design_text`
prints it, `design_csv` writes it as a scheme file, and `design_sentence` says how good it is.
`begin_design` returns the setting of its options: where a calibration is included, that has u of
its parameters before and after (`multipos.designs.prospects`).

The continuous optimum (`multipos.designs.optimum`) says what N positions could tell at most, its
certificate how sure that is; exchange and polish (`multipos.designs.exchange`) find N positions
that come near. The efficiency of a design is per position, against the optimum on the whole sphere:
on a bench with few positions it also says what the bench costs.
"""

import math
import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from multipos.designs import assessment
from multipos.designs.assessment import orientation
from multipos.designs.criteria import Criterion, kernels, make_criterion, sensitivity
from multipos.designs.exchange import choose, polish
from multipos.designs.information import Setting, inform, log_det, nothing_to_weigh
from multipos.designs.optimum import (
    ContinuousOptimum,
    largest_sensitivity,
    optimise_candidates,
    optimise_sphere,
)
from multipos.designs.prospects import Begun, begin_otherwise, information_of
from multipos.errors import MultiposError, RankError, UsageError
from multipos.files.numbers import number, table
from multipos.files.spelling import Names
from multipos.files.tables import Source, format_csv
from multipos.files.trees import read_schema
from multipos.finding import Findings
from multipos.numerics.arrays import COMPONENTS, Array, Places
from multipos.numerics.separability import join_combinations
from multipos.numerics.terms import ModelText
from multipos.positions.benches import bench_settings, read_bench, read_once
from multipos.positions.order import Order, check_order, lay_out, travel_deg, travel_order
from multipos.positions.scheme import Scheme, read_scheme
from multipos.results import Drawn, Keyed, Tabular, frozen
from multipos.sensor.calibration import Calibration
from multipos.sensor.calibration_file import load
from multipos.sensor.model import Model


@frozen
class Design(Keyed, Drawn, Tabular):
    """The best positions for a model on a bench, with the proof.

    Attributes
    ----------
    model, orientation, criterion : str
    positions : (n, 3) array
        Unit vectors pointing up: included ones first, the others as they are laid out.
    included : int
    u : tuple of mappings
        {output, term, name, unit, before, after} of each parameter, where a calibration is
        included: its standard uncertainty with the included positions, and with all.
    towards : str
        What the positions point along: 'up', or 'field' of a magnetometer.
    log_det, optimum_log_det : float
        Of these positions, and of the D-optimum on the sphere.
    efficiency : float
        Against the best on the whole sphere.
    certificate : mapping
        {max_variance, parameters, gap, over: 'sphere' or 'candidates'} of the best that could be.
    optimum : mapping
        {positions, weights} of the best that could be.
    bench_efficiency : float or None
        Against the best on the candidates; None for criteria E and G.
    travel_deg : float
    time_s : float or None
    scheme : Assessment
        What the positions tell.
    settings : tuple of mappings
        How the bench that was given is set at each position, in its own words; empty where it has
        none (`multipos.positions.scheme`).
    findings : tuple of Finding
    """

    model: str
    orientation: str
    criterion: str
    positions: Array
    included: int
    log_det: float | None
    optimum_log_det: float
    efficiency: float
    certificate: Mapping[str, Any]
    optimum: Mapping[str, Any]
    bench_efficiency: float | None
    travel_deg: float
    time_s: float | None
    scheme: assessment.Assessment
    settings: tuple[Mapping[str, Any], ...] = ()
    u: tuple[Mapping[str, Any], ...] = ()
    towards: str = "up"
    findings: Findings = ()

    @property
    def labels(self) -> tuple[str, ...]:
        """The label that the bench gives each position, numbered where one comes again."""
        labels: list[str] = []
        for place in range(len(self.positions)):
            setting = self.settings[place] if self.settings else {}
            label = str(setting.get("position", place + 1))
            again = 2
            while label in labels:
                label = f"{setting.get('position', place + 1)} ({again})"
                again += 1
            labels.append(label)
        return tuple(labels)

    def columns(self) -> dict[str, Any]:
        """Return the positions as the columns of a scheme file, those of the bench behind them."""
        up = {f"up_{axis}": self.positions[:, i] for i, axis in enumerate(COMPONENTS)}
        bench = {f"bench_{n}": [str(s.get(n, "")) for s in self.settings] for n in self._set_by}
        return {"position": list(self.labels), **up, **bench}

    @property
    def _set_by(self) -> tuple[str, ...]:
        """What the bench is set by, as the settings name it."""
        return tuple(dict.fromkeys(n for s in self.settings for n in s if n != "position"))


def design_text(found: Design) -> str:
    """Return `design` as text: the positions, what they tell, and the certificate."""
    count = len(found.positions)
    given = ["given" if i < found.included else "" for i in range(count)] if found.included else ()
    labelled = zip(map(str, range(1, count + 1)), found.positions.tolist(), strict=True)
    heading = (
        f"model {found.model}, orientations {found.orientation}, "
        f"criterion {found.criterion}, {count} positions"
    )
    sheet = [_operators_sheet(found)] if found.settings else []
    positions = [assessment.positions_table(labelled, given, found.towards)]
    before = [_before_and_after(found)] if found.u else []
    first = [*sheet, _summary(found), *positions] if sheet else [*positions, _summary(found)]
    parts = [heading, *before, *first, *assessment.scheme_details(found.scheme)]
    return "\n\n".join(parts) + "\n"


def _before_and_after(found: Design) -> str:
    """Return u of each parameter with the included positions, and with all."""
    rows = []
    for entry in found.u:
        before, after = entry["before"], entry["after"]
        fall = f"{100.0 * (1.0 - after / before):.1f}"
        rows.append([entry["name"], number(before), number(after), entry["unit"], fall])
    return table(["parameter", "u before", "u after", "unit", "falls by %"], rows)


def _operators_sheet(found: Design) -> str:
    """Return what to set at each position, with the axes' angles above the horizon to check it."""
    names = found._set_by
    rows = []
    for label, setting, up in zip(found.labels, found.settings, found.positions, strict=True):
        above = np.degrees(np.arcsin(np.clip(up, -1.0, 1.0)))
        angles = [f"{angle + 0.0:.1f}" for angle in above.tolist()]
        rows.append([label, *(_as_set(setting.get(name)) for name in names), *angles, "[ ]"])
    header = ["position", *names, *(f"{axis} above level" for axis in COMPONENTS), "done"]
    return f"operator's sheet, angles in degrees\n{table(header, rows)}"


def _as_set(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _summary(found: Design) -> str:
    """Return how good the positions are, with the certificate."""
    certificate = found.certificate
    bench = certificate["over"] == "candidates"
    reach = "these candidates" if bench else "the whole sphere"
    time = "" if found.time_s is None else f"{found.time_s:.0f} s"
    proof = (
        f"largest variance {certificate['max_variance']:.8g} of the best on {reach} "
        f"for {certificate['parameters']} parameters, less 1"
    )
    if found.criterion == "E":
        proof = f"part by which the least eigenvalue of the best on {reach} may be larger"
    lines = [
        ["efficiency", f"{found.efficiency:.6f}", "against the best on the whole sphere"],
        ["log det", f"{found.log_det:.6f}", f"at most {found.optimum_log_det:.6f}"],
        ["certificate", f"{certificate['gap']:.1e}", proof],
        ["travel", f"{found.travel_deg:.0f}°", time],
        ["drift", f"{100.0 * found.scheme.drift_absorbed:.0f} %", "of a linear one is absorbed"],
    ]
    if bench and found.bench_efficiency is not None:
        share = f"{found.bench_efficiency:.6f}"
        lines.insert(1, ["", share, "against the best on these candidates"])
    width = max(len(line[1]) for line in lines)
    return "\n".join(f"{a:<11}  {b:>{width}}  {c}".rstrip() for a, b, c in lines)


def design_csv(found: Design) -> str:
    """Return the positions of a design as a scheme file."""
    return format_csv(found.columns())


_STARTS = 24  # of the exchange
_POLISHED = 4  # of the best starts
_MOST = 200  # new positions: the search grows with their square, what it gains not at all
_POWERS = (20.0, 100.0, 500.0)  # by which the largest variance is smoothed, one after the other
_MANY = 1500  # candidates that the exchange takes; of more, those that matter


def design(
    model: ModelText | Model | None = None,
    positions: int = 6,
    *,
    criterion: str = "D",
    axes: Names | None = None,
    inputs: Names | None = None,
    candidates: "Source | Scheme | None" = None,
    include: "Source | Scheme | Calibration | None" = None,
    region: "Source | Scheme | None" = None,
    unknown_orientation: bool = False,
    orientation_sd: float | None = None,
    reading_sd: float | None = None,
    move_time: tuple[float, float] | None = None,
    seed: int = 0,
    order: Order = "spread",
) -> Design:
    """Return the best positions for a model, and how far they are from the best possible.

    Parameters
    ----------
    model : str or Model, optional
        Name, formula, that of a calibration, or a model of one's own: judged at the parameters
        that it states, and where these have a prior, by the mean of the criterion over it;
        'linear' where not given.
    positions : int
        How many, the included ones counted.
    criterion : str
        'D' (all parameters together), 'A' (mean variance), 'E' (least
        eigenvalue of the information), 'G' (largest variance of the
        prediction), 'I' (mean variance of the compensated force over the sphere or `region`),
        'u:OUTPUT:TERM' (one parameter), 'tilt:±30' (variance of tilt over that range of degrees),
        or 'force:±0.5' (of force over that range of g).
    candidates : bench, scheme, path or columns, optional
        What can be reached (`multipos.positions.scheme`); any direction where not given.
    include : scheme, path, columns or Calibration, optional
        Positions already measured, which stay: the others are the next best ones. Of a
        calibration, or the path of its file, model, axes and sensor hold as well, and the noise
        where it is not stated; the result has u before and after, and `reading_sd` is then in the
        unit of the readings.
    region : as `candidates`, optional
        Directions over which I averages.
    move_time : (s, s/degree), optional
        Time that a position takes, and that turning towards it takes per degree.
    seed : int
        Of the random starts.
    order : str
        How the positions that are not included are laid out: 'spread' against drift, 'travel' in
        short ways, or 'paper', as the search found them (`multipos.positions.order`).
    axes, inputs, unknown_orientation, orientation_sd, reading_sd
        As in `schemes`.

    Returns
    -------
    Design

    Raises
    ------
    UsageError
        Too few positions, an unknown criterion or bench, options that contradict each other or an
        included calibration.
    MultiposError
        An included calibration that states no noise, or whose model has other columns.
    RankError
        The candidates cannot separate the parameters, which are named.

    Examples
    --------
    >>> import multipos as mp
    >>> found = mp.design("own-quadratic", 12)
    >>> round(found.efficiency, 3), found.certificate["parameters"]
    (1.0, 15)
    """
    check_order(order)
    candidates = read_once(candidates)
    include = include if isinstance(include, Calibration) else read_once(include)
    setting, given, begun = begin_design(
        include,
        model=model,
        axes=axes,
        inputs=inputs,
        unknown_orientation=unknown_orientation,
        orientation_sd=orientation_sd,
        reading_sd=reading_sd,
    )
    wanted = make_criterion(criterion, setting, None if region is None else read_bench(region))
    if region is not None and criterion != "I":
        raise UsageError(f"--region is what criterion I averages over; got criterion {criterion}.")
    _check_count(setting, positions, len(given))
    bench = None if candidates is None else read_bench(candidates)
    assessor = assessment.Assessor(setting.stated)
    _check_candidates(assessor, bench, given)
    judged = criterion in ("D", "A", "E", "I") and region is None and not setting.draws
    sphere = assessor.optimum(criterion) if judged else optimise_sphere(setting, wanted)
    reach = bench
    if bench is not None and len(given) and assessor.separate(bench)[0]:
        # by themselves the candidates have no optimum
        reach = np.concatenate([bench, given])
    best = sphere if reach is None else optimise_candidates(setting.rows(reach), wanted)
    rng = np.random.default_rng(seed)
    value, up = _search(setting, wanted, positions - len(given), bench, given, best, rng)
    _require_separated(value > -math.inf, positions)
    up = np.concatenate([given, up[_order(setting, up, given, order)]])
    described = assessor.describe(Scheme("design", up, np.full((len(up), 3, 3), np.nan), None))
    _require_separated(described.identifiable, positions)  # what many candidates barely show
    u = () if begun is None else _u_of(begun, up[len(given) :])
    if u:
        after = {f"{entry['output']}:{entry['term']}": entry["after"] for entry in u}
        described = replace(described, u=after)
    efficiency, on_bench = _efficiency(criterion, value, sphere, best)
    if criterion == "E" and described.e_efficiency is not None:
        efficiency, on_bench = described.e_efficiency, None
    turned = travel_deg(up)
    time_s = None if move_time is None else move_time[0] * len(up) + move_time[1] * turned
    return Design(
        model=setting.model.text,
        orientation=orientation(setting),
        criterion=criterion,
        positions=up,
        included=len(given),
        log_det=described.log_det,
        optimum_log_det=assessor.optimum("D").log_det,
        efficiency=efficiency,
        certificate=_certificate(setting, best, "sphere" if bench is None else "candidates"),
        optimum={
            "positions": best.up if reach is None else reach[best.chosen],
            "weights": best.weights,
        },
        bench_efficiency=on_bench,
        travel_deg=turned,
        time_s=time_s,
        scheme=described,
        findings=nothing_to_weigh(setting),
        settings=_settings(up, len(given), candidates, include if begun is None else None),
        u=u,
        towards="up" if begun is None else begun.towards,
    )


def begin_design(
    include: "Source | Scheme | Calibration | None",
    *,
    model: ModelText | Model | None = None,
    axes: Names | None = None,
    inputs: Names | None = None,
    unknown_orientation: bool = False,
    orientation_sd: float | None = None,
    reading_sd: float | None = None,
) -> tuple[Setting, Array, Begun | None]:
    """Return the setting, the included up vectors (n, 3), and what an included calibration brings.

    The options are those of `design`.
    """
    calibration = _calibration_of(include)
    if calibration is not None:
        if unknown_orientation or any(each is not None for each in (model, axes, inputs)):
            raise UsageError(
                "--include CAL.json has model, axes and inputs of its own; leave out --model, "
                "--axes, --inputs and --unknown-orientation, or include a scheme."
            )
        begun = begin_otherwise(calibration, orientation_sd, reading_sd)
        return begun.setting, begun.up, begun
    setting = assessment.read_setting(
        "linear" if model is None else model,
        COMPONENTS if axes is None else axes,
        COMPONENTS if inputs is None else inputs,
        unknown_orientation,
        orientation_sd,
        1.0 if reading_sd is None else reading_sd,
    )
    return setting, np.empty((0, 3)) if include is None else read_scheme(include).up, None


def _calibration_of(include: "Source | Scheme | Calibration | None") -> Calibration | None:
    """Return the calibration that is included, None where it is a scheme or nothing."""
    if isinstance(include, str | os.PathLike) and read_schema(include) == Calibration.schema:
        return load(include)
    return include if isinstance(include, Calibration) else None


def _u_of(begun: Begun, further: Array) -> tuple[dict[str, Any], ...]:
    """Return u of each parameter before further positions (n, 3), and after."""
    model = begun.setting.model
    pieces = information_of(begun.setting, further).sum(axis=0)
    after = begun.u(pieces).tolist()
    before = begun.u(np.zeros_like(pieces)).tolist()
    columns = zip(model.keys, model.names, model.units, before, after, strict=True)
    return tuple(
        {
            "output": output,
            "term": str(term),
            "name": name,
            "unit": unit,
            "before": then,
            "after": now,
        }
        for (output, term), name, unit, then, now in columns
    )


def _require_separated(separated: bool, positions: int) -> None:
    if not separated:
        raise MultiposError(
            f"no {positions} positions were found that separate the parameters; "
            "give more --positions or more candidates."
        )


def _order(setting: Setting, up: Array, given: Array, order: Order) -> Places:
    """Return the rows of new positions as they are laid out behind those given."""
    if order == "travel":
        return travel_order(up, given[-1:])
    stated = setting.stated
    columns = None if stated.coupled else np.hstack([Z[:, 0, :] for Z in stated.rows(up)])
    return lay_out(up, order, columns)


def _settings(
    up: Array,
    included: int,
    candidates: "Source | Scheme | None",
    include: "Source | Scheme | None",
) -> tuple[dict[str, Any], ...]:
    """Return how included positions and those of the candidates are set; nothing without both."""
    settings = _of_bench(include, up[:included]) + _of_bench(candidates, up[included:])
    return settings if any(settings) else ()


def _of_bench(source: "Source | Scheme | None", up: Array) -> tuple[dict[str, Any], ...]:
    settings = () if source is None else bench_settings(source, up)
    return settings or tuple({} for _ in up)


def _efficiency(
    criterion: str, value: float, sphere: ContinuousOptimum, best: ContinuousOptimum
) -> tuple[float, float | None]:
    """Return the efficiency against the sphere, and against the best that could be."""
    if criterion == "G":  # the value is −ln of the largest s on the sphere, 1 at the optimum
        return min(1.0, math.exp(value)), None
    return min(1.0, math.exp(value - sphere.value)), min(1.0, math.exp(value - best.value))


def _certificate(setting: Setting, best: ContinuousOptimum, over: str) -> dict[str, Any]:
    p = len(setting.model.keys)
    return {
        "max_variance": p * (1.0 + best.gap),
        "parameters": p,
        "gap": best.gap,
        "over": over,
    }


def _check_count(setting: Setting, positions: int, included: int) -> None:
    if positions < setting.least:
        what = "in all" if math.isinf(setting.orientation_sd) else "per output"
        raise UsageError(
            f"--positions {positions} is too few: the model has {setting.least} parameters {what}, "
            f"so at least {setting.least} positions are needed."
        )
    if positions <= included:
        raise UsageError(
            f"--positions {positions} counts the {included} included positions; "
            f"give more than {included}."
        )
    if positions - included > _MOST:
        raise UsageError(
            f"--positions {positions} asks for {positions - included} new positions, of which at "
            f"most {_MOST} are searched for; repeat a design of fewer, which is as precise per "
            "reading."
        )


def _check_candidates(assessor: assessment.Assessor, bench: Array | None, given: Array) -> None:
    everything = read_bench("sphere") if bench is None else np.concatenate([bench, given])
    problems, _ = assessor.separate(everything)
    if not problems:
        return
    who, way_out = "no static positions can", "drop terms from the model"
    if bench is not None:
        who, way_out = "the candidates cannot", "drop terms, or add candidates that differ more"
    total = len(assessor.setting.model.keys)
    raise RankError(
        f"{who} separate the parameters: {join_combinations(problems)}; {way_out}.",
        rank=total - len(problems),
        parameters=total,
        combinations=problems,
    )


def _search(
    setting: Setting,
    criterion: Criterion,
    count: int,
    bench: Array | None,
    given: Array,
    best: ContinuousOptimum,
    rng: np.random.Generator,
) -> tuple[float, Array]:
    """Return the criterion and the best `count` positions beside those given."""
    if bench is None:
        few = np.concatenate([read_bench("all-26+icosahedron-12+fibonacci-200"), best.up[:60]])
    else:
        few = bench if len(bench) <= _MANY else _promising(setting, criterion, bench, best)
    rows, fixed = setting.rows(few), setting.rows(given)
    starts = _STARTS if rows[0].shape[1] == 1 else _STARTS // 3
    found = choose(rows, count, criterion, included=fixed, starts=starts, rng=rng)
    if criterion.name == "G":  # exchanged as D is; the best for the mean variance are tried too
        found += choose(
            rows, count, make_criterion("I", setting), included=fixed, starts=starts, rng=rng
        )
        return _search_largest(setting, [few[c] for _, c in found], bench, given)
    if bench is not None:
        value, choice = found[0]
        return value, few[choice]
    polished = [
        polish(setting, few[choice], criterion, given)
        for value, choice in found[:_POLISHED]
        if value > -math.inf
    ]
    return max(polished, key=lambda result: result[0], default=(-math.inf, given))


def _search_largest(
    setting: Setting, choices: list[Array], bench: Array | None, given: Array
) -> tuple[float, Array]:
    """Return −ln max s and the positions, of choices polished where they may move: criterion G."""

    def judged(up: Array) -> tuple[float, Array]:
        information = inform(setting.rows(np.concatenate([up, given])))
        if log_det(information) == -math.inf:
            return -math.inf, up
        return -math.log(largest_sensitivity(setting, information)), up

    ranked = sorted((judged(up) for up in choices), key=lambda result: -result[0])
    if bench is None:
        seen = setting.rows(read_bench("all-26+fibonacci-400"))
        for _, up in ranked[:2]:
            for power in _POWERS:
                _, up = polish(setting, up, Criterion("G", power=power, seen=seen), given)
            ranked.append(judged(up))
    return max(ranked, key=lambda result: result[0])


def _promising(
    setting: Setting, criterion: Criterion, bench: Array, best: ContinuousOptimum
) -> Array:
    """Return the candidates that exact designs are made of: where s of the optimum is high."""
    information = inform(setting.rows(bench[best.chosen]), best.weights)
    s = sensitivity(setting.rows(bench), kernels(information, criterion))
    return np.asarray(bench[np.sort(np.argsort(-s)[:_MANY])])


_SIZES = 8  # of designs in a curve; each is a search of its own


def smaller_designs(make: Callable[[int], Design], found: Design) -> tuple[Design, ...]:
    """Return designs of fewer positions and the one that was found, fewest first.

    Parameters
    ----------
    make : callable
        Returns the design of so many positions, as the one that was found was made.
    found : Design

    Returns
    -------
    tuple of Design
        At most eight, evenly spread; sizes that cannot separate the parameters are left out.
    """
    most = len(found.positions)
    step = max(1, most // _SIZES)
    designs = [found]
    for count in range(most - step, found.included, -step):
        try:
            designs.append(make(count))
        except (MultiposError, UsageError):  # too few, and so are all that are fewer
            break
    return tuple(reversed(designs[:_SIZES]))


def design_sentence(found: Design) -> str:
    """Return how good the positions are against the best that there could be."""
    text = (
        f"{len(found.positions)} positions reach {100.0 * found.efficiency:.1f} % of the best "
        f"{found.criterion} efficiency per position on the sphere"
    )
    falls = [math.log(e["after"] / e["before"]) for e in found.u]
    if not falls:
        return f"{text}."
    fall = 100.0 * (1.0 - math.exp(sum(falls) / len(falls)))
    return f"{text}; {len(found.positions) - found.included} more lower u by {fall:.2g} %."
