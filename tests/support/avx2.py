"""Imported before NumPy: sums are rounded as on a processor with AVX2, of which frozen figures are.

Wider registers add in another order, and a search turns on the last bit. NumPy and OpenBLAS read
these variables when they are imported, here and in the workers that inherit them.
"""

import os
from pathlib import Path

_CPU = Path("/proc/cpuinfo")

if _CPU.exists() and " avx512f " in _CPU.read_text():
    os.environ.setdefault("OPENBLAS_CORETYPE", "Haswell")
    os.environ.setdefault("NPY_DISABLE_CPU_FEATURES", "X86_V4 AVX512_ICL AVX512_SPR")
