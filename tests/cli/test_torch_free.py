"""From the bus to calibration, report and export, nothing needs torch or rsl_rl."""

from pathlib import Path

import pytest

from support.command_line import fresh_python

TESTS = Path(__file__).resolve().parents[1]

COMMANDS = '''
import sys

BANNED = ("torch", "rsl_rl")


class NotInstalled:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in BANNED:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


sys.meta_path.insert(0, NotInstalled())

from support.command_line import fresh_python
from pupper_sysid.cli.programs.pupper_sysid import main
from support.servo_servers import on_a_port, still_servos

with on_a_port(still_servos(ids=[4, 7])) as port:
    main(["scan", "--bus", f"feetech:{port.device}@1000000", "--json"])
for line in """
monitor --bus emulated --once
sweep --freqs 3 --joints LF_hip --duration 2 --out s.csv --truth
doctor s.csv
bode s.csv --plot bode.png
calibrate s.csv --out c.yaml
report s.csv --calibration c.yaml --out page
export s.csv
export c.yaml
export c.yaml --to mjcf
export c.yaml --to isaaclab
""".strip().splitlines():
    main(line.split())
    print("DONE", line)

assert not set(BANNED) & set(sys.modules)
'''


@pytest.mark.slow
def test_no_command_on_the_way_to_a_calibration_imports_torch(tmp_path):
    printed = fresh_python(COMMANDS, folder=tmp_path, path=TESTS)
    assert printed.count("DONE") == 10
    assert (tmp_path / "page/report.html").is_file() and (tmp_path / "bode.png").is_file()
