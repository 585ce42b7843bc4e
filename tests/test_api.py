"""The front door: names of functions that the commands call, imported when they are looked up."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import pupper_sysid as ps
from support.command_line import run
from support.strokes import stroked

SWEEP = Path("data/samples/sweep.csv")

# imports of these fail as where they are not installed
WITHOUT = """
import sys
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("torch", "rsl_rl", "matplotlib"):
            raise ModuleNotFoundError(name)
sys.meta_path.insert(0, Absent())
"""


def python(code: str, folder: Path) -> str:
    """What a fresh interpreter prints in `folder`."""
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, check=False,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_every_name_is_there_and_no_other():
    assert set(ps.__all__) == set(ps._MODULES) and set(ps.__all__) <= set(dir(ps))
    for name in ps.__all__:
        assert getattr(ps, name) is not None
    with pytest.raises(AttributeError, match="nonsense"):
        _ = ps.nonsense


def test_importing_the_front_door_imports_nothing_else(tmp_path):
    code = "import sys; a = set(sys.modules); import pupper_sysid; print(*set(sys.modules) - a)"
    loaded = python(code, tmp_path).split()
    assert "numpy" not in loaded and "torch" not in loaded
    assert [m for m in loaded if m.startswith("pupper_sysid.")] == []


def test_load_lag_calibrate_and_save_need_neither_torch_nor_matplotlib(hip, tmp_path):
    text = python(
        WITHOUT
        + f"""
import pupper_sysid as ps
recording = ps.load({str(hip)!r})
lag = ps.lag(recording, "LF_hip")
print(lag)
calibrated = ps.calibrate(recording, "LF_hip")
assert lag["LF_hip"].dead_time_s == calibrated["LF_hip"].dead_time_s
calibrated.save("calibrated.yaml")
try:
    calibrated.save("calibrated.yaml")
except ps.InputError as error:
    print("refused")
""",
        tmp_path,
    )
    assert "dead time" in text and len(text) < 500 and text.endswith("refused\n")
    assert ps.load_calibration(tmp_path / "calibrated.yaml").joint_names == ("LF_hip",)


@pytest.mark.parametrize(
    ("command", "function"),
    [("doctor", ps.examine), ("delay", ps.lag), ("bode", ps.frequency_response)],
)
def test_a_result_is_the_json_of_its_command(capsys, hip, command, function):
    code, out, err = run(capsys, command, hip, "--json")
    assert code == 0, err
    found = function(ps.load(hip))
    assert found.to_dict() == json.loads(out)
    assert list(found.to_frame()["joint"].unique()) == ["LF_hip"]
    assert found.plot().axes


def test_backlash_is_the_json_of_its_command_with_a_row_per_gain(capsys, tmp_path):
    strokes, _ = stroked(3, 2.0, 0)
    strokes.save(tmp_path / "strokes.csv")
    code, out, err = run(capsys, "backlash", tmp_path / "strokes.csv", "--json")
    assert code == 0, err
    found = ps.backlash(ps.load(tmp_path / "strokes.csv"))
    assert found.to_dict() == json.loads(out)
    table, own = found.to_frame(), found["bench"]
    assert list(table["joint"]) == ["bench", "bench"] and list(table["p_gain"]) == [8, 32]
    assert list(table["hysteresis_rad_low"]) == [g.hysteresis_rad.low for g in own.gains]
    assert own.backlash_rad and set(table["backlash_rad"]) == {own.backlash_rad.value}
    (axes,) = found.plot().axes
    assert axes.get_xlabel() == "P gain" and "bench: backlash 1.9" in axes.get_title(loc="left")
    assert str(found).startswith("bench: hysteresis ") and "at P 32" in str(found)


def test_a_joint_that_was_not_recorded_is_refused():
    with pytest.raises(ps.InputError, match="RB_calf"):
        ps.lag(ps.load(SWEEP), ["RB_calf"])
