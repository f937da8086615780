"""The command line as tests run it, and the readings at six positions that they begin with."""

import re
import sysconfig
from importlib import import_module
from pathlib import Path

from multipos import cli

MULTIPOS = str(Path(sysconfig.get_path("scripts")) / "multipos")

SIX = """\
position,direction,ax,ay,az
1,E-U-S,0.0071,1.0029,-0.0016
2,E-N-U,-0.0094,-0.0058,1.0008
3,D-E-S,-0.9965,0.0064,0.0015
4,W-D-S,-0.0076,-1.0030,0.0032
5,U-W-S,0.9965,0.0073,0.0027
6,S-W-D,0.0067,-0.0060,-1.0008
"""

# what every fit of six faces says, and apply of it
HIDDEN = re.compile(r"multipos: warning: [^\n]*not show own\*\|own\|, own\^3 or own\*other[^\n]*\n")


def run(capsys, *arguments):
    """Run in this process; return status, stdout and stderr."""
    try:
        status = cli.main([str(argument) for argument in arguments])
    except SystemExit as leaving:  # --help and --version
        status = leaving.code
    captured = capsys.readouterr()
    return status, captured.out, captured.err


def make_once(monkeypatch, name):
    """What a command makes by a function is made once for the same words, however it is shown."""
    module, _, function = name.rpartition(".")
    make, made = getattr(import_module(module), function), {}

    def remembered(*words, progress=None, **options):
        key = repr((words, options))
        if key not in made:
            made[key] = make(*words, **options)
        return made[key]

    monkeypatch.setattr(name, remembered)


def snapshot(folder):
    """Return what stands in a folder and when it was written, to see that nothing was touched."""
    return {
        path: (path.stat().st_mtime_ns, path.read_bytes())
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }
