"""The page of a guided session: who is let in, and that it shows what the state says."""

import http.client
import json
import socket
import threading
import time

import browser
import log_bench
import pytest

from multipos.capturing.running import make_plan, make_reading, run_session
from multipos.capturing.serving import serve
from multipos.capturing.session import Session
from multipos.capturing.sources import open_source


class Live:
    """A session on a log that grows, and its server."""

    def __init__(self, folder, target=()):
        columns = log_bench.columns_of(scheme="all-26", seed=3)
        whole = log_bench.write_csv(folder / "whole.csv", columns)
        self.rows = whole.read_text().splitlines(keepends=True)
        self.log = folder / "growing.csv"
        self.log.write_text("".join(self.rows[:6500]))
        plan = make_plan(target, None, None, {})
        self.session = Session(plan, make_reading(None, None, None, None, None, None))
        self.thread = threading.Thread(target=self._run)
        self.address = ""
        self.ready = threading.Event()
        self.thread.start()
        assert self.ready.wait(300)
        self.port = int(self.address.rsplit(":", 1)[1].rstrip("/"))

    def _run(self):
        with serve(self.session, 0, default=0) as self.address:
            self.ready.set()
            run_session(self.session, open_source(str(self.log)))

    def grow(self, first, last):
        with self.log.open("a") as stream:
            stream.write("".join(self.rows[first:last]))

    def ask(self, method, path, headers=None, body=None):
        """Return status, headers and body."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=300)
        connection.request(method, path, body, headers or {})
        answer = connection.getresponse()
        found = answer.status, dict(answer.getheaders()), answer.read()
        connection.close()
        return found

    def state(self):
        return json.loads(self.ask("GET", "/state")[2])

    def wait(self, condition):
        for _ in range(6000):
            found = self.state()
            if condition(found):
                return found
            time.sleep(0.05)
        raise AssertionError(found)

    def end(self):
        self.session.asked_to_finish = True
        self.thread.join(300)


@pytest.fixture(scope="module")
def live(tmp_path_factory):
    found = Live(tmp_path_factory.mktemp("live"), ["bias=0.0001"])
    yield found
    found.end()


def test_only_this_machine_and_this_page_are_let_in(live):
    own = f"127.0.0.1:{live.port}"
    for host in (own, f"localhost:{live.port}", "[::1]:80", "LOCALHOST", "127.0.0.1"):
        assert live.ask("GET", "/state", {"Host": host})[0] == 200, host
        assert live.ask("GET", "/state", {"Host": host, "Origin": f"http://{host}"})[0] == 200
    for host in (
        "evil.example",
        "127.0.0.1.evil.example",
        "localhost.evil",
        "127.0.0.2",
        "",
        "[::]",
    ):
        for path in ("/", "/state", "/events"):
            assert live.ask("GET", path, {"Host": host})[0] == 403, (host, path)
    for origin in (
        "http://evil.example",
        "null",
        f"https://{own}",
        "http://127.0.0.1:1",
        "file://",
    ):
        for method, path in (("GET", "/"), ("GET", "/events"), ("POST", "/undo")):
            assert live.ask(method, path, {"Host": own, "Origin": origin})[0] == 403, origin


def test_an_image_on_another_site_holds_no_stream(live):
    own = f"127.0.0.1:{live.port}"
    for site, status in (
        ("same-origin", 200),
        ("none", 200),
        ("cross-site", 403),
        ("same-site", 403),
    ):
        assert live.ask("GET", "/state", {"Host": own, "Sec-Fetch-Site": site})[0] == status
    assert live.ask("GET", "/events", {"Host": own, "Sec-Fetch-Site": "cross-site"})[0] == 403


def test_two_hosts_or_none_are_not_let_in(live):
    for head in (
        b"GET / HTTP/1.1\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: localhost\r\nHost: x\r\n\r\n",
    ):
        with socket.create_connection(("127.0.0.1", live.port), timeout=300) as connection:
            connection.sendall(head)
            assert b" 403 " in connection.recv(1000)


def test_headers_keep_everything_else_out(live):
    for path in ("/", "/state", "/nothing"):
        _, headers, _ = live.ask("GET", path)
        assert not [name for name in headers if name.lower().startswith("access-control")]
        policy = headers["Content-Security-Policy"]
        assert policy.startswith("default-src 'none'")
        assert "http" not in policy
        assert "unsafe" not in policy
        assert headers["X-Content-Type-Options"] == "nosniff"


def test_no_path_reaches_the_files(live):
    for path in (
        "/page.html",
        "/../page.html",
        "/etc/passwd",
        "/%2e%2e/x",
        "//etc/passwd",
        "/state/",
    ):
        assert live.ask("GET", path)[0] == 404, path
    for path in ("/", "/undo/1", "/redo/", "/finish/now", "/../finish"):
        assert live.ask("POST", path)[0] == 404, path
    assert live.ask("OPTIONS", "/")[0] == 501
    assert live.ask("PUT", "/state")[0] == 501


def test_bodies_are_bounded(live):
    assert live.ask("POST", "/undo", {"Content-Length": "5000"})[0] == 413
    assert live.ask("POST", "/undo", {"Content-Length": "-1"})[0] == 413
    assert live.ask("POST", "/undo", {"Transfer-Encoding": "chunked"})[0] == 411


def test_it_listens_on_loopback_alone(live):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # nothing is sent: it names the outer address
        except OSError:
            pytest.skip("no network")
        outer = probe.getsockname()[0]
    if outer.startswith("127."):
        pytest.skip("no other address")
    with pytest.raises(OSError, match=r".*"), socket.create_connection((outer, live.port), 2):
        pass


def test_two_streams_see_the_same(live):
    live.wait(lambda state: len(state["taken"]) == 11)  # all that the log has so far
    seen = []
    for _ in range(2):
        connection = http.client.HTTPConnection("127.0.0.1", live.port, timeout=300)
        connection.request("GET", "/events")
        answer = connection.getresponse()
        assert answer.getheader("Content-Type") == "text/event-stream"
        assert answer.getheader("Connection") == "close"
        assert answer.readline() == b"event: state\n"
        seen.append(json.loads(answer.readline().removeprefix(b"data: ")))
        connection.close()
    assert seen[0]["taken"] == seen[1]["taken"]


class _Address:
    """An address, as `browser.Page.open` takes it."""

    def __init__(self, address):
        self._address = address

    def as_uri(self):
        return self._address


SHOWN = """JSON.stringify({
 taken: [...document.querySelectorAll('#taken li')]
  .map(e => [e.dataset.position, e.dataset.accepted]),
 parameters: [...document.querySelectorAll('#parameters tbody tr')]
  .map(e => [e.dataset.name, e.cells[2].textContent, e.querySelector('.bar.met') !== null,
   e.cells[1].textContent]),
 words: document.getElementById('words').textContent,
 gain: document.getElementById('gain').textContent,
 wide: document.documentElement.scrollWidth <= window.innerWidth})"""


@pytest.mark.skipif(browser.find() is None, reason="no Chromium")
def test_the_page_shows_what_the_state_says(tmp_path):
    live = Live(tmp_path, ["bias=0.00001"])
    try:
        live.wait(lambda state: len(state["taken"]) >= 10)
        with browser.browse(tmp_path) as page:
            page.open(_Address(live.address), width=390, dark=True)
            live.grow(6500, 12000)
            state = live.wait(lambda state: len(state["taken"]) >= 20)
            shown = settled(page, state)
            assert shown["words"] == state["next"]["words"]
            assert float(shown["gain"].split()[1]) == pytest.approx(state["next"]["gain"], rel=1e-2)
            for (name, text, met, value), entry in zip(
                shown["parameters"], state["parameters"], strict=True
            ):
                u_shown = in_its_unit(text)
                assert name == entry["name"]
                assert u_shown == pytest.approx(entry["U"], rel=0.05)
                assert in_its_unit(value) == pytest.approx(entry["value"], abs=0.06 * u_shown)
                assert met == bool(entry["met"])
            assert shown["wide"]
            page.evaluate("document.getElementById('undo').click()")
            state = live.wait(lambda state: not state["taken"][-1]["accepted"])
            settled(page, state)
            page.evaluate("dispatchEvent(new KeyboardEvent('keydown', {key: 'f'}))")
            page.evaluate("dispatchEvent(new KeyboardEvent('keydown', {key: 'f'}))")
            live.thread.join(300)
            assert live.session.finished
            wait_for(page, "document.getElementById('status').textContent === 'Finished'")
            assert page.complaints() == []
            outside = [url for url in page.requests() if not url.startswith(live.address)]
            assert outside == []
    finally:
        live.end()


def in_its_unit(text):
    """The number that a cell shows, in g, or as it is where it is a ratio."""
    number, _, unit = text.replace("−", "-").partition(" ")
    return float(number) * {"": 1.0, "g": 1.0, "mg": 1e-3, "µg": 1e-6, "ppm": 1e-6}[unit]


def settled(page, state):
    """What the page shows, once it shows as many poses as the state has."""
    expected = [[p["position"], str(p["accepted"]).lower()] for p in reversed(state["taken"])]
    for _ in range(6000):
        shown = json.loads(page.evaluate(SHOWN))
        if shown["taken"] == expected:
            return shown
        time.sleep(0.05)
    raise AssertionError((shown, expected))


def wait_for(page, condition):
    for _ in range(6000):
        if page.evaluate(condition):
            return
        time.sleep(0.05)
    raise AssertionError(condition)
