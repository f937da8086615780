"""``multipos page``."""

import argparse
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from multipos.capturing.serving import LOOPBACK
from multipos.commands.answers import Answer, Output, print_out
from multipos.commands.options import declare
from multipos.files.trees import to_json
from multipos.page.runtime import VERSION
from multipos.page.site import check_folder, make_site, write_site
from multipos.page.site_server import PORT, open_server

INPUTS = ()
OUTPUT = Output("DIR", "write the site to DIR, for any host; without it, serve it here", "folder")


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    declare(parser, "page", version=VERSION, port=str(PORT))


def run(arguments: argparse.Namespace) -> Answer:
    """Return what was written, or serve until the process is asked to end."""
    if arguments.output is not None:
        folder = Path(arguments.output)
        check_folder(folder)
        site = make_site(arguments.pyodide)
        write_site(folder, site)
        said = f"Written to {folder}: {len(site.files)} files.\n"
        listed = {"folder": str(folder), "files": sorted(site.files), "findings": ()}
        return Answer(text=lambda: said, json=lambda: to_json(listed))
    with open_server(make_site(arguments.pyodide), arguments.port) as server:
        address = f"http://{LOOPBACK}:{server.server_address[1]}/"
        as_json = to_json({"address": address, "findings": ()})
        print_out([as_json if arguments.json else f"{address}\n"])
        with _until_a_signal():
            server.serve_forever()
    return Answer(text=lambda: "", json=lambda: "")


@contextmanager
def _until_a_signal() -> Iterator[None]:
    """Run the block until a signal ends it: to be asked to end is how a server ends well."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    names = ("SIGINT", "SIGTERM", "SIGHUP")
    numbers = [getattr(signal, name) for name in names if hasattr(signal, name)]
    before = {number: signal.signal(number, signal.default_int_handler) for number in numbers}
    try:
        with suppress(KeyboardInterrupt):
            yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
