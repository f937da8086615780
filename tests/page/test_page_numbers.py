"""The numbers of the page in the runtime itself, under Node: the quick test of them."""

import json
import shutil
import subprocess

import numpy as np
import page_runtime
import pytest
from consumers import read_back

import multipos as mp
from multipos.page import runtime, site

SCRIPT = """
import { readFileSync } from "node:fs";
const [folder, lock, wheel, work] = process.argv.slice(2);
const { loadPyodide } = await import(`${folder}/pyodide.mjs`);
const pyodide = await loadPyodide({ indexURL: `${folder}/`, lockFileURL: lock });
const unpack = (path) => pyodide.unpackArchive(
    new Uint8Array(readFileSync(path)), "wheel", { extractDir: "/lib/python3.12/site-packages" });
unpack(`${folder}/NUMPY`);
unpack(wheel);
pyodide.FS.mkdir("/work");
pyodide.FS.mount(pyodide.FS.filesystems.NODEFS, { root: work }, "/work");
pyodide.runPython(readFileSync(`${work}/ask.py`, "utf-8"));
"""
ASK = """
import json, os
os.chdir("/work")
from multipos.page.visit import Visit
visit = Visit()
def ask(do, **asked):
    answer = json.loads(visit.answer(json.dumps({"do": do} | asked)))
    assert "error" not in answer, answer
    return answer
for name, kind in (("faces.csv", "known"), ("hand.csv", "free"), ("log.csv", "log")):
    answer = ask("calibrate", files=[name], kind="auto", unit="")
    assert answer["kind"] == kind, answer["kind"]
    for form in ("json", "c", "px4", "ardupilot", "md", "readings"):
        ask("download", form=form, accept=True)
ask("plan", model="own-quadratic", positions=18, hand_held=False)
"""


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("node") is None, reason="no Node")
def test_the_runtime_gives_the_numbers_of_this_machine(tmp_path):
    folder = page_runtime.folder()
    sensor = mp.demo().calibration
    run = mp.simulate(sensor, "all-26", reading_sd=1e-4, seed=2)
    mp.write_table(tmp_path / "faces.csv", run)
    mp.write_table(tmp_path / "hand.csv", {name: run[name] for name in ("ax", "ay", "az")})
    log = mp.simulate_log(sensor, "all-26", rate=50, rest=4, sample_sd=1e-3, seed=1)
    mp.write_table(tmp_path / "log.csv", log)
    (tmp_path / "ask.py").write_text(ASK)
    (tmp_path / "run.mjs").write_text(SCRIPT.replace("NUMPY", runtime.NUMPY))
    (tmp_path / "lock.json").write_text(json.dumps(runtime.LOCK))
    (tmp_path / site.NAME).write_bytes(site.make_wheel())
    places = [tmp_path / name for name in ("run.mjs", "lock.json", site.NAME)]
    done = subprocess.run(
        ["node", places[0], folder, places[1], places[2], tmp_path],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    made = tmp_path / "multipos-downloads"
    expected = {
        "faces": mp.fit(tmp_path / "faces.csv", unit="g"),
        "hand": mp.fit(tmp_path / "hand.csv", unit="g", unknown_orientation=True),
        "log": mp.calibrate(tmp_path / "log.csv"),
    }
    for name, own in expected.items():
        saved = mp.load(made / f"{name}.json")
        difference = np.abs(saved.parameters - own.parameters)
        # a direct fit differs by rounding, one that iterates by where it ends
        assert (difference < (1e-12 if name == "faces" else 1e-9 * own.u)).all()
        np.testing.assert_allclose(saved.u, own.u, rtol=1e-9)
        assert (made / f"{name}.c").read_text() == mp.export(saved, "c").text
        for form in ("_px4.params", "_ardupilot.parm"):
            read_back(made / f"{name}{form}", saved)
