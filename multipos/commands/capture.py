"""``multipos capture``."""

import argparse
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from multipos.capturing import keeping, running
from multipos.capturing.evaluation import SessionPlan
from multipos.capturing.live_rows import RowOptions
from multipos.capturing.rehearsal import rehearse
from multipos.capturing.running import captured
from multipos.capturing.session import Session
from multipos.capturing.sources import open_source
from multipos.commands.answers import STDOUT, Answer, Exports, Output, print_out, refuse_inputs
from multipos.commands.export import check_targets, files_beside, make_exports
from multipos.commands.options import declare, options_of, say
from multipos.errors import MultiposError, UsageError
from multipos.files.tables import format_csv
from multipos.files.trees import to_json, to_json_line
from multipos.logs.averages import averages_sentence, averages_text
from multipos.reports.certificate import build_content
from multipos.reports.documents import html_report
from multipos.reports.summary import calibration_sentence, detail_text, parameter_text
from multipos.sensor.calibration import Calibration


def _calibration_path(output: str) -> Path:
    path = Path(output)
    plain = path.with_suffix(".json")
    return plain if plain != path else path.with_name(f"{path.stem}_cal.json")


def _beside(arguments: argparse.Namespace) -> tuple[Path, ...]:
    if arguments.output == STDOUT:
        return ()
    calibration = _calibration_path(arguments.output)
    kept = keeping.files_kept(open_source(arguments.source), Path(arguments.output))
    exports = files_beside(arguments.to, calibration)
    return (calibration, calibration.with_suffix(".html"), *kept, *exports)


INPUTS = ("scheme", "budget", "stability")
OUTPUT = Output(
    "READINGS.csv",
    "write the poses that count to READINGS.csv, and to the same folder the calibration, its "
    "report, the exports, and the rows of a source that is no log as they come",
    "table",
    ("json",),
    beside=_beside,
)
PORT = 8035


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    declare(parser, "capture", beside="READINGS.csv", port=str(PORT))


def run(arguments: argparse.Namespace) -> Answer:
    """Return what the command found."""
    check_targets(arguments)
    source = open_source(arguments.source)
    path = None if arguments.output in (None, STDOUT) else Path(arguments.output)
    if path is not None and source.path is not None:
        refuse_inputs([path, *_beside(arguments)], [str(source.path)])
    source.untimed = source.untimed and arguments.rate is None
    given = arguments
    fitting = options_of(given, "fit", ["outputs", "scheme", "order"])
    plan = running.make_plan(given.target, given.positions, given.scheme, fitting, given.order)
    reading = running.make_reading(
        outputs=given.outputs,
        min_duration=given.min_duration,
        threshold=given.threshold,
        **options_of(given, "reading", ["columns", "drop_bad"]),
    )
    rehearse(plan, reading.outputs, lambda calibration: _rehearse_exports(calibration, given))
    with ExitStack() as stack:
        kept = stack.enter_context(keeping.keep(source, path, say, resume=arguments.resume))
        session = _begin(plan, reading, kept, headless=arguments.headless)
        if not arguments.headless:
            from multipos.capturing.screen import text_screen
            from multipos.capturing.serving import serve

            address = stack.enter_context(serve(session, arguments.port, default=PORT))
            say(f"page at {address}")
            stack.enter_context(text_screen(session, commands=arguments.source != STDOUT))
        try:
            running.run_session(session, source, arguments.columns, kept)
        except BaseException as error:
            if arguments.output is None or not session.accepted:
                raise
            return _answer(arguments, running.rescued(session), error)
    return _answer(arguments, captured(session))


def _begin(
    plan: SessionPlan, reading: RowOptions, kept: keeping.Kept, *, headless: bool
) -> Session:
    def tell(line: dict[str, Any]) -> None:
        if line.get("connected") is False:
            say("the source is lost: plug it in again, and the session goes on")
        if headless:
            print_out([to_json_line(line)], data=True)

    session = Session(plan, kept.as_before(reading), running.teller(tell))
    session.decided.update(kept.decided)
    return session


def _rehearse_exports(calibration: Calibration, arguments: argparse.Namespace) -> None:
    """Export nominal readings, so that a target is refused before a pose is taken."""
    asked = argparse.Namespace(**{**vars(arguments), "force": True})  # whatever is found of them
    refused = make_exports(calibration, asked, "nominal.json").refused
    if refused:
        raise MultiposError(refused[0])


def _exports(
    calibration: Calibration, arguments: argparse.Namespace, path: Path
) -> tuple[Exports, Exception | None]:
    """Return calibration, exports and report, as far as they can be made, and what went wrong."""
    made, error = Exports({}, [], [], []), None
    try:
        made = make_exports(calibration, arguments, path)
    except Exception as fault:  # the readings are worth more than what is made of them
        error = fault
    made.files[path] = to_json(calibration.to_dict())
    try:
        made.files[path.with_suffix(".html")] = html_report(build_content(calibration))
    except ModuleNotFoundError as fault:
        say(f"no report is written: it needs {fault.name}; pip install {fault.name}")
    except Exception as fault:
        error = fault
    return made, error


def _answer(
    arguments: argparse.Namespace, found: running.Captured, ended_by: BaseException | None = None
) -> Answer:
    """Return what is written and printed; of a session that an error ended its readings."""
    made, calibration = Exports({}, [], [], []), found.calibration
    failure = ended_by
    if ended_by is None and calibration is None:
        failure = MultiposError(f"no calibration: {found.problem}")
    elif calibration is not None and arguments.output not in (None, STDOUT):
        made, failure = _exports(calibration, arguments, _calibration_path(arguments.output))
    if isinstance(failure, UsageError):  # after the poses it is their fault no more
        failure = MultiposError(str(failure))
    table = "" if found.averages is None else format_csv(found.averages.columns())

    def files(first: str) -> Any:
        return first if arguments.output == STDOUT else {arguments.output: first, **made.files}

    def sentence() -> str:
        if calibration is not None:
            return calibration_sentence(calibration)
        return "" if found.averages is None else averages_sentence(found.averages)

    def text() -> str:
        if calibration is None or arguments.headless:
            return ""
        return parameter_text(calibration)

    def detail() -> str:
        parts = [averages_text(found.averages)] if found.averages is not None else []
        parts += [detail_text(found.calibration)] if found.calibration is not None else []
        return "\n".join(parts)

    return Answer(
        sentence=sentence,
        text=text,
        detail=detail,
        verbatim=arguments.headless,
        json=lambda: "" if arguments.headless else to_json(found.to_dict()),
        forms={"table": lambda: files(table), "json": lambda: files(to_json(found.to_dict()))},
        findings=lambda: (*found.findings, *made.findings),
        failure=failure or " ".join(made.refused),
    )
