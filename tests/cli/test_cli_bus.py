"""Commands that talk to a bus, with emulators behind real ports."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from pupper_sysid.cli.programs import pupper_sysid
from pupper_sysid.hardware.esp32 import Esp32Bus
from pupper_sysid.hardware.feetech import SCS0009, FeetechBus
from pupper_sysid.sysid.recordings.files import load
from support.command_line import json_of, ran, refused, run
from support.servo_servers import moving_servos, on_a_port, still_servos
from support.stopwatch import wait_until
from support.virtual_line import on_a_virtual_line

SHORT = ("--freqs", "3", "--duration", "1")


pytestmark = pytest.mark.usefixtures("here")


def test_scan_lists_the_servos_and_finds_their_rate(capsys, monkeypatch):
    few = replace(FeetechBus.family, highest_id=12)
    monkeypatch.setattr(FeetechBus, "family", few)
    with on_a_port(still_servos(SCS0009, ids=[4, 7], baud=500_000)) as port:
        found = json_of(capsys, "scan", "--bus", f"feetech:{port.device}")
    assert found["baud"] == 500_000
    assert [s["id"] for s in found["servos"]] == [4, 7]
    first = found["servos"][0]
    assert (first["model"], first["firmware"], first["gains"]) == ("SCS0009", "0.16", [15, 15, 0])
    assert (first["voltage_v"], first["limits"], first["errors"]) == (7.4, [20, 1003], "")


def test_scan_of_a_silent_line_names_what_to_check(capsys):
    with on_a_port(still_servos(ids=[])) as port:
        code, _, err = run(capsys, "scan", "--bus", f"feetech:{port.device}@1000000")
    assert code == 1 and "no servo answers at 1000000 baud" in err and "power" in err


def test_a_sweep_of_one_servo_on_a_line_keeps_what_shaped_it(capsys, tmp_path):
    with on_a_virtual_line(tmp_path, moving_servos(ids=[5])) as (device,):
        words = (*SHORT, "--joints", "LF_thigh", "--out", "a.csv", "--joint-map", "sts3215")
        _, err = ran(capsys, "sweep", *words, "--bus", f"feetech:{device}")
    recording = load(Path("a.csv"))
    bus = recording.metadata["bus"]
    assert recording.joints == ["LF_thigh"] and bus["baud"] == 1_000_000
    assert recording.trials("LF_thigh")[0].readings == "live"
    servo = recording.trials("LF_thigh")[0].servo
    assert servo.p_gain == 32 and servo.registers["return_delay"] == 250
    assert recording.metadata["completed"]["guard"]["clipped"] == 0
    doubt = recording.trials("LF_thigh")[0].read_time_doubt_s
    # half of a turn: a return delay of 500 µs, and a reply of 12 bytes at 10 µs each
    assert doubt == bus["read_time_doubt_s"] == pytest.approx(0.00031)
    assert {"voltage_v", "temperature_c", "load"} <= set(recording.table.columns)
    # 0.26 rad instead of 0.3: at 3 Hz that is the servo's speed by its data sheet, and the servo
    # follows most of it
    assert "reduced from 0.3 to 0.260 rad" in err
    trial = recording.trials("LF_thigh")[0]
    assert abs(trial.command_rad - 0.785).max() == pytest.approx(0.26, abs=0.01)
    assert max(abs(trial.position_rad - 0.785)) > 0.2


@pytest.mark.parametrize(
    "place",
    [pytest.param(("feetech", "--link"), marks=pytest.mark.slow), ("esp32", "--socket")],
    ids=lambda place: place[0],
)
def test_an_emulator_prints_the_next_command_and_ends_on_request(tmp_path, place):
    with emulator(tmp_path, *place, "s", "--truth", "t.yaml", lines=5) as out:
        assert (tmp_path / "s").exists()
    assert "pupper-sysid sweep --freqs 1-10 --joints LF --bus" in out and "Ctrl-C" in out
    truth = yaml.safe_load((tmp_path / "t.yaml").read_text())
    assert truth["joints"]["LF_hip"]["actuator"]["dead_time_s"] > 0


@pytest.mark.parametrize("kind", [("feetech", "--link"), ("esp32", "--socket")])
def test_an_emulator_that_never_gets_to_serve_leaves_no_device(capsys, monkeypatch, kind):
    Path("t.yaml").write_text("of another robot")
    said = refused(capsys, pupper_sysid, "emulate", *kind, "s", "--truth", "t.yaml")
    assert "t.yaml exists" in said
    assert list(Path().iterdir()) == [Path("t.yaml")]

    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("pupper_sysid.cli.terminal.out.print", interrupted)
    code, _, err = run(capsys, "emulate", *kind, "s")
    assert code == 130 and "Stopped." in err and list(Path().iterdir()) == [Path("t.yaml")]


def test_a_walking_robot_on_a_serial_line_has_its_imu_on_a_socket(tmp_path):
    words = ("feetech", "--walking", "--link", "s", "--imu-socket", "i")
    with emulator(tmp_path, *words, lines=4) as out:
        imu = Esp32Bus(tmp_path / "i")
        samples: list = []
        assert wait_until(lambda: bool(samples.append(imu.imu()) or samples[-1]))
        imu.close()
        np.testing.assert_allclose(samples[-1].acceleration_m_s2, [0, 0, 9.81], atol=0.15)
    assert "IMU at i." in out and "monitor --bus feetech:s" in out and "Ctrl-C" in out
    assert "sweep" not in out, "a sweep is for legs in free air"


@contextmanager
def emulator(folder: Path, *words: str, lines: int) -> Iterator[str]:
    """What an emulator says first; it ends on request and leaves nothing behind."""
    process = subprocess.Popen(
        [sys.executable, "-m", pupper_sysid.__name__, "emulate", *words], cwd=folder, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=os.environ | {"PYTHONUNBUFFERED": "1"},
    )  # fmt: skip
    assert process.stdout is not None
    try:
        yield "".join(process.stdout.readline() for _ in range(lines))
    finally:
        process.send_signal(signal.SIGTERM)
        _, err = process.communicate(timeout=60)
    assert process.returncode == 143 and "Stopped." in err and "Traceback" not in err
    assert not list(folder.glob("[is]"))
