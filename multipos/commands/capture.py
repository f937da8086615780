"""``multipos capture``."""

import argparse
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from multipos.capturing import keeping, running
from multipos.capturing.evaluation import SessionPlan
from multipos.capturing.live_rows import RowOptions
from multipos.capturing.running import captured
from multipos.capturing.session import Session
from multipos.capturing.sources import open_source
from multipos.capturing.state import line_of
from multipos.commands.answers import STDOUT, Answer, Output, print_out, refuse_inputs
from multipos.commands.export import check_targets, files_beside, make_exports
from multipos.commands.options import declare, options_of, say
from multipos.exports.target import Exported
from multipos.files.tables import format_csv
from multipos.files.trees import to_json, to_json_line
from multipos.logs.averages import averages_sentence, averages_text
from multipos.reports.certificate import build_content
from multipos.reports.documents import html_report
from multipos.reports.summary import calibration_sentence, detail_text, parameter_text


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
    "report, the "
    "exports, and the rows of a source that is no log as they come",
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
    with ExitStack() as stack:
        kept = stack.enter_context(keeping.keep(source, path, resume=arguments.resume))
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
            if path is None or not session.accepted:
                raise
            return _answer(arguments, running.rescued(session), error)
    return _answer(arguments, captured(session))


def _begin(
    plan: SessionPlan, reading: RowOptions, kept: keeping.Kept, *, headless: bool
) -> Session:
    for said in kept.said:
        say(said)

    def notify(session: Session) -> None:
        if headless:
            print_out([to_json_line(line_of(session))], data=True)

    session = Session(plan, kept.as_before(reading), notify)
    session.decide(kept.decided)
    return session


def _exports(
    found: running.Captured, arguments: argparse.Namespace
) -> tuple[dict[Path, Exported], list[str]]:
    if not arguments.to:
        return {}, []
    if found.calibration is None:
        return {}, [f"no calibration to export: {found.problem}"]
    return make_exports(found.calibration, arguments, _calibration_path(arguments.output))


def _files(
    found: running.Captured, output: str, made: str, exports: Mapping[Path, Exported]
) -> Any:
    """Return what ``-o`` writes: the readings, and everything beside them."""
    if output == STDOUT:
        return made
    files: dict[Any, Any] = {output: made}
    if found.calibration is not None:
        path = _calibration_path(output)
        files[path] = to_json(found.calibration.to_dict())
        files[path.with_suffix(".html")] = html_report(build_content(found.calibration))
    for path, each in exports.items():
        files |= each.files(path)
    return files


def _answer(
    arguments: argparse.Namespace, found: running.Captured, ended_by: BaseException | None = None
) -> Answer:
    """Return what is written and printed; of a session that an error ended its readings."""
    exports, refused = _exports(found, arguments) if ended_by is None else ({}, [])
    table = "" if found.averages is None else format_csv(found.averages.columns())

    def sentence() -> str:
        if found.calibration is not None:
            return calibration_sentence(found.calibration)
        return "" if found.averages is None else averages_sentence(found.averages)

    def text() -> str:
        if arguments.headless or found.calibration is None:
            return ""
        return parameter_text(found.calibration)

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
        forms={
            "table": lambda: _files(found, arguments.output, table, exports),
            "json": lambda: _files(found, arguments.output, to_json(found.to_dict()), exports),
        },
        findings=lambda: (
            *found.findings,
            *(note for each in exports.values() for note in each.findings),
        ),
        failure=ended_by or " ".join(refused),
    )
