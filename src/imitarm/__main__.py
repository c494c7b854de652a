"""``python -m imitarm``: the same as the command ``imitarm``."""

import sys

from imitarm.cli import main

if __name__ == "__main__":
    sys.exit(main())
