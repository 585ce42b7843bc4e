"""The front door: names of functions that the commands call, imported when they are looked up."""

import inspect
import json
import re
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import pupper_sysid as ps
from pupper_sysid.cli.programs import pupper_sysid
from support.command_line import fresh_python, ran
from support.json_keys import DOCUMENTED, key_line

SWEEP = Path("data/samples/sweep.csv")
pytestmark = pytest.mark.usefixtures("fitted_once")


def test_every_name_is_there_and_no_other():
    assert set(ps.__all__) == set(ps._MODULES)
    assert sorted(dir(ps)) == sorted([*ps.__all__, "__version__"])
    for name in ps.__all__:
        assert getattr(ps, name) is not None
    with pytest.raises(AttributeError, match="nonsense"):
        _ = ps.nonsense


def test_names_are_those_of_the_commands_and_older_names_are_the_same_functions():
    commands = {name.replace("-", "_") for name in pupper_sysid.COMMANDS}
    functions = {n for n in ps.__all__ if n.islower() and not n.startswith(("load", "make"))}
    assert functions <= commands
    assert ps.examine is ps.doctor and ps.lag is ps.delay
    assert ps.frequency_response is ps.bode and ps.sparse_equations is ps.sindy
    assert ps.__version__ == version("pupper-sysid")


def test_representations_are_short_and_have_units(hip):
    recording = ps.load(hip)
    assert re.fullmatch(r"Recording \w+: LF_hip; \d trials, \d+ rows, \d+ s.*", repr(recording))
    calibration = ps.load_calibration("data/samples/calibrated.yaml")
    first, hip_line, *others = repr(calibration).splitlines()
    assert first == "Calibration of Mini Pupper 2 (emulated)" and len(others) == 2
    assert str(calibration) == repr(calibration), "what print shows"
    dead_time = calibration.joints["LF_hip"].actuator.dead_time_s
    assert f"dead time {1e3 * dead_time.value:.1f} " in hip_line and " N·m/rad" in hip_line
    assert repr(ps.Interval(0.041234567, 0.04, 0.0425)) == "Interval(0.04123, 0.04…0.0425)"
    for shown in (calibration.delayed_pd(), ps.doctor(recording), ps.bode(recording)):
        assert len(repr(shown)) < 400 and " object at 0x" not in repr(shown)


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: ps.load(3), "takes the path of one log, not a int"),
        (lambda: ps.delay("sweep.csv"), r"pupper_sysid\.load\('sweep.csv'\)"),
        (lambda: ps.load_calibration(3), "not by a int"),
        (lambda: ps.compare(ps.load(SWEEP), 3), "not by a int"),
        (lambda: ps.compare(ps.load(SWEEP), "nosuch.yaml"), "nosuch.yaml does not exist"),
        (lambda: ps.make_env(3), "not by a int"),
        (lambda: ps.load_policy(None), "not by a NoneType"),
        (lambda: ps.load_servo_model(["a"]), "not by a list"),
        (lambda: ps.export(3, "mjlab"), r"pupper_sysid\.load_calibration"),
        (lambda: ps.export("paper", "gazebo"), "there are mjcf"),
        (lambda: ps.calibrate(ps.load(SWEEP), stall_torque_nm="0.35"), "is a str; write a number"),
        (lambda: ps.delay(ps.load(SWEEP), seed="a"), "`seed` is 'a'; give a whole number"),
        (lambda: ps.calibrate(ps.load(SWEEP), seed=-1), "`seed` is -1; give a whole number"),
    ],
)  # fmt: skip
def test_a_wrong_type_is_answered_in_a_sentence(call, says):
    with pytest.raises(ps.InputError, match=says):
        call()


def test_export_takes_a_calibration_its_file_and_what_calibrate_returns(tmp_path):
    calibration = ps.load_calibration("paper")
    returned = SimpleNamespace(calibration=calibration)
    texts = {
        ps.export(each, "json", tmp_path / str(k)).read_text()
        for k, each in enumerate((calibration, "paper", returned))
    }
    assert len(texts) == 1


def test_importing_the_front_door_imports_nothing_else(tmp_path):
    code = "import sys; a = set(sys.modules); import pupper_sysid; print(*set(sys.modules) - a)"
    loaded = fresh_python(code, folder=tmp_path).split()
    assert "numpy" not in loaded and "torch" not in loaded
    assert [m for m in loaded if m.startswith("pupper_sysid.")] == []


@pytest.fixture
def json_of(capsys, monkeypatch):
    """Object that a command prints of one joint; it is that of the function of its name.

    The function is called once, by the command, with the recording and its own defaults.
    """

    def printed_by(command: str, recording: Path, *words) -> dict:
        function, calls = getattr(ps, command), []
        signature = inspect.signature(function)

        def called(*positional, **named):
            result = function(*positional, **named)
            calls.append((signature.bind(*positional, **named).arguments, result))
            return result

        monkeypatch.setattr(import_module(function.__module__), function.__name__, called)
        out, _ = ran(capsys, command, recording, *words, "--json")
        printed, ((arguments, result),) = json.loads(out), calls
        ((own,), known) = arguments.pop("recordings"), ps.load(recording)
        assert own.sha256 == known.sha256 and own.joints == known.joints
        assert arguments.get("seed", 0) == 0 == signature.parameters["seed"].default
        assert key_line(printed) == DOCUMENTED[command]
        assert result.to_dict() == printed
        assert list(result.to_frame()["joint"].unique()) == ["LF_hip"]
        assert result.plot().axes
        return printed["joints"]["LF_hip"]

    return printed_by


def test_delay_is_its_command_and_its_parts_add_up_in_order(json_of, hip):
    joint = json_of("delay", hip)
    lags = [joint[k]["value"] for k in ("raw_lag_s", "fresh_lag_s", "lag_s", "dead_time_s")]
    assert lags == sorted(lags, reverse=True)


def test_doctor_is_its_command_and_finds_the_polls(json_of, hip):
    joint = json_of("doctor", hip)
    assert joint["verdict"] == "use"
    assert joint["poll_period_s"] == pytest.approx(0.02685, abs=1.5e-4)
    assert joint["quantum_rad"] == pytest.approx(np.pi / 550, rel=1e-4)


def test_bode_is_its_command_and_shows_that_the_servo_follows(json_of, hip, tmp_path):
    """Where raw rows say that it does not."""
    tones = json_of("bode", hip, "--plot", tmp_path / "b.png")["by_frequency"]
    assert (tmp_path / "b.png").stat().st_size > 10_000
    assert all(t["gain"] > 0.9 for t in tones) and tones[-1]["raw_gain"] < 0.75
