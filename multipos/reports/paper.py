"""A report on paper: the page as PDF, with the number of the report and of the page on every one.

`paper_report` prints it. WeasyPrint lays the page out by its own rules for print; it fetches
nothing, as the page names nothing that is not in it. It is an extra, `multipos[pdf]`; without it an
installed Chromium prints.
"""

import os
import subprocess
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from shutil import which
from tempfile import TemporaryDirectory

from multipos.errors import MultiposError
from multipos.plots.style import COLOURS

_LIBRARY = "weasyprint"
_BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "msedge")
_LONGEST = 300.0  # seconds that a browser may print
_OFTEN = 0.2  # seconds between two words of progress


def paper_report(page: str, progress: Callable[[int], object] = lambda _: None) -> bytes:
    """Return an HTML report as PDF, by WeasyPrint or else by an installed Chromium.

    Parameters
    ----------
    page : str
    progress : callable
        Called again and again while the pages are laid out.

    Raises
    ------
    MultiposError
        Neither is installed, or what there is cannot print; names the way out.
    """
    browser = next(filter(None, map(which, _BROWSERS)), None)
    if find_spec(_LIBRARY) is None and browser is None:
        raise MultiposError(
            f"a PDF is made by {_LIBRARY} or Chromium, and neither is installed; install one with "
            "pip install 'multipos[pdf]', or write a .html file and print that."
        )
    with ThreadPoolExecutor(1) as executor:
        if find_spec(_LIBRARY) is None:
            making = executor.submit(_print_by_browser, str(browser), page)
        else:
            making = executor.submit(_print_by_library, page)
        while not wait((making,), _OFTEN).done:
            progress(0)
        return making.result()


def _print_by_library(page: str) -> bytes:
    for i, colour in enumerate(COLOURS[:7], start=1):  # WeasyPrint has no variables in figures
        page = page.replace(f"var(--c{i})", colour)
    page = page.replace("stroke: var(--paper)", "stroke: #ffffff").replace(
        "currentColor", "#000000"
    )
    try:
        from weasyprint import HTML
    except OSError as error:  # Pango is a library of the system
        raise MultiposError(
            f"{_LIBRARY} cannot start, as a library of the system is missing ({error}); install "
            "Pango, or write a .html file and print that."
        ) from None
    made: bytes = HTML(string=page, url_fetcher=_fetch_nothing).write_pdf()
    return made


def _print_by_browser(program: str, page: str) -> bytes:
    with TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        source, printed = Path(folder, "report.html"), Path(folder, "report.pdf")
        source.write_text(page, encoding="utf-8")
        options = ["--headless", "--disable-gpu", "--no-first-run", "--no-pdf-header-footer"]
        if getattr(os, "geteuid", lambda: 1)() == 0:  # for root Chromium has no sandbox
            options.append("--no-sandbox")
        where = [f"--user-data-dir={folder}/profile", f"--print-to-pdf={printed}", source.as_uri()]
        with suppress(OSError, subprocess.TimeoutExpired):
            command = [program, *options, *where]
            subprocess.run(command, capture_output=True, timeout=_LONGEST, check=False)
        try:
            return printed.read_bytes()
        except OSError:
            raise MultiposError(
                f"{program} printed no PDF; install the extra with pip install 'multipos[pdf]', or "
                "write a .html file and print that."
            ) from None


def _fetch_nothing(url: str) -> dict[str, object]:
    """Refuse whatever a page might name: it holds all that it shows."""
    raise ValueError(f"a report fetches nothing, not {url[:40]}")
