"""Check or renew the golden figures, and print what changed.

    .venv/bin/python tests/golden/renew.py                    # what differs by more than 1 %
    .venv/bin/python tests/golden/renew.py --renew            # write, and print what changed
    .venv/bin/python tests/golden/renew.py --only proxy --stages doctor lag

Exits 1 if a figure differs by more than the tolerance of `support.golden` and nothing is renewed.
With `--exact` every stored digit counts. Each joint is written when it is computed, so that a run
can be stopped, and continued with `--missing`. All of them take about 15 minutes of processor time,
the emulated ones two.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

# one thread, as in the tests
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import support.avx2  # noqa: F401
from support.golden import main

if __name__ == "__main__":
    sys.exit(main())
