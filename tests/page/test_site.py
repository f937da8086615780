"""The files of the site: whole, known by their hashes, and only where they may be."""

import gzip
import http.client
import os
import re
import signal
import subprocess
import sys
import zipfile
from pathlib import Path

import page_runtime
import pytest

import multipos as mp
from multipos.cli import main
from multipos.page import runtime, site

PACKAGE = Path(site.__file__).parents[1]
SCRIPTS = [*(PACKAGE / "page").glob("*.js"), PACKAGE / "capturing" / "drawing.js"]


@pytest.fixture(scope="module")
def made():
    return site.make_site()


def test_the_wheel_is_the_same_every_time_and_installs(tmp_path):
    raw = site.make_wheel()
    assert raw == site.make_wheel()
    path = tmp_path / site.NAME
    path.write_bytes(raw)
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index"]
    subprocess.run([*command, "--target", str(tmp_path / "site"), str(path)], check=True)
    code = "import multipos as mp; print(mp.__file__, mp.demo().calibration['scale_ax'].value)"
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONPATH": str(tmp_path / "site")},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    place, value = done.stdout.split()
    assert place == str(tmp_path / "site" / "multipos" / "__init__.py")
    assert float(value) == mp.demo().calibration["scale_ax"].value
    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
    assert "multipos/page/visit.py" in names
    assert not [name for name in names if name.endswith(".js") or "/capturing/" in name]


def test_every_own_file_is_named_with_its_hash(made):
    text = made.files["site.js"].decode()
    for name, raw in made.files.items():
        if name not in ("site.js", "sw.js"):
            assert f'"{name}": "{runtime.integrity(runtime.sha256(raw))}"' in text
    asked = set(re.findall(r'(?:src|href)="([^"#]+)"', made.files["index.html"].decode()))
    asked |= set(re.findall(r'"\./([\w.]+)"', b"".join(made.files.values()).decode("latin-1")))
    assert asked <= made.files.keys()


def test_the_page_and_its_own_part_are_small(made):
    own = sum(len(gzip.compress(raw)) for raw in made.files.values())
    assert own < 1.2e6
    lines = sum(len(path.read_text(encoding="utf-8").splitlines()) for path in SCRIPTS)
    assert lines <= 900
    assert max(len(line) for path in SCRIPTS for line in path.read_text("utf-8").splitlines()) < 160


def test_the_whole_with_its_runtime_is_below_ten_megabytes(made):
    folder = page_runtime.folder()
    whole = site.make_site(str(folder)).files
    assert {f"runtime/{name}" for name in runtime.FILES} == whole.keys() - made.files.keys()
    assert sum(len(gzip.compress(raw)) for raw in whole.values()) < 10.2e6


def test_policies_name_the_site_and_the_runtime_and_no_inline_script(made):
    host = "https://cdn.jsdelivr.net"
    assert f"connect-src 'self' {host};" in made.policies["page"]
    assert f"script-src 'self' {host} 'wasm-unsafe-eval';" in made.policies["worker"]
    for policy in made.policies.values():
        assert policy.startswith("default-src 'none'; ")
        assert "unsafe-inline" not in policy
        assert "'unsafe-eval'" not in policy
    page = made.files["index.html"].decode()
    assert "<script>" not in page
    assert "style=" not in page
    assert "{policy}" not in page
    assert f'data-host="{host}"' in page


@pytest.mark.parametrize(
    "address", ["https://a b/", "ftp://x/", "https:///x/", "https://x/?q=1", "http://x;y/"]
)
def test_an_address_that_no_policy_can_name_is_refused(address):
    with pytest.raises(mp.UsageError, match="give a folder, or an address"):
        site.make_site(address)


def test_a_folder_that_holds_other_files_is_refused_and_its_own_is_renewed(tmp_path, capsys):
    other = tmp_path / "other"
    other.mkdir()
    (other / "thesis.tex").write_text("x")
    assert main(["page", "-o", str(other)]) == 1
    assert "holds other files" in capsys.readouterr().err
    assert [path.name for path in other.iterdir()] == ["thesis.tex"]
    own = tmp_path / "a" / "site"
    assert main(["page", "-o", str(own)]) == 0
    (own / "multipos-0.0.1-py3-none-any.whl").write_bytes(b"")
    before = {path.name: path.read_bytes() for path in own.iterdir()}
    assert main(["page", "-o", str(own)]) == 0
    del before["multipos-0.0.1-py3-none-any.whl"]
    assert {path.name: path.read_bytes() for path in own.iterdir()} == before


def test_a_file_of_the_runtime_with_another_hash_is_refused_by_name(tmp_path, capsys):
    folder = page_runtime.folder()
    for name in runtime.FILES:
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    (tmp_path / "pyodide.mjs").write_bytes(b"// " + (folder / "pyodide.mjs").read_bytes())
    target = tmp_path / "site"
    assert main(["page", "-o", str(target), "--pyodide", str(tmp_path)]) == 1
    assert "pyodide.mjs is not that of Pyodide" in capsys.readouterr().err
    assert not target.exists()
    (tmp_path / runtime.NUMPY).unlink()
    assert main(["page", "-o", str(target), "--pyodide", str(tmp_path)]) == 1
    assert f"{runtime.NUMPY}: no such file" in capsys.readouterr().err


def test_it_serves_on_loopback_and_ends_well_on_a_signal(made):
    command = [sys.executable, "-m", "multipos", "page", "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        address = process.stdout.readline()
        found = re.fullmatch(r"http://127\.0\.0\.1:(\d+)/\n", address)
        assert found
        connection = http.client.HTTPConnection("127.0.0.1", int(found[1]), timeout=300)
        for path, name in (("/", "index.html"), ("/worker.js?x=1", "worker.js"), ("/../x", None)):
            connection.request("GET", path)
            answer = connection.getresponse()
            body = answer.read()
            assert answer.status == (404 if name is None else 200)
            assert name is None or body == made.files[name]
            kind = "worker" if name == "worker.js" else "page"
            assert answer.headers["Content-Security-Policy"] == made.policies[kind]
        connection.close()
        process.send_signal(signal.SIGTERM)
        assert process.wait(300) == 0
