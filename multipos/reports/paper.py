"""A report on paper: the page as PDF, with the number of the report and of the page on every one.

WeasyPrint lays the page out by its own rules for print; it fetches nothing, as the page names
nothing that is not in it. It is an extra, `multipos[pdf]`.
"""

from importlib.util import find_spec

from multipos.errors import MultiposError

_LIBRARY = "weasyprint"


def paper_report(page: str) -> bytes:
    """Return an HTML report as PDF.

    Raises
    ------
    MultiposError
        The library is not installed or lacks what it needs of the system; names the way out.
    """
    if find_spec(_LIBRARY) is None:
        raise MultiposError(
            f"a PDF is made by {_LIBRARY}, which is not installed; install it with pip install "
            "'multipos[pdf]', or write a .html file and print that."
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


def _fetch_nothing(url: str) -> dict[str, object]:
    """Refuse whatever a page might name: it holds all that it shows."""
    raise ValueError(f"a report fetches nothing, not {url[:40]}")
