"""``python -m imitarm``: the same as the command ``imitarm``."""

import sys

from imitarm.cli import main

sys.exit(main())
