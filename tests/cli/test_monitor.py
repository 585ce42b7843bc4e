"""The monitor: it tells what the servos say, how old that is, and never touches them."""

import re

import numpy as np
import pytest

from pupper_sysid.cli.commands.bus import Watched
from pupper_sysid.hardware import esp32
from pupper_sysid.hardware.bus import BusSample
from pupper_sysid.hardware.feetech import PING, SYNC_READ, FrameReader
from pupper_sysid.hardware.serial_servos import line as serial_line
from pupper_sysid.sim.emulator.bench import BusFaults
from pupper_sysid.sim.emulator.esp32 import ProxyEmulator
from support.command_line import json_of, ran, run
from support.servo_servers import StillBench, bench_of, on_a_port, on_a_socket, still_servos

_READ = 2
MAP = ("--joint-map", "sts3215")


@pytest.fixture(autouse=True)
def patience(monkeypatch):
    """The servos share this process and a busy machine."""
    monkeypatch.setattr(serial_line, "REPLY_TIMEOUT_S", 0.02)


pytestmark = pytest.mark.usefixtures("here")


class Listener(ProxyEmulator):
    """A proxy that keeps what it was asked."""

    def __init__(self):
        rng = np.random.default_rng(0)
        super().__init__(StillBench("mini_pupper_2"), rng, BusFaults({}, rng))
        self.requests: list[bytes] = []

    def answer(self, request: bytes, previous: bytes, now: float) -> bytes:
        self.requests.append(request)
        return super().answer(request, previous, now)


class ScriptedBus:
    """One servo in virtual time that says what the test wants; NaN is silence."""

    name, joint_names = "scripted", ("LF_hip",)

    def __init__(self, kind, readings):
        live = "live" if kind == "feetech" else "polled"
        self.metadata = {"kind": kind, "coordinates": "servo", "readings": live}
        self._readings = iter(readings)
        self.time_s = 0.0

    def now(self):
        return self.time_s

    def read(self):
        at, position = next(self._readings)
        self.time_s = at
        count = -1 if np.isnan(position) else round(512 + 100 * position)
        return BusSample(np.array([at]), np.array([position]), np.array([count]))


def watched(kind, *readings):
    """What is known after these readings, one second apart."""
    seen = Watched(ScriptedBus(kind, enumerate(readings)))  # type: ignore[arg-type]
    for _ in readings:
        seen.look()
    return seen


def cell(seen, column):
    return next(iter(seen.table("x").renderables[0].columns[column].cells))


def test_what_is_known_of_a_reading_is_its_age_on_a_line_and_that_it_is_unchanged_on_the_proxy():
    # the same value again is a new answer; two seconds of silence make it two seconds old
    row = watched("feetech", 0.1, 0.1, np.nan, np.nan).rows()[0]
    assert (row["age_s"], row["unchanged_s"]) == (2.0, None)
    assert (row["answers"], row["position_rad"], row["count"]) == (False, 0.1, 522)
    silent = watched("feetech", np.nan, np.nan)
    assert "silent" in cell(silent, 8) and cell(silent, 4) == "–" and cell(silent, 3) == "–"
    seen = watched("esp32 proxy", 0.1, 0.2, 0.2, 0.2)
    row = seen.rows()[0]
    assert (row["age_s"], row["unchanged_s"], cell(seen, 4)) == (None, 2.0, "2.0 s")
    # one that never changed has stood there for at least so long
    assert cell(watched("esp32 proxy", 0.1, 0.1, 0.1), 4) == "≥2.0 s"


def test_one_json_object_tells_goal_volts_heat_and_errors_of_serial_servos(capsys):
    servos = still_servos(ids=[4, 5])
    bench_of(servos).loads[4] = -250
    bench_of(servos).counts[5] = 2048 + 652
    with on_a_port(servos) as port:
        told = json_of(capsys, "monitor", "--bus", f"feetech:{port.device}@1000000", *MAP)
    hip, thigh = told["joints"]
    assert told["coordinates"] == "servo" and told["joint_map"] == "sts3215"
    assert (hip["joint"], hip["count"], hip["load"]) == ("LF_hip", 2048, -0.25)
    assert (hip["voltage_v"], hip["temperature_c"], hip["errors"]) == (7.4, 27.0, "")
    assert hip["goal_rad"] is not None and 0 <= hip["age_s"] < 0.2
    # the left thigh counts downwards: 652 counts of 4096 / (2 pi) are 1 rad
    assert thigh["position_rad"] == pytest.approx(np.pi / 4 - 1, abs=1e-3)


def test_monitoring_a_line_only_pings_and_reads(capsys):
    servos = still_servos(ids=[4, 5])
    with on_a_port(servos) as port:
        out, _ = ran(capsys, "monitor", "--bus", f"feetech:{port.device}@1000000", *MAP, "--once")
    asked = {frame.code for frame in FrameReader().feed(servos.heard)}
    assert "LF_thigh" in out and "since the last valid reply" in out
    assert asked and asked <= {PING, _READ, SYNC_READ}
    assert bench_of(servos).goals == bench_of(servos).torques == []


def test_monitoring_the_proxy_only_asks_and_says_what_it_cannot_tell(capsys, tmp_path):
    proxy = Listener()
    with on_a_socket(proxy, tmp_path / "s"):
        out, _ = ran(capsys, "monitor", "--bus", f"esp32:{tmp_path / 's'}", "--once")
    assert {r[1] for r in proxy.requests} <= {
        esp32.GET_POSITION, esp32.GET_LOAD, esp32.GET_POWER
    }  # fmt: skip
    words = " ".join(out.split())
    assert "unchanged" in words
    assert "the feedback age is unknown, as are goals, temperatures and errors" in words
    row = next(line.split() for line in out.splitlines() if line.startswith("LF_hip"))
    assert row[1] == "–" and row[3] == "512"


def test_without_a_terminal_a_plain_table_comes_once_a_second(capsys):
    out, _ = ran(capsys, "monitor", "--bus", "emulated", "--seconds", "1.3")
    assert len(re.findall("^LF_hip", out, re.MULTILINE)) == 2
    assert "\x1b[" not in out


def test_ctrl_c_ends_it_as_it_should(capsys, monkeypatch):
    def interrupted(self):
        raise KeyboardInterrupt

    monkeypatch.setattr("pupper_sysid.cli.commands.bus.Watched.look", interrupted)
    code, _, err = run(capsys, "monitor", "--bus", "emulated")
    assert code == 130 and err == "Stopped."


def test_the_older_word_for_the_emulated_bus_is_taken_and_answered_with_the_new_one(capsys):
    found = json_of(capsys, "monitor", "--bus", "sim")
    assert found["bus"] == "emulated"
