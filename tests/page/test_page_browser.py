"""The page in a browser: what a visitor does, what arrives, and whom the browser asks."""

import json
import time
from pathlib import Path

import browser
import numpy as np
import page_runtime
import pytest
from consumers import read_back
from numpy.testing import assert_allclose
from page_visitor import ONLY_THIS_MACHINE, README, STATE, answered, hosted, visit

import multipos as mp
from multipos.page import runtime
from multipos.page.site import make_site, write_site

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(browser.find() is None, reason="no browser"),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return the site, whole, as `multipos page -o` writes it."""
    place = tmp_path_factory.mktemp("site")
    write_site(place, make_site(str(page_runtime.folder())))
    return place


@pytest.fixture(scope="module")
def visitor(folder, tmp_path_factory):
    """Yield a page on which the program has been loaded."""
    scratch = tmp_path_factory.mktemp("browser")
    log = scratch / "net.json"
    options = (ONLY_THIS_MACHINE, f"--log-net-log={log}")
    with hosted(folder) as host, browser.browse(scratch, *options) as page:
        page.net_log, page.host = log, host
        page.downloads = scratch / "downloads"
        page.call(
            "Browser.setDownloadBehavior",
            session=None,
            behavior="allow",
            downloadPath=str(page.downloads),
        )
        visit(page, host.address)
        yield page


def put(page, *paths):
    """Choose files, as by the dialog."""
    found = page.call("Runtime.evaluate", expression="document.getElementById('file')")
    page.evaluate(f"{STATE} = 'asked'")
    page.call(
        "DOM.setFileInputFiles", files=list(map(str, paths)), objectId=found["result"]["objectId"]
    )
    return page.wait(f"['done', 'error'].includes({STATE}) && {STATE}")


def parameters(page):
    rows = page.evaluate(
        "[...document.querySelectorAll('#parameters tr[data-name]')].map(r => "
        "[r.dataset.name, r.dataset.value, r.dataset.expanded, "
        "...[...r.cells].map(c => c.innerText)])"
    )
    return {row[0]: row[1:] for row in rows}


def text(page, name):
    return page.evaluate(f"document.getElementById({name!r}).innerText")


def fetch(page, form):
    """Press a button that downloads, and return the file."""
    before = set(page.downloads.glob("*")) if page.downloads.exists() else set()
    page.evaluate(f"document.querySelector({form!r}).click()")
    end = time.monotonic() + 300
    while time.monotonic() < end:
        new = set(page.downloads.glob("*")) - before if page.downloads.exists() else set()
        done = [path for path in new if path.suffix != ".crdownload"]
        if done and not page.evaluate(f"{STATE} === 'error'"):
            return done[0]
        if page.evaluate(f"{STATE} === 'error'"):
            raise AssertionError(text(page, "error"))
        time.sleep(0.05)
    raise AssertionError(f"no download of {form}")


def test_the_example_gives_the_digits_of_the_program(visitor, tmp_path):
    assert answered(visitor, "document.getElementById('example').click()") == "done"
    assert visitor.evaluate("document.getElementById('rows').value") == README
    (tmp_path / "readings.csv").write_text(README)
    expected = mp.fit(tmp_path / "readings.csv", unit="g")
    shown = parameters(visitor)
    assert list(shown) == list(expected.names)
    scale = [abs(float(shown[p.name][0]) - p.value) for p in expected.entries]
    assert max(scale) < 1e-12
    assert shown["scale_ax"][2:] == ["scale_ax", "0.9965", "0.0092", "1"]
    assert " from 6 positions" in text(visitor, "answer")
    codes = "[...document.querySelectorAll('#findings li')].map(li => li.dataset.code)"
    assert "hidden-terms" in visitor.evaluate(codes)
    marks = "document.querySelectorAll('#positions .mark').length"
    assert visitor.evaluate(marks) == 6 + 3
    assert visitor.complaints() == []


def test_each_download_is_what_the_commands_write(visitor, tmp_path):
    answered(visitor, "document.getElementById('example').click()")
    (tmp_path / "readings.csv").write_text(README)
    expected = mp.fit(tmp_path / "readings.csv", unit="g")
    saved = mp.load(fetch(visitor, "[data-download=json]"))
    assert_allclose(saved.parameters, expected.parameters, rtol=0, atol=1e-12)
    assert_allclose(saved.covariance, expected.covariance, rtol=1e-9, atol=1e-18)
    code = fetch(visitor, "[data-download=c]")
    assert code.read_text(encoding="utf-8") == mp.export(saved, "c").text
    again = mp.fit(fetch(visitor, "[data-download=readings]"), unit="g")
    assert_allclose(again.parameters, expected.parameters, rtol=0, atol=1e-12)
    report = fetch(visitor, "[data-download=md]").read_text(encoding="utf-8")
    assert report.startswith("# Calibration report")
    for form in ("px4", "ardupilot"):  # which have no place for the cross-axis terms
        visitor.wait(f"!!document.querySelector('[data-accept={form}]')")
        assert "from 5.42 to 6.96 mg" in text(visitor, "refused")
        with pytest.raises(AssertionError, match=f"{form} cannot express"):
            fetch(visitor, f"[data-download={form}]")
        answered(visitor, "document.getElementById('calibrate').click()")
        visitor.wait(f"!!document.querySelector('[data-accept={form}]')")
        made = fetch(visitor, f"[data-accept={form}]")
        assert read_back(made, saved).target == form


def test_hand_held_rows_and_a_raw_log(visitor, tmp_path):
    sensor = mp.demo().calibration
    run = mp.simulate(sensor, "all-26", reading_sd=1e-4, seed=2)
    mp.write_table(tmp_path / "hand.csv", {name: run[name] for name in ("ax", "ay", "az")})
    assert put(visitor, tmp_path / "hand.csv") == "done"
    saved = mp.load(fetch(visitor, "[data-download=json]"))
    expected = mp.fit(tmp_path / "hand.csv", unit="g", unknown_orientation=True)
    assert (np.abs(saved.parameters - expected.parameters) < 1e-9 * expected.u).all()
    assert saved.readings.source == "hand.csv"
    code = fetch(visitor, "[data-download=c]")
    assert code.read_text(encoding="utf-8") == mp.export(saved, "c").text
    log = mp.simulate_log(sensor, "all-26", rate=50, rest=4, sample_sd=1e-3, seed=1)
    mp.write_table(tmp_path / "log.csv", log)
    assert put(visitor, tmp_path / "log.csv") == "done"
    assert " from 26 hand-held positions" in text(visitor, "answer")
    expected = mp.calibrate(tmp_path / "log.csv")
    found = np.array([float(row[0]) for row in parameters(visitor).values()])
    assert (np.abs(found - expected.parameters) < 1e-9 * expected.u).all()


def test_an_option_in_an_action_is_said_to_be_the_command_line_s(visitor, tmp_path):
    run = mp.simulate(mp.demo().calibration, "all-26", reading_sd=1e-4, seed=2)
    columns = {name: run[name].copy() for name in ("ax", "ay", "az")}
    columns["ax"][3] += 0.05
    mp.write_table(tmp_path / "hand.csv", columns)
    assert put(visitor, tmp_path / "hand.csv") == "done"
    said = text(visitor, "findings")
    assert "--model" in said
    assert "Options (--…) are those of the command line" in said


def test_a_file_that_is_dropped(visitor):
    drop = (
        "const data = new DataTransfer(); "
        f"data.items.add(new File([{README!r}], 'mine.csv')); "
        "document.body.dispatchEvent(new DragEvent('drop', "
        "{ dataTransfer: data, bubbles: true, cancelable: true }));"
    )
    assert answered(visitor, f"(() => {{ {drop} }})()") == "done"
    assert fetch(visitor, "[data-download=json]").name.startswith("mine")


def test_the_newest_request_counts(visitor, tmp_path):
    """Rows that were written by a program are taken, and what was asked before is not shown."""
    (tmp_path / "r.csv").write_text(README)
    put(visitor, tmp_path / "r.csv")
    six = README.replace("position,direction,ax,ay,az", "bx,by,bz").replace("\n", "\n;").split(";")
    rows = "".join(row.split(",", 2)[-1] if "," in row[:2] else row for row in six)
    action = (
        "document.getElementById('calibrate').click(); "
        f"document.getElementById('rows').value = {rows!r}; "
        "document.getElementById('calibrate').click()"
    )
    assert answered(visitor, action) == "done"
    assert text(visitor, "answer").startswith("bx, by, bz calibrated from 6 positions")


def test_wrong_files_are_answered_in_the_words_of_the_program(visitor, tmp_path):
    (tmp_path / "bad.csv").write_text("ax,ay,az\n1,2,x\n")
    assert put(visitor, tmp_path / "bad.csv") == "error"
    with pytest.raises(mp.MultiposError) as caught:
        mp.read_readings(tmp_path / "bad.csv")
    assert text(visitor, "error") == str(caught.value).replace(f"{tmp_path}/", "")
    assert "--outputs" in text(visitor, "error")  # which the page has as a field
    assert text(visitor, "status").startswith("What --unit and --outputs say is chosen above")
    assert visitor.evaluate("document.getElementById('result').hidden")
    for name, content in (("empty.csv", b""), ("picture.png", b"\x89PNG\r\n\x1a\n\0\0" * 99)):
        (tmp_path / name).write_bytes(content)
        assert put(visitor, tmp_path / name) == "error"
        assert text(visitor, "error").startswith(name)
    large = "new File(Array(200).fill(new Uint8Array(1e6)), 'flight.csv')"
    drop = (
        f"const data = new DataTransfer(); data.items.add({large}); "
        "document.body.dispatchEvent(new DragEvent('drop', "
        "{ dataTransfer: data, bubbles: true, cancelable: true }));"
    )
    assert answered(visitor, f"(() => {{ {drop} }})()") == "error"
    assert text(visitor, "error").startswith("flight.csv has 200 MB, and this page takes 100 MB")
    # and after all of that it still works
    assert answered(visitor, "document.getElementById('example').click()") == "done"
    assert text(visitor, "error") == ""


def test_a_million_rows(visitor, tmp_path):
    log = mp.simulate_log(
        mp.demo().calibration, "all-26", rate=100, rest=384, sample_sd=1e-3, seed=1
    )
    columns = np.column_stack([log[name] for name in ("time", "ax", "ay", "az")])
    assert len(columns) > 1_000_000
    path = tmp_path / "long.csv"
    np.savetxt(path, columns, fmt="%.5f", delimiter=",", header="time,ax,ay,az", comments="")
    assert put(visitor, path) == "done"
    assert " from 26 hand-held positions" in text(visitor, "answer")


def test_plan_and_apply(visitor, tmp_path):
    visitor.evaluate("location.hash = '#plan'")
    visitor.wait("document.getElementById('plan').open")
    assert answered(visitor, "document.getElementById('plan-make').click()") == "done"
    scheme = mp.read_scheme(fetch(visitor, "[data-download=scheme]"))
    rows = visitor.evaluate("document.querySelectorAll('#plan-table tbody tr').length")
    assert len(scheme) == rows == 12
    answered(visitor, "document.getElementById('example').click()")
    (tmp_path / "raw.csv").write_text("ax,ay,az\n0.0067,-0.006,-1.0008\n")
    found = visitor.call("Runtime.evaluate", expression="document.getElementById('apply-log')")
    visitor.call(
        "DOM.setFileInputFiles",
        files=[str(tmp_path / "raw.csv")],
        objectId=found["result"]["objectId"],
    )
    assert answered(visitor, "document.getElementById('apply-make').click()") == "done"
    applied = mp.read_table(fetch(visitor, "[data-download=applied]"))
    (tmp_path / "readings.csv").write_text(README)
    own = mp.apply(mp.fit(tmp_path / "readings.csv", unit="g"), tmp_path / "raw.csv")
    for name in ("f_x", "f_y", "f_z"):
        assert_allclose(applied.numbers(name), own[name], atol=1e-9)


def test_it_works_with_a_keyboard_alone(visitor):
    visit(visitor, visitor.host.address)

    def press(key, code=0, text=""):
        for kind in ("keyDown", "keyUp"):
            more = {"text": text} if text and kind == "keyDown" else {}
            visitor.call(
                "Input.dispatchKeyEvent", type=kind, key=key, windowsVirtualKeyCode=code, **more
            )

    def reach(condition):
        for _ in range(60):
            if visitor.evaluate(f"!!document.activeElement.matches({condition!r})"):
                return
            press("Tab", 9)
        raise AssertionError(f"no way to {condition}")

    reach("#rows")
    visitor.call("Input.insertText", text=README)
    visitor.evaluate(f"{STATE} = 'asked'")
    reach("#calibrate")
    press("Enter", 13, "\r")
    assert visitor.wait(f"['done', 'error'].includes({STATE}) && {STATE}") == "done"
    assert visitor.evaluate("document.activeElement.id") == "answer"
    reach("#positions")
    before = visitor.evaluate("document.getElementById('positions').innerHTML")
    press("ArrowLeft", 37)
    assert visitor.evaluate("document.getElementById('positions').innerHTML") != before
    reach("[data-download=json]")
    reach("summary")
    press("Enter", 13, "\r")
    assert visitor.wait("document.getElementById('plan').open")


@pytest.mark.parametrize("dark", [False, True])
def test_it_fits_a_telephone_and_is_accessible(visitor, dark):
    answered(visitor, "document.getElementById('example').click()")
    visitor.evaluate("for (const each of document.querySelectorAll('details')) each.open = true")
    answered(visitor, "document.getElementById('plan-make').click()")
    try:
        for width in (390, 1200):
            visitor.size(width, dark=dark)
            assert visitor.evaluate("document.documentElement.scrollWidth") <= width
            visitor.evaluate(page_runtime.axe())
            found = visitor.evaluate("axe.run().then(found => JSON.stringify(found.violations))")
            bad = [
                (each["id"], [node["html"] for node in each["nodes"]])
                for each in json.loads(found)
                if each["impact"] in ("serious", "critical")
            ]
            assert bad == []
    finally:
        visitor.size(1200)


def test_the_policy_keeps_out_what_is_not_the_site_s(visitor):
    tried = visitor.evaluate(
        """(async () => {
        const script = document.createElement("script");
        script.textContent = "window.inline = 1";
        document.body.append(script);
        const asked = await fetch("https://example.org/").then(() => "asked", () => "refused");
        let computed = "refused";
        try { setTimeout("window.evaluated = 1"); await new Promise(r => setTimeout(r, 50)); }
        catch { /* some browsers throw */ }
        const worker = await fetch("worker.js");
        return [window.inline ?? null, window.evaluated ?? null, asked,
            worker.headers.get("Content-Security-Policy")];
        })()"""
    )
    assert tried[:3] == [None, None, "refused"]
    assert "connect-src 'self';" in tried[3]
    visitor.events.clear()


def test_a_site_in_a_folder_its_newer_one_and_neither_host(folder, tmp_path):
    """A runtime from another host; a newer site, taken whole by the visit after the next; offline.

    One browser: each visit that loads the runtime takes seconds.
    """
    place = tmp_path / "tools" / "page"
    base = "self.SITE.runtime.base"
    with hosted(folder / "runtime") as other, hosted(tmp_path) as host:
        address = f"{host.address}tools/page/"
        write_site(place, make_site(other.address))
        with browser.browse(tmp_path, ONLY_THIS_MACHINE) as page:
            visit(page, address)
            assert other.address.rstrip("/") in text(page, "host")
            assert answered(page, "document.getElementById('example').click()") == "done"
            policy = page.evaluate(
                "fetch('worker.js').then(found => found.headers.get('Content-Security-Policy'))"
            )
            assert f"connect-src 'self' {other.address.rstrip('/')};" in policy
            assert sorted(other.asked) == sorted(f"/{name}" for name in runtime.FILES)
            write_site(place, make_site(str(folder / "runtime")))
            visit(page, f"{address}?while-it-is-fetched")
            assert page.evaluate(base) == other.address
            waiting = "navigator.serviceWorker.getRegistration().then(found => !!found.waiting)"
            page.wait(waiting)
            visit(page, f"{address}?newer")
            page.wait(f"{base} === 'runtime/' && {STATE} === 'ready'")
            host.stop()
            visit(page, f"{address}?offline")
            assert answered(page, "document.getElementById('example').click()") == "done"
            assert next(iter(parameters(page))) == "bias_ax"


def test_a_file_with_another_hash_is_refused_by_name(folder, tmp_path):
    place = tmp_path / "site"
    for path in folder.rglob("*"):
        target = place / path.relative_to(folder)
        target.parent.mkdir(parents=True, exist_ok=True)
        if path.is_file():
            target.write_bytes(path.read_bytes())
    changed = place / "runtime" / "pyodide.asm.js"
    changed.write_bytes(changed.read_bytes() + b"\n//")
    with hosted(place) as host, browser.browse(tmp_path, ONLY_THIS_MACHINE) as page:
        page.size(1200)
        page.call("Page.navigate", url=host.address)
        page.wait("document.documentElement?.dataset.state === 'error'")
        page.wait("document.getElementById('error').innerText.includes('hash')")
        assert "pyodide.asm.js is not the file that belongs here" in text(page, "error")


def test_nobody_else_was_asked(visitor):
    """Runs last: the browser's own log of all that went through its network."""
    answered(visitor, "document.getElementById('example').click()")
    own, asked = visitor.host.address.rstrip("/"), set()
    what_workers_ask = f"{own}/runtime/pyodide.asm.wasm"
    for _ in range(200):  # until it is written
        time.sleep(1.5)
        for line in Path(visitor.net_log).read_text(encoding="utf-8").splitlines():
            # The browser has errands of its own, which no page has begun.
            if f'"initiator":"{own}"' in line and '"url":"' in line:
                asked.add(line.split('"url":"')[1].split('"')[0])
        if what_workers_ask in asked:
            break
    assert what_workers_ask in asked
    assert {address for address in asked if not address.startswith(f"{own}/")} == set()
