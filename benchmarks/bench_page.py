"""What a visitor of the page waits for, against a bare page with the same runtime.

The bare page loads Pyodide, NumPy and the package, and fits the same readings; it draws nothing,
checks no hash and keeps nothing. Each pair has fresh profiles of a browser, on one host. Needs
Chromium and the runtime that `python tests/page_runtime.py` fetches.
"""

import statistics
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.timing import Ratio
from multipos.page import runtime
from multipos.page.site import make_site, write_site
from multipos.page.wheel import NAME

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

import browser
import page_runtime
from page_visitor import ONLY_THIS_MACHINE, README, STATE, Host, hosted

PAIRS = 5
DONE = "document.documentElement?.dataset.state === 'done'"
PRESSABLE = "document.readyState === 'complete' && !!document.getElementById('example')?.onclick"
BARE = f"""<!doctype html><html><body><script type="module">
const {{ loadPyodide }} = await import("./runtime/pyodide.mjs");
const pyodide = await loadPyodide({{ indexURL: "./runtime/", lockFileURL: "./pyodide-lock.json" }});
const packages = ["runtime/{runtime.NUMPY}", "{NAME}"];
await pyodide.loadPackage(packages.map(name => new URL(name, location).href));
pyodide.FS.writeFile("readings.csv", `{README}`);
document.body.textContent = pyodide.runPython(`
import multipos as mp
str(mp.fit("readings.csv", unit="g").to_dict())`);
document.documentElement.dataset.state = "done";
</script></body></html>
"""
SECOND_FIT = f"""(async () => {{
const start = performance.now();
document.getElementById("calibrate").click();
while ({STATE} !== "done") await new Promise(resolve => setTimeout(resolve, 1));
return performance.now() - start;
}})()"""


def run() -> list[Ratio]:
    if browser.find() is None or not (page_runtime.FOLDER / runtime.NUMPY).is_file():
        print("page: no browser, or no runtime")
        return []
    first, second, again = [], [], []
    with tempfile.TemporaryDirectory() as folder:
        write_site(Path(folder), make_site(str(page_runtime.FOLDER)))
        Path(folder, "bare.html").write_text(BARE, encoding="utf-8")
        with hosted(Path(folder)) as host:
            for _ in range(PAIRS):
                ours, later, fit = visits(host)
                bare = bare_visit(host)
                first.append(ours / bare)
                second.append(later / ours)
                again.append(fit / 0.1)
    return [
        Ratio("page, first result", "a bare page", first, 1.4),
        Ratio("page, second visit", "the first", second, 1.1),
        Ratio("page, second fit", ".1 s", again, 1.0),
    ]


def visits(host: Host) -> tuple[float, float, float]:
    """Return the times [s] to the first result, to that of a second visit, and of one more fit."""
    with (
        tempfile.TemporaryDirectory() as profile,
        browser.browse(Path(profile), ONLY_THIS_MACHINE) as page,
    ):
        page.size(1200)
        first = _to_result(page, host.address)
        time.sleep(1.0)
        second = _to_result(page, f"{host.address}?second")
        time.sleep(1.0)
        fits = [page.evaluate(SECOND_FIT) / 1e3 for _ in range(5)]
    return first, second, statistics.median(fits)


def bare_visit(host: Host) -> float:
    """Return the time [s] to the result of the bare page."""
    with (
        tempfile.TemporaryDirectory() as profile,
        browser.browse(Path(profile), ONLY_THIS_MACHINE) as page,
    ):
        start = time.perf_counter()
        page.call("Page.navigate", url=f"{host.address}bare.html")
        page.wait(DONE)
        return time.perf_counter() - start


def _to_result(page: browser.Page, address: str) -> float:
    start = time.perf_counter()
    page.call("Page.navigate", url=address)
    page.wait(f"location.href === {address!r} && {PRESSABLE}")
    page.evaluate("document.getElementById('example').click()")
    page.wait(DONE)
    return time.perf_counter() - start
