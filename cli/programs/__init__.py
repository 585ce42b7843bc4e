"""One module per program: `pupper-sysid`, `pupper-train`, `pupper-play` and the others."""

import os
import sys

# before the libraries are imported, which takes a second in which Ctrl-C must act; but not where a
# test or another program imports this one. Python runs `-m` with this name until it has the module
if os.path.basename(sys.argv[0]).startswith(("pupper-", "-m")):
    from pupper_sysid.common.processes.stop import stop_process

    stop_process()
