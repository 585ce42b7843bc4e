"""Files that come with the package.

`SAMPLES` is the folder of recordings of the emulated robot with their truth, a calibration, two
policies and the model of an arm; its README says how each was made.
"""

from __future__ import annotations

from pathlib import Path

SAMPLES = Path(__file__).resolve().parent / "samples"
