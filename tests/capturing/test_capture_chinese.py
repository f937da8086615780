"""Whatever a session says of poses, targets and the fit, it says in Chinese as well."""

import ast
import re
from pathlib import Path

import log_bench
import pytest
from docs_programs import load

import multipos as mp
from multipos.capturing.running import make_plan, make_reading
from multipos.capturing.screen import picture_of
from multipos.capturing.session import Session, chinese, state_of
from multipos.capturing.streams import open_source

PACKAGE = Path(mp.__file__).parent
PARSED = load("generated").parsed
ERRORS = {"MultiposError", "RankError", "ConvergenceError"}
# Parts of sentences that are put together before they are said.
PARTS = {
    "way_out": "add positions that differ more, or for ax fit '1 + x'",
    "said": "4 positions give 4 equations for 9 parameters",
    "error": "4 positions give 4 equations for 9 parameters; add positions or choose a model with "
    "fewer terms.",
    "seen": "(7)",
}
WAYS_OUT = (  # of a search that did not converge
    "Check the readings for blunders (--robust huber names them), or choose",
    "Fit without --robust, or choose",
)
OF_SCHEMES = "take a scheme with more positions, or raise the target"


def text_of(node, parts):
    """Return a sentence of the code with something put in, None where it is none."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if not isinstance(node, ast.JoinedStr):
        return None
    found = ""
    for value in node.values:
        if isinstance(value, ast.Constant):
            found += value.value
        else:
            name = value.value.id if isinstance(value.value, ast.Name) else ""
            found += parts.get(name, "7")
    return found


def raised(name, parts):
    """Return what the errors of a file say, but those about options."""
    for node in PARSED(PACKAGE / name)[1]:
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") in ERRORS:
            text = text_of(node.args[0], parts)
            if text is not None and "--" not in text.partition(";")[0]:
                yield text


def returned(name, functions, parts):
    """Return the sentences in functions of a file."""
    for function in PARSED(PACKAGE / name)[1]:
        if not isinstance(function, ast.FunctionDef) or function.name not in functions:
            continue
        body = [node for part in function.body[1:] for node in ast.walk(part)]
        inner = {
            id(value) for node in body if isinstance(node, ast.JoinedStr) for value in node.values
        }
        for node in body:
            text = None if id(node) in inner else text_of(node, parts)
            if text is not None and " " in text.strip():
                yield text


def sentences():
    yield from returned("capturing/poses.py", {"refuse_rest", "refuse_unit", "refuse_repeat"}, {})
    yield from returned("capturing/session.py", {"undo", "redo", "_place"}, {})
    yield from returned("capturing/evaluation.py", {"_out_of_reach"}, {"way_out": OF_SCHEMES})
    faults = {"at_one_value", "_moved", "_gaps", "_output_faults", "_settled", "_twins"}
    yield from returned("logs/faults.py", faults, {"fault": "stuck"})
    for name in ("known", "problem", "uncertain", "user_models"):
        yield from raised(f"estimation/{name}.py", PARTS)
    yield from raised("fitting/completion.py", PARTS)
    for way_out in WAYS_OUT:
        yield from raised("estimation/starts.py", PARTS | {"way_out": way_out})
    yield from raised("fitting/calibrate_logs.py", PARTS)


SENTENCES = sorted(set(sentences()) - {OF_SCHEMES, " more pairs", "7 and 7", " and 7 more pairs"})


def test_the_sentences_are_found():
    assert len(SENTENCES) >= 40
    assert any(text.startswith("repeats pose 7") for text in SENTENCES)
    assert "taken back" in SENTENCES
    assert any("out of reach" in text for text in SENTENCES)


@pytest.mark.parametrize("text", SENTENCES)
def test_every_reason_has_its_chinese(text):
    require_chinese(text, chinese(text))


def require_chinese(text, said):
    assert re.search(r"[\u4e00-\u9fff]", said), text
    assert not re.search(r"[a-z]{3,} [a-z]{2,} [a-z]{2,}", said), said


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("chinese")


def state_after(path, scheme=None, target=(), limit=None):
    session = Session(
        make_plan(target, limit, scheme, {}), make_reading(None, None, None, None, None, 3e-3)
    )
    for arrival in open_source(f"replay:{path}:0").arrivals(None):
        if arrival.log is not None:
            session.begin(arrival.log, arrival.columns)
        else:
            session.feed(arrival.columns)
    return session, state_of(session)


@pytest.fixture(scope="module")
def undone(folder):
    """The state of a session with poses that repeat others, after the last was taken back."""
    columns = log_bench.columns_of(scheme="faces-6+edges-12+faces-6")
    path = log_bench.write_csv(folder / "log.csv", columns)
    session, state = state_after(path, target=["bias=1e-7"])
    assert "out of reach" in state["findings"][0]["text"]
    session.undo()
    return state_of(session)


def test_all_of_a_state_is_there_in_chinese(folder, undone):
    state = undone
    reasons = [pose for pose in state["taken"] if pose["reason"]]
    assert len({pose["reason"].split()[0] for pose in reasons}) == 2  # repeats, taken back
    for pose in reasons:
        require_chinese(pose["reason"], pose["reason_zh"])
    for finding in state["findings"]:
        require_chinese(finding["text"], finding["text_zh"])
    require_chinese(state["live"]["refused"], state["live"]["refused_zh"])
    _, few = state_after(
        log_bench.write_csv(folder / "few.csv", log_bench.columns_of(scheme="faces-6"))
    )
    require_chinese(few["problem"], few["problem_zh"])


def test_the_text_screen_speaks_chinese(undone):
    text = "\n".join(picture_of(undone, "zh"))
    assert "下一个姿态: " in text
    assert "重复" in text
    left = re.sub(r"\b[a-z]+_a[xyz](_[xyz])?\b|fit --model.*|--[a-z-]+", "", text)
    assert not re.search(r"[a-z]{3,} [a-z]{2,}", left), text


def test_a_target_in_reach_is_not_denied(folder):
    path = log_bench.write_csv(folder / "log.csv", log_bench.columns_of(scheme="all-26"))
    # two hundred poses more than fifteen lower U to about a third
    _, state = state_after(path, limit=15)
    U = {entry["name"]: entry["U"] for entry in state["parameters"]}
    for share, said in ((0.5, False), (0.1, True)):
        _, state = state_after(path, target=[f"bias_ax={share * U['bias_ax']}"], limit=15)
        assert any("out of reach" in finding["text"] for finding in state["findings"]) is said


def test_a_scheme_that_is_too_short_for_a_target_says_so(folder):
    path = log_bench.write_csv(folder / "edges.csv", log_bench.columns_of(scheme="edges-12"))
    for limit, said in ((8, "after the last 4 positions of the scheme"), (12, "at its end")):
        session, state = state_after(path, "edges-12", ["bias=1e-5"], limit)
        if limit == 12:
            session.finish()
            state = state_of(session)
        assert len(session.accepted) == limit
        assert said in state["findings"][0]["text"]
