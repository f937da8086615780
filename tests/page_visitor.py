"""A visitor of the page: a host for the site, and a browser that goes there."""

import contextlib
import functools
import http.server
import threading

README = """position,direction,ax,ay,az
1,E-U-S,0.0071,1.0029,-0.0016
2,E-N-U,-0.0094,-0.0058,1.0008
3,D-E-S,-0.9965,0.0064,0.0015
4,W-D-S,-0.0076,-1.0030,0.0032
5,U-W-S,0.9965,0.0073,0.0027
6,S-W-D,0.0067,-0.0060,-1.0008
"""
STATE = "document.documentElement.dataset.state"
ONLY_THIS_MACHINE = "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1"


class Host:
    """A plain web server on a folder, as `python -m http.server` is."""

    def __init__(self, folder):
        self.asked = []
        handler = functools.partial(Quiet, self.asked, directory=str(folder))
        self.server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
        self.thread = threading.Thread(target=self.server.serve_forever)
        self.thread.start()
        self.address = f"http://127.0.0.1:{self.server.server_address[1]}/"

    def stop(self):
        self.server.shutdown()
        self.thread.join()
        self.server.server_close()


class Quiet(http.server.SimpleHTTPRequestHandler):
    def __init__(self, asked, *rest, **more):
        self.asked = asked
        super().__init__(*rest, **more)

    def end_headers(self):
        self.asked.append(self.path)
        self.send_header("Access-Control-Allow-Origin", "*")
        super().end_headers()

    def log_message(self, format, *args):
        pass


@contextlib.contextmanager
def hosted(folder):
    host = Host(folder)
    try:
        yield host
    finally:
        with contextlib.suppress(OSError):
            host.stop()


def visit(page, address):
    page.size(1200)
    page.events.clear()
    page.call("Page.navigate", url=address)
    # It is the old document that answers until the new one is there.
    ready = "document.documentElement?.dataset.state === 'ready'"
    page.wait(f"location.href === {address!r} && {ready}")


def answered(page, action):
    """Do something, and return how it ended."""
    page.evaluate(f"{STATE} = 'asked'; {action}")
    return page.wait(f"['done', 'error'].includes({STATE}) && {STATE}")
