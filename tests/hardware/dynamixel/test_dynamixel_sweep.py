"""From sweep to calibration on emulated XL330 and XM430: lag, registers, and the way out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pupper_sysid.servo_models.calibration.calibration import load_calibration
from pupper_sysid.sysid.recordings.files import load
from support.command_line import run
from support.servo_servers import moving_dynamixel, on_a_port

TONES_HZ = (2.0, 4.0)
WIRE_S = 19 * 10 / 1_000_000
"""A sync write of one goal on the wire at 1 Mbaud."""


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
    capsys, tmp_path, monkeypatch, model
):
    monkeypatch.chdir(tmp_path)
    servos = moving_dynamixel(model)
    servos.bench.map.save(Path("map.yaml"))
    before = bytes(servos.servos[1].memory)
    with on_a_port(servos) as server:
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
        # the same tone on the servo's own clock, by the length of the trial
        span = trial.send_time_s[-1] - trial.send_time_s[0]
        moving = _window(arrived, tone, span)
        then = (measured[:, 0] >= moving[0, 0]) & (measured[:, 0] <= moving[-1, 0])
        true = lag_s(moving[:, 0], moving[:, 1], *measured[then].T, tone)
        assert abs(recorded - true) < 3e-4, f"{tone} Hz: {1e3 * (recorded - true):.2f} ms"
    code, _, err = run(capsys, "doctor", "a.csv")
    assert code == 0, err
    code, _, err = run(capsys, "calibrate", "a.csv", "--out", "c.yaml")
    assert code == 0, err
    fitted = load_calibration(Path("c.yaml")).joint("bench").actuator.dead_time_s
    truth = float(np.asarray(servos.bench.robot.servos[0].actuator.dead_time_s))
    assert fitted.low <= truth <= fitted.high


def _window(commands: np.ndarray, frequency_hz: float, span_s: float) -> np.ndarray:
    """The commands that hold this tone: the window in which it explains most of their variance."""
    best, kept = -np.inf, commands
    for start in np.arange(commands[0, 0], commands[-1, 0] - 0.8 * span_s, 0.25):
        window = commands[(commands[:, 0] >= start) & (commands[:, 0] < start + 0.8 * span_s)]
        if len(window) < 50:
            continue
        angle = 2 * np.pi * frequency_hz * window[:, 0]
        basis = np.stack([np.sin(angle), np.cos(angle), np.ones_like(angle)], axis=1)
        rest = window[:, 1] - basis @ np.linalg.lstsq(basis, window[:, 1], rcond=None)[0]
        share = np.var(window[:, 1]) - 2 * np.var(rest)
        if share > best:
            best, kept = share, window
    return kept
