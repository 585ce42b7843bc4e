"""From sweep to calibration on emulated XL330 and XM430: lag, registers, and the way out."""

from collections import deque
from pathlib import Path

import numpy as np
import pytest
import serial
from numpy.lib.stride_tricks import sliding_window_view

from pupper_sysid.servo_models.calibration.calibration import load_calibration
from pupper_sysid.sim.emulator.serial_line import SerialPty
from pupper_sysid.sysid.recordings.files import load
from support.command_line import ran, run
from support.servo_servers import moving_dynamixel, on_a_port
from support.virtual_line import on_a_virtual_line

TONES_HZ = (2.0, 4.0)
WIRE_S = 19 * 10 / 1_000_000
"""A sync write of one goal on the wire at 1 Mbaud."""


def act_when_written(monkeypatch, server: SerialPty) -> None:
    """Let the servos act on requests from the moment the host wrote them.

    A busy machine wakes the thread that serves them up to several milliseconds later, and more so
    after the pause before a command than between the command and the reading.
    """
    written: deque[tuple[float, int]] = deque()
    receive, write = server.emulator.receive, serial.Serial.write

    def noted(port, data):
        written.append((server.now(), len(data)))
        return write(port, data)

    def receive_then(data, now, baud=None):
        pieces = []
        while data:
            # another process, the watchdog, is not noted
            at, size = written.popleft() if written else (now, len(data))
            pieces += receive(data[:size], at, baud)
            if size > len(data):
                written.appendleft((at, size - len(data)))
            data = data[size:]
        return pieces

    monkeypatch.setattr(serial.Serial, "write", noted)
    monkeypatch.setattr(server.emulator, "receive", receive_then)


def phase(times: np.ndarray, values: np.ndarray, frequency_hz: float) -> float:
    """Phase of the tone in samples, by least squares."""
    angle = 2 * np.pi * frequency_hz * times
    basis = np.stack([np.sin(angle), np.cos(angle), np.ones_like(angle)], axis=1)
    sine, cosine, _ = np.linalg.lstsq(basis, values, rcond=None)[0]
    return float(np.arctan2(cosine, sine))


def lag_s(sent, command, read, position, frequency_hz: float) -> float:
    """Lag of a tone; samples at the same places of both series."""
    return float(
        (phase(sent, command, frequency_hz) - phase(read, position, frequency_hz))
        % (2 * np.pi)
        / (2 * np.pi * frequency_hz)
    )


@pytest.mark.slow
@pytest.mark.wall_clock
@pytest.mark.parametrize("model", [1200, 1020])
def test_a_sweep_shows_the_emulated_servos_lag_and_leaves_its_registers(
    capsys, monkeypatch, model, here
):
    servos = moving_dynamixel(model)
    servos.bench.map.save(Path("map.yaml"))
    before = bytes(servos.servos[1].memory)
    with on_a_port(servos) as server:
        act_when_written(monkeypatch, server)
        code, _, err = run(
            capsys, "sweep", "--bus", f"dynamixel:{server.device}@1000000", "--joint-map",
            "map.yaml", "--freqs", "2,4", "--amplitude", "0.2", "--duration", "4", "--rate", "100",
            "--out", "a.csv",
        )  # fmt: skip
    assert code == 0, err
    for name in ("bus_watchdog", "shutdown", "position_p_gain", "operating_mode"):
        where = servos.series.register(name)
        ours = slice(where.address, where.address + where.size)
        assert servos.servos[1].memory[ours] == before[ours], name
    assert servos._get(1, "torque_enable") == 0
    trials = load(Path("a.csv")).trials("bench")
    scale = 2 * np.pi / 4096
    arrived = np.array([(at - WIRE_S, count * scale) for at, _, count in servos.bench.commands])
    measured = np.array([(at, count * scale) for at, _, count in servos.readings])
    for trial, tone in zip(trials, TONES_HZ, strict=True):
        here = np.isfinite(trial.position_rad)
        recorded = lag_s(
            trial.send_time_s, trial.command_rad, trial.read_time_s[here],
            trial.position_rad[here], tone,
        )  # fmt: skip
        # the same commands and readings on the servo's own clock
        rows = sliding_window_view(arrived[:, 0], len(trial.send_time_s)) - trial.send_time_s
        first = int(np.argmin(rows.std(axis=1)))
        moving = arrived[first : first + len(trial.send_time_s)]
        reads = trial.read_time_s[here] + np.median(rows[first])
        nearest = np.abs(measured[:, :1] - reads).argmin(axis=0)
        true = lag_s(moving[:, 0], moving[:, 1], *measured[nearest].T, tone)
        assert abs(recorded - true) < 3e-4, f"{tone} Hz: {1e3 * (recorded - true):.2f} ms"
    ran(capsys, "doctor", "a.csv")
    ran(capsys, "calibrate", "a.csv", "--out", "c.yaml")
    fitted = load_calibration(Path("c.yaml")).joint("bench").actuator.dead_time_s
    truth = float(np.asarray(servos.bench.robot.servos[0].actuator.dead_time_s))
    assert fitted.low <= truth <= fitted.high


def test_a_sweep_of_a_fast_servo_asks_for_no_more_speed_than_the_guard_sends(capsys, here):
    servos = moving_dynamixel(1200)  # 10.8 rad/s without load; the guard sends 8
    servos.bench.map.save(Path("map.yaml"))
    with on_a_virtual_line(here, servos) as (device,):
        words = ("--joint-map", "map.yaml", "--freqs", "8", "--amplitude", "0.2", "--out", "a.csv")
        _, err = ran(capsys, "sweep", "--bus", f"dynamixel:{device}", "--duration", "1", *words)
    assert "amplitude reduced" in err and "delayed by the guard" not in err
    assert load(Path("a.csv")).metadata["completed"]["guard"]["slowed"] == 0
