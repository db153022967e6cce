"""`python -m dvsviz`: the command line."""

from __future__ import annotations

import sys

from dvsviz.cli import main

sys.exit(main())
