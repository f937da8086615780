# PYTHON_ARGCOMPLETE_OK
"""``python -m multipos`` is the command ``multipos``."""

import sys

from multipos.cli import main

if __name__ == "__main__":
    sys.exit(main())
