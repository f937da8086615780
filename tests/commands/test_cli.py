"""The command line: its promises on output, and one clear line for every kind of bad input."""

import json
import os
import re
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from cli_bench import MULTIPOS, SIX, run, snapshot

import multipos as mp
from multipos import cli
from multipos.errors import MultiposError, UsageError

# the same with semicolons and decimal commas, with tabs, and as a spreadsheet saves it
FORMS = {
    "comma": SIX.encode(),
    "semicolon": SIX.replace(",", ";").replace(".", ",").encode(),
    "tab": SIX.replace(",", "\t").encode(),
    "BOM, CRLF and comments": b"\xef\xbb\xbf# bench 4\r\n" + SIX.replace("\n", "\r\n").encode(),
    "Chinese": SIX.translate(str.maketrans(dict(zip("ENWSUD", "东北西南天地", strict=True))))
    .replace("-南", "南")
    .replace("东-", "东")
    .encode(),
}


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "six.csv").write_text(SIX, encoding="utf-8")
    mp.fit("six.csv").save("cal.json")
    return tmp_path


def refused(capsys, here, *arguments):
    """Run what must fail; return its line. Nothing may be printed, written or touched."""
    before = snapshot(here)
    status, out, err = run(capsys, *arguments)
    assert status in (1, 2)
    assert out == ""
    assert snapshot(here) == before
    *others, line = err.splitlines()
    assert line.startswith("multipos: error: ")
    assert line.endswith(".")
    assert not others
    return status, line.removeprefix("multipos: error: ")


# --- bad input, line by line of what is promised

FILES = {
    "missing file": (None, 1, "bad.csv: no such file; check the path of the readings."),
    "text in a number": (
        SIX.replace("0.0064", "0.0064 V"),
        1,
        "bad.csv: row 3 (line 4), column 'ay': '0.0064 V' is not a number",
    ),
    "left-handed direction": (
        SIX.replace("E-U-S", "E-U-N"),
        1,
        "row 1 (line 2), column 'direction': direction 'E-U-N' is left",
    ),
    "impossible direction": (SIX.replace("E-U-S", "E-W-S"), 1, "'E-W-S' is impossible"),
    "unknown direction": (SIX.replace("E-U-S", "E-U-Q"), 1, "'E-U-Q' is not a triple"),
    "no orientation": ("ax\n1\n", 1, "bad.csv: no orientation; give --scheme"),
    "two orientations": (SIX.replace("ay", "up_x"), 1, "given as direction and as up vector"),
    "fewer positions than terms": (
        "\n".join(SIX.splitlines()[:4]),
        1,
        "3 readings cannot determine the 4 terms of ax",
    ),
    "positions that do not separate": (
        "up_x,up_y,up_z,ax\n0,0,1,0\n0,1,0,0\n0,0,-1,0\n0,-1,0,0\n",
        1,
        "3 of 4 parameters of ax can be separated: `scale_ax` has no effect at these positions",
    ),
    "four outputs": (SIX.replace("position", "aw"), 2, "could be outputs: aw, ax, ay, az; name"),
    "not text": (
        b"\x89PNG\r\n\x1a\n\x00",
        1,
        "byte 0 is not UTF-8; save the readings as UTF-8 text. A binary log is for",
    ),
}


@pytest.mark.parametrize(("content", "status", "message"), FILES.values(), ids=FILES)
def test_bad_readings_get_one_line(content, status, message, here, capsys):
    if content is not None:
        raw = content.encode() if isinstance(content, str) else content
        (here / "bad.csv").write_bytes(raw)
    found, line = refused(capsys, here, "fit", "bad.csv", "-o", "out.json")
    assert found == status
    assert message in line


OPTIONS = {
    "unknown column": (["--outputs", "ax,aq"], 1, "six.csv: no column 'aq'"),
    "unknown model": (["--model", "cubic"], 2, "unknown model 'cubic'; give linear"),
    "unknown term": (["--model", "1 + x + humidity"], 2, "unknown term 'humidity'"),
    "code in a formula": (["--model", "__import__('os').remove('six.csv')"], 2, "cannot read"),
    "unknown scheme": (["--scheme", "six"], 2, "unknown scheme 'six'; give a file or one of"),
    "missing scheme file": (["--scheme", "none.csv"], 1, "none.csv: no such file"),
    "labels that match nothing": (["--scheme", "tumble-3"], 1, "position '4', '5', '6' is not in"),
    "terms not separable": (["--model", "own-cubic"], 1, "`scale_ax` cannot be separated from"),
    "too many terms": (["--model", "ieee"], 1, "6 readings cannot determine the 8 terms of ax"),
    "never separable": (["--model", "full-quadratic"], 1, "for ax use '1 + x + y + z + x^2 + y^2'"),
    "wrong confidence": (["--confidence", "95"], 2, "--confidence must lie between 0 and 1"),
    "no number": (["--gravity", "g"], 2, "argument --gravity: invalid float value: 'g'"),
    "no numbers": (["--reading-sd", "1,b"], 2, "'1,b' is not a number or numbers"),
    "empty name": (["--outputs", "ax,"], 2, "'ax,' names nothing next to a comma"),
    "gravity twice": (["--gravity", "9.8", "--latitude", "4"], 2, "give one"),
    "unknown option": (["--color"], 2, "unrecognized arguments: --color"),
    "a blank beside the options": ([" "], 2, "unrecognized arguments:"),
    "abbreviated option": (["--mod", "linear"], 2, "unrecognized arguments: --mod"),
    "another program's -o": (
        ["--out", "x.json"],
        2,
        "did you mean '-o'; see 'multipos fit --help'",
    ),
    "unit of mass": (["--unit", "kg"], 2, "kg is of mass, amount or light"),
    "unwritable output": (["-o", "none/out.json"], 1, "none/out.json: cannot write: No such file"),
    "output is a folder": (["-o", "."], 1, ".: cannot write: it is a folder"),
}


@pytest.mark.parametrize(("options", "status", "message"), OPTIONS.values(), ids=OPTIONS)
@pytest.mark.parametrize("as_json", [(), ("--json",)], ids=["text", "json"])
def test_bad_options_get_one_line(options, status, message, as_json, here, capsys):
    output = () if "-o" in options else ("-o", "out.json")
    found, line = refused(capsys, here, "fit", "six.csv", *options, *output, *as_json)
    assert found == status
    assert message in line


COMMANDS = {
    "unknown command": (["fitt"], 2, "there is no command 'fitt'; did you mean 'fit'?; see"),
    "misspelt option": (["fit", "six.csv", "--modle", "linear"], 2, "did you mean '--model'; see"),
    "option before the command": (["--json", "fit", "six.csv"], 2, "unrecognized arguments"),
    "dashes before the command": (["--", "fit"], 2, "the command must come first"),
    "no readings": (["fit"], 2, "required: READINGS; see 'multipos fit --help'"),
    "truncated calibration": (["apply", "cut.json", "six.csv"], 1, "cut.json: line "),
    "foreign JSON": (["apply", "other.json", "six.csv"], 1, "other.json: the schema is None"),
    "a table for a calibration": (["apply", "six.csv", "six.csv"], 1, "six.csv: line 1, column 1"),
    "missing calibration": (["apply", "no.json", "six.csv"], 1, "no.json: no such file"),
    "missing data": (["apply", "cal.json", "no.csv"], 1, "no.csv: no such file"),
    "data without the outputs": (["apply", "cal.json", "bare.csv"], 1, "bare.csv: no column 'ay'"),
    "unknown rule": (["apply", "cal.json", "six.csv", "--outside", "drop"], 2, "--outside takes"),
    "data outside": (
        ["apply", "cal.json", "far.csv", "--outside", "refuse", "-o", "out.csv"],
        1,
        "far.csv: row 2 (line 3), column 'ax': the reading is outside",
    ),
    "unknown scheme": (["schemes", "nine"], 2, "unknown scheme 'nine'"),
    "term of a scheme": (["schemes", "--model", "1 + temperature"], 2, "unknown term"),
    "sd of a scheme": (["schemes", "--reading-sd", "-1"], 2, "--reading-sd must be above 0"),
    "report without file": (["report", "cal.json"], 2, "report needs -o"),
    "unwritable report": (["report", "cal.json", "-o", "none/r.md"], 1, "none/r.md: cannot write"),
}


@pytest.mark.parametrize(("arguments", "status", "message"), COMMANDS.values(), ids=COMMANDS)
def test_bad_commands_get_one_line(arguments, status, message, here, capsys):
    (here / "cut.json").write_text((here / "cal.json").read_text()[:900])
    (here / "other.json").write_text('{"type": "FeatureCollection"}')
    (here / "bare.csv").write_text("ax\n1\n")
    (here / "far.csv").write_text("ax,ay,az\n0,0,1\n0,0,3\n")
    found, line = refused(capsys, here, *arguments)
    assert found == status
    assert message in line


def test_an_existing_file_is_kept_on_errors_and_replaced_whole(here, capsys):
    before = (here / "cal.json").read_bytes()
    refused(capsys, here, "fit", "six.csv", "--model", "ieee", "-o", "cal.json")
    assert (here / "cal.json").read_bytes() == before
    assert run(capsys, "fit", "six.csv", "--model", "own-quadratic", "-o", "cal.json")[0] == 0
    assert mp.load("cal.json").model.text == "own-quadratic"
    assert sorted(path.name for path in here.iterdir()) == ["cal.json", "six.csv"]


# --- what is printed


def test_json_is_one_object_and_nothing_else(here, capsys):
    for arguments in (
        ["fit", "six.csv"],
        ["fit", "six.csv", "--convention", "gravity"],
        ["schemes"],
        ["schemes", "all-26", "--model", "full-quadratic"],
        ["apply", "cal.json", "six.csv"],
        ["demo", "-o", "demo"],
        ["report", "cal.json", "-o", "r.md"],
    ):
        status, out, _ = run(capsys, *arguments, "--json")
        assert status == 0
        assert out.endswith("}\n")
        assert isinstance(json.loads(out, parse_constant=pytest.fail), dict)


def test_warnings_go_to_stderr(here, capsys):
    status, out, err = run(capsys, "fit", "six.csv", "--convention", "gravity", "--json")
    assert (status, err) == (0, "")
    found = json.loads(out)["diagnostics"]["findings"]
    assert [each["code"] for each in found if each["level"] == "warning"] == ["convention"]
    _, _, err = run(capsys, "fit", "six.csv", "--convention", "gravity")
    assert err.startswith("multipos: warning: every scale factor is negative")
    assert "hidden-terms" in {each["code"] for each in found}
    assert "cannot show" not in err
    _, _, err = run(capsys, "fit", "six.csv", "--outputs", "ax", "-v")
    assert "multipos: note: column 'ay' is not among the outputs and is not used" in err


def test_the_answer_comes_first_and_what_explains_last_in_one_pipe(here):
    text = shell("multipos fit six.csv --convention gravity -v 2>&1").stdout
    order = ["ax, ay, az calibrated", "scale_az", "multipos: warning: ", "Residuals at "]
    places = [text.index(words) for words in order]
    assert places[0] == 0
    assert places == sorted(places)
    assert text.count("every scale factor is negative") == 1
    short = shell("multipos fit six.csv --convention gravity 2>&1").stdout
    assert "Residuals" not in short
    assert len(short.splitlines()) <= 40
    assert shell("multipos fit six.csv --convention gravity -q").stderr == ""


def test_a_negative_verdict_ends_with_status_3(here, capsys):
    assert run(capsys, "check", "cal.json", "six.csv", "--limit-g", "1")[0] == 0
    status, out, _ = run(capsys, "check", "cal.json", "six.csv", "--limit-g", "1e-6")
    assert (status, out.split(":")[0]) in ((3, "Fail"), (0, "Indeterminate"))
    (here / "dead.csv").write_text(re.sub(r",[^,\n]*$", ",0.25", SIX, flags=re.MULTILINE))
    (here / "dead.csv").write_text((here / "dead.csv").read_text().replace("ay,0.25", "ay,az"))
    status, out, err = run(capsys, "fit", "dead.csv", "-o", "dead.json")
    assert (status, out.startswith("Not fit for use: ")) == (3, True)
    assert err.startswith("multipos: not fit for use: 'az' has the same reading")
    assert run(capsys, "report", "dead.json", "-o", "dead.html")[0] == 0
    assert run(capsys, "export", "dead.json", "--to", "c", "-o", "dead.c")[0] == 1


def test_the_file_is_what_python_gives(here, capsys, monkeypatch):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")
    options = [
        "--model",
        "own-quadratic",
        "--gravity",
        "9.81",
        "--gravity-u",
        "0.001",
        "--unit",
        "V",
        "--reading-sd",
        "0.1,0.2,0.3",
        "--confidence",
        "0.9",
        "--pool",
    ]
    _, out, _ = run(capsys, "fit", "six.csv", *options, "--json", "-o", "out.json")
    cal = mp.fit(
        "six.csv",
        model="own-quadratic",
        gravity=9.81,
        gravity_u=0.001,
        unit="V",
        reading_sd=[0.1, 0.2, 0.3],
        confidence=0.9,
        pool=True,
    )
    assert json.loads(out) == cal.to_dict() == mp.load("out.json").to_dict()
    assert json.loads(out)["input"]["file"] == "six.csv"
    assert len(json.loads(out)["input"]["sha256"]) == 64


@pytest.mark.parametrize("form", FORMS)
def test_every_form_of_a_table_gives_the_same(form, here, capsys):
    (here / "six.csv").write_bytes(FORMS[form])
    _, out, err = run(capsys, "fit", "six.csv", "--json")
    assert err == ""
    found = json.loads(out)["parameters"]
    assert [p["value"] for p in found] == list(mp.load("cal.json").parameters)


def test_data_frames_and_dicts_work_wherever_a_file_does(here):
    frame = pd.read_csv("six.csv")
    columns = {name: frame[name].to_numpy() for name in frame}
    cal = mp.load("cal.json")
    for source in (frame, columns, mp.read_readings("six.csv"), Path("six.csv")):
        np.testing.assert_array_equal(mp.fit(source).parameters, cal.parameters)
    for source in (frame, columns):
        f_x = mp.apply(cal, source)["f_x"]
        np.testing.assert_array_equal(f_x, mp.apply(cal, "six.csv")["f_x"])
        assert mp.schemes(source)["schemes"][0]["identifiable"]


def test_pandas_is_not_imported():
    code = (
        "import sys, multipos; multipos.read_readings({'ax': [1]}); print('pandas' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"


def test_apply_keeps_every_column_and_its_form(here, capsys):
    (here / "raw.csv").write_text("note;ax;ay;az;when\nfirst;0,5;0,1;0,8;9:00\n;2;0;0;\n")
    status, out, err = run(capsys, "apply", "cal.json", "raw.csv", "--uncertainty", "-v")
    assert status == 0
    header, first, second = (line.split(";") for line in out.splitlines())
    assert header == [
        "note",
        "ax",
        "ay",
        "az",
        "when",
        "f_x",
        "f_y",
        "f_z",
        "u_f_x",
        "u_f_y",
        "u_f_z",
        "U_f_x",
        "U_f_y",
        "U_f_z",
        "outside",
    ]
    assert first[:5] == ["first", "0,5", "0,1", "0,8", "9:00"]
    assert (first[-1], second[-1]) == ("0", "1")
    force = mp.load("cal.json").compensate([0.5, 0.1, 0.8])[0]
    written = [float(cell.replace(",", ".")) for cell in first[5:8]]
    assert written == pytest.approx(list(force), abs=1e-15)
    answer, first, *_ = err.splitlines()
    assert answer.startswith(
        "multipos: 2 rows compensated, 1 of them outside what was calibrated; u"
    )
    assert "averaged reading of the calibration" in answer
    assert first.startswith("multipos: warning: 1 of 2 rows are outside the calibrated range")
    status, out, _ = run(capsys, "apply", "cal.json", "raw.csv", "-o", "out.csv")
    assert (status, out.count("\n")) == (0, 1)
    assert mp.read_readings("out.csv", outputs="f_x").values[0, 0] == written[0]


def test_schemes_lists_all_and_shows_one(here, capsys):
    found = json.loads(run(capsys, "schemes", "--json")[1])
    assert found["model"] == "linear"
    assert {s["name"]: s["positions"] for s in found["schemes"]}["all-26"] == 26
    options = ["--json", "--model", "own-quadratic", "--reading-sd", "2"]
    one, two = json.loads(run(capsys, "schemes", "faces-6", "faces-6+corners-8", *options)[1])[
        "schemes"
    ]
    assert (one["positions"], two["positions"]) == (6, 14)
    assert one["u"]["ax:1"] == pytest.approx(2 / 2)  # the bias is a mean of four
    assert one["u"]["ax:x"] == pytest.approx(2 / np.sqrt(2))
    bad = json.loads(run(capsys, "schemes", "faces-6", "--json", "--model", "ieee")[1])["schemes"][
        0
    ]
    assert not bad["identifiable"]
    assert bad["u"] is None
    assert any("scale_ax" in text for text in bad["unidentifiable"])
    text = run(capsys, "schemes", "song-qin-6")[1]
    assert text.count("\n1 ") == 1
    assert "log det" in text


def test_quiet_prints_no_warnings(here, capsys):
    options = ("fit", "six.csv", "--convention", "gravity")
    assert "multipos: warning:" in run(capsys, *options)[2]
    status, out, err = run(capsys, *options, "-q")
    assert (status, err) == (0, "")
    assert out


def test_interrupted_by_hand(here, capsys, monkeypatch):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("multipos.commands.fit.run", interrupt)
    assert run(capsys, "fit", "six.csv") == (130, "", "multipos: error: interrupted.\n")


def test_help_and_version(capsys):
    for arguments, words in (
        ([], "commands:"),
        (["--help"], "commands:"),
        (["--version"], mp.__version__),
    ):
        status, out, err = run(capsys, *arguments)
        assert (status, err) == (0, "")
        assert words in out
    for command in cli.COMMANDS:
        status, out, _ = run(capsys, command, "--help")
        assert status == 0
        assert "--json" in out
        assert "-o" in out
    _, out, _ = run(capsys, "calibrate", "--help")
    titles = re.findall(r"^(\w.*):$", out, re.MULTILINE)
    parts = ["the log", "the positions", "the model", "the noise", "the readings", "the result"]
    assert titles == ["positional arguments", "options", *parts]


# --- the process


def process(*arguments, **options):
    return subprocess.run(
        [MULTIPOS, *arguments],
        capture_output=True,
        text=True,
        check=False,
        encoding="utf-8",
        **options,
    )


def test_the_program_ends_as_it_says(here):
    good = process("fit", "six.csv")
    assert good.returncode == 0
    assert "scale_ax" in good.stdout
    bad = process("fit", "none.csv")
    assert (bad.returncode, bad.stdout) == (1, "")
    assert (
        bad.stderr == "multipos: error: none.csv: no such file; check the path of the readings.\n"
    )


def test_a_full_disk_and_a_closed_pipe(here):
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full on this system")
    full = subprocess.run(
        f"{MULTIPOS} fit six.csv > /dev/full",
        shell=True,
        capture_output=True,
        text=True,
        check=False,
    )
    assert full.returncode == 1
    said = full.stderr
    assert said == "multipos: error: cannot write to stdout: No space left on device.\n"
    head = subprocess.run(
        f"{MULTIPOS} schemes all-26 | head -n 1",
        shell=True,
        text=True,
        capture_output=True,
        check=True,
    )
    assert head.stdout.startswith("all-26: 26 positions, ")
    assert head.stderr == ""


@pytest.mark.parametrize("encoding", ["ascii", "cp1252", "gbk", "latin-1"])
@pytest.mark.parametrize(
    "line",
    [
        "fit six.csv --json",
        "fit six.csv -o -",
        "apply six.json six.csv",
        "simulate six.json --scheme faces-6",
        "average log.csv -o -",
        "report six.json -o -",
    ],
)
def test_data_on_stdout_are_utf8_whatever_the_locale(line, encoding, here, monkeypatch):
    (here / "six.csv").write_text(SIX.replace("ax,", "äx位,"), encoding="utf-8")
    monkeypatch.setenv("LC_ALL", "C.UTF-8")
    assert process("fit", "six.csv", "-o", "six.json").returncode == 0
    log = mp.simulate_log(mp.load("cal.json"), "faces-6", rate=50, rest=4, sample_sd=1e-3, seed=1)
    mp.write_table("log.csv", {name.replace("ax", "äx位"): values for name, values in log.items()})
    plain = [sys.executable, "-m", "multipos", *line.split()]
    monkeypatch.setenv("LC_ALL", "en_US.ISO-8859-1")
    monkeypatch.setenv("PYTHONIOENCODING", encoding)
    done = subprocess.run(plain, capture_output=True, check=True)
    assert "äx位" in done.stdout.decode("utf-8")
    assert b"\\u" not in done.stdout


def test_text_for_people_is_in_their_encoding(here, monkeypatch):
    (here / "six.csv").write_text(SIX.replace("ax,", "ä位,"), encoding="utf-8")
    monkeypatch.setenv("PYTHONIOENCODING", "latin-1")
    plain = [sys.executable, "-m", "multipos", "fit", "six.csv"]
    done = subprocess.run(plain, capture_output=True, check=True)
    assert b"bias_\xe4\\u4f4d" in done.stdout


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (MultiposError("two\nlines"), 1),
        (UsageError("two\nlines"), 2),
        (KeyboardInterrupt(), 130),
        (MemoryError(), 1),
    ],
)
def test_every_expected_end_is_one_line(error, status, capsys, monkeypatch):
    def raising(argv):
        raise error

    monkeypatch.setattr(cli, "_run", raising)
    assert cli.main(["fit"]) == status
    assert capsys.readouterr().err.count("\n") == 1


def deep(depth):
    return deep(depth + 1)


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        (lambda: 1 // 0, "ZeroDivisionError"),
        (lambda: deep(0), "RecursionError"),
        (lambda: mp.read_readings({"ax": [1]}).values.reshape(7, 7), "ValueError"),
        (lambda: (_ for _ in ()).throw(KeyError("a\nb\x1b")), "KeyError"),
    ],
)
def test_what_nobody_thought_of_is_one_line_too(fault, said, capsys, monkeypatch):
    monkeypatch.setattr(cli, "_run", lambda argv: fault())
    assert cli.main(["fit"]) == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith(f"multipos: error: {said} at cli.py line ")
    assert "report it with this line" in err
    assert err.count("\n") == 1
    assert "\x1b" not in err
    monkeypatch.setenv("MULTIPOS_DEBUG", "1")
    assert cli.main(["fit"]) == 1
    before, line = capsys.readouterr().err.rsplit("multipos: error: ", 1)
    assert before.startswith("Traceback (most recent call last):")
    assert line.startswith(said)


def test_an_error_of_the_system_is_not_called_a_fault(capsys, monkeypatch):
    def raising(argv):
        raise OSError(5, "Input/output error", "log.csv")

    monkeypatch.setattr(cli, "_run", raising)
    assert cli.main(["fit"]) == 1
    assert capsys.readouterr().err.startswith("multipos: error: log.csv: Input/output error; ")


def test_a_warning_of_python_is_one_line(capsys, monkeypatch):
    def overflowing(argv):
        return 0 * bool(np.float64(1e308) * np.float64(1e308))

    monkeypatch.setattr(
        cli, "_run", lambda argv: int(bool(np.float64(1e308) * np.float64(1e308))) - 1
    )
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        assert cli.main(["fit"]) == 0
        assert capsys.readouterr().err == ""
        monkeypatch.setenv("MULTIPOS_DEBUG", "1")
        assert cli.main(["fit"]) == 0
    err = capsys.readouterr().err
    assert re.fullmatch(
        r"multipos: warning: overflow encountered in scalar multiply \(RuntimeWarning at "
        r"test_cli.py line \d+\)\n",
        err,
    )


def shell(command):
    return subprocess.run(
        ["bash", "-c", command.replace("multipos", MULTIPOS, 1)],
        text=True,
        capture_output=True,
        check=False,
    )


def test_closed_streams(here, monkeypatch):
    done = shell("multipos fit six.csv -o new.json >&-")
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == "multipos: error: stdout is closed; send it to a file, or to /dev/null.\n"
    assert not Path("new.json").exists()
    for arguments, status in (("fit none.csv", 1), ("fit", 2), ("apply cal.json six.csv --to", 2)):
        done = shell(f"multipos {arguments} 2>&-")
        assert (done.returncode, done.stdout, done.stderr) == (status, "", "")
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")
    expected = shell("multipos fit six.csv --convention gravity")
    assert "warning" in expected.stderr
    done = shell("multipos fit six.csv --convention gravity 2>&-")
    assert (done.returncode, done.stdout) == (0, expected.stdout)
    assert json.loads(shell("multipos fit six.csv --json <&- 2>&-").stdout)["unit"] == "reading"


# --- control characters

RED = "\x1b[31m\x9b\u202ered"


@pytest.fixture
def red(here, capsys):
    """A calibration, and readings whose first label would turn a terminal red."""
    (here / "six.csv").write_text(SIX, encoding="utf-8")
    run(capsys, "fit", "six.csv", "-o", "cal.json")
    (here / "red.csv").write_text(SIX.replace("\n1,", f"\n{RED},"), encoding="utf-8")
    return "red.csv"


@pytest.mark.parametrize("place", ["\n1,", "E-U-S"])
def test_labels_do_not_reach_the_terminal_as_commands(place, here, capsys):
    (here / "bad.csv").write_text(SIX.replace(place, place.replace("1", RED).replace("E-U-S", RED)))
    status, out, err = run(capsys, "fit", "bad.csv")
    assert (status, out) == (1, "")
    assert r"\u001b[31m\u009b\u202ered" in err
    assert not set("\x1b\x9b\u202e") & set(err)


def test_tables_for_other_programs_have_escapes_too(red, here, capsys):
    _, out, _ = run(capsys, "apply", "cal.json", red)
    assert out.splitlines()[1].startswith(r"\u001b[31m\u009b\u202ered")
    text = (here / red).read_text(encoding="utf-8").replace("position,", "unit,")
    (here / "fleet.csv").write_text(text, encoding="utf-8")
    scheme = ("simulate", "cal.json", "--scheme", red, "-o", "o.csv")
    for command in (scheme, ("fleet", "fleet.csv", "--unit-column", "unit", "-o", "o")):
        status, out, err = run(capsys, *command)
        assert (status, out) == (1, "")
        assert r"'\u001b[31m\u009b\u202ered' has a control character" in err


@pytest.mark.parametrize(
    ("label", "cell"),
    [
        ("=1+1", "'=1+1"),
        ("+cmd|x", "'+cmd|x"),
        ("-2+3", "'-2+3"),
        ("-2-3", "'-2-3"),
        ("-1e-1e-1", "'-1e-1e-1"),
        ("-x+y()", "'-x+y()"),
        ("@SUM(1)", "'@SUM(1)"),
        *((plain, plain) for plain in ("+X up", "-x", "-3", "+1.5e3", "-0.5", "a=b", "'", "it's")),
    ],
)
def test_no_spreadsheet_runs_a_label(here, capsys, label, cell):
    (here / "six.csv").write_text(SIX.replace("\n1,", f"\n{label},"), encoding="utf-8")
    run(capsys, "fit", "six.csv", "-o", "cal.json")
    for command in ("simulate cal.json --scheme six.csv", "apply cal.json six.csv"):
        _, out, _ = run(capsys, *command.split())
        assert out.splitlines()[1].partition(",")[0] == cell
        (here / "again.csv").write_text(out)
        found = mp.read_readings("again.csv", outputs="ax,ay,az").labels
        assert found[0] == label


def test_a_cell_that_nothing_reads_may_be_as_long_as_its_line(here, capsys):
    (here / "six.csv").write_text(SIX.replace("\n1,", "\n=1+1,"), encoding="utf-8")
    run(capsys, "fit", "six.csv", "-o", "cal.json")
    memo = "a" * 140_000
    header, *rows = (here / "six.csv").read_text().splitlines()
    text = "\n".join([f"{header},memo", *(f"{row},{memo}" for row in rows)])
    (here / "long.csv").write_text(text, encoding="utf-8")
    status, out, _ = run(capsys, "apply", "cal.json", "long.csv")
    assert (status, out.count(memo)) == (0, len(rows))
    assert out.splitlines()[1].startswith("'=1+1,")


def test_linear_algebra_has_one_thread_unless_the_user_says_otherwise():
    code = "import multipos.cli, os; print(os.environ.get('OPENBLAS_NUM_THREADS'))"
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    plain = {name: value for name, value in os.environ.items() if name not in names}
    for stated, expected in (({}, "1"), ({"OMP_NUM_THREADS": "2"}, "None")):
        done = subprocess.run(
            [sys.executable, "-c", code], env=plain | stated, capture_output=True, check=True
        )
        assert done.stdout.decode().strip() == expected
