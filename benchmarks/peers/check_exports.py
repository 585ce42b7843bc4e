"""Do the released simulators know the names that our exports use, and move as we do?

    .venv/bin/python benchmarks/peers/check_exports.py

Downloads the newest wheels of Isaac Lab, mjlab and Newton (without what they depend on), reads the
fields of their configuration classes, and compares them with those of
`tests/support/exported_servos.py`, which the tests hold the exports against. Where `install.sh` has
been run, Newton, mjlab and Isaac Lab's actuators run their exports: a tone through servos behind a
floating base, against our own simulation.
"""

from __future__ import annotations

import ast
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.common.tones import fit_sine
from pupper_sysid.servo_models.calibration.calibration import Calibration, load_calibration
from pupper_sysid.servo_models.delayed_pd import TIME_STEP_S
from pupper_sysid.sim.export.mjlab import MJLAB_PD
from pupper_sysid.sim.export.newton import export_newton
from pupper_sysid.sim.export.shared import EXPLICIT_PD, delays_at_step
from pupper_sysid.sim.export.targets import SIMULATORS
from pupper_sysid.sim.robot.servo_mjcf import FRICTION_SOLIMP, friction_solref

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
sys.path.insert(0, str(ROOT / "tests"))

CALIBRATED = str(ROOT / "data/samples/calibrated.yaml")
STEP_S, TONE_HZ = 0.005, 3.0
ENGINES = {"isaaclab": EXPLICIT_PD, "newton": EXPLICIT_PD, "mjlab": MJLAB_PD}

_CLASSES = {
    "isaaclab": ("actuators/", ("ActuatorBaseCfg", "IdealPDActuatorCfg", "DelayedPDActuatorCfg")),
    "mjlab": ("actuator/", ("ActuatorCfg", "BuiltinPositionActuatorCfg")),
}
_NEWTON = {
    "add_actuator": {"drive_class", "index", "clamping", "delay_steps"},
    "builder": {"joint_armature", "joint_friction", "joint_target_ke", "joint_target_kd"},
    "drive_neural_mlp": {"input_order", "input_idx", "pos_scale", "vel_scale", "effort_scale"},
    "clamping_max_effort": {"max_effort"},
}


def fetched(package: str, folder: Path) -> tuple[str, Path]:
    """The newest wheel's version, and where it lies unpacked."""
    subprocess.run(
        [sys.executable, "-m", "pip", "download", "--no-deps", "-q", "-d", folder, package],
        check=True, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    wheel = next(folder.glob(f"{package}-*.whl"))
    with zipfile.ZipFile(wheel) as file:
        file.extractall(folder / package)
    return wheel.name.split("-")[1], folder / package


def fields(root: Path, part: str, names: tuple[str, ...]) -> set[str]:
    """Annotated fields of some classes, wherever below `part` they stand."""
    found: set[str] = set()
    for path in root.rglob("*.py"):
        if part not in path.as_posix():
            continue
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.ClassDef) and node.name in names:
                found |= {
                    b.target.id
                    for b in node.body
                    if isinstance(b, ast.AnnAssign) and isinstance(b.target, ast.Name)
                }
    return found


def tone(step_s: float) -> tuple[NDArray, NDArray]:
    """Times of steps, and what a loop of 50 Hz commands of a tone in each."""
    at = step_s * np.arange(round(3.0 / step_s))
    return at, 0.15 * np.sin(2 * np.pi * TONE_HZ * 0.02 * np.floor(at / 0.02 + 1e-9))


def phasors(at: NDArray, moved: NDArray) -> list[complex]:
    """Of each joint's steady motion, shape (steps, joints)."""
    late = at > 1.0
    return list(fit_sine(2 * np.pi * TONE_HZ * at[late], moved[late]).phasor)


def ran(
    simulator: str, calibration: Calibration, delay_steps: list[int], folder: Path
) -> list[complex]:
    """What a simulator makes of the tone with its export."""
    at, commands = tone(STEP_S)
    exported = folder / f"{simulator}_export"
    if simulator == "newton":
        export_newton(calibration, STEP_S, exported)
    else:
        exported.write_text(SIMULATORS[simulator](calibration, STEP_S))
    each = np.repeat(commands[:, None], len(calibration.joint_names), axis=1)
    np.savez(
        folder / "commands.npz", command=each, step_s=STEP_S, delay_steps=delay_steps,
        solref=friction_solref(STEP_S), solimp=FRICTION_SOLIMP,
    )  # fmt: skip
    subprocess.run(
        [HERE / f".venv-{simulator}/bin/python", HERE / f"in_{simulator}.py", exported,
         "commands.npz", "out.npz"],
        cwd=folder, check=True, capture_output=True,
    )  # fmt: skip
    return phasors(at + STEP_S, np.load(folder / "out.npz")["position"])


def print_tones(folder: Path) -> None:
    """Print gain and lag of the tone in each simulator that is installed, and in our own."""
    calibration = load_calibration(CALIBRATED)
    at, commands = tone(TIME_STEP_S)
    servo = calibration.delayed_pd()
    servo.reset(np.zeros(len(calibration.joint_names)))
    commanded = np.repeat(commands[:, None], servo.batch[0], axis=1)
    ours = phasors(at + TIME_STEP_S, servo.rollout(commanded))
    print(
        f"\n| {TONE_HZ:g} Hz, steps of {1e3 * STEP_S:g} ms | joint | amplitude | ours | lag ms "
        "| ours | delay rounded to steps by |\n|---|---|---|---|---|---|---|"
    )
    for simulator, engine in ENGINES.items():
        if not (HERE / f".venv-{simulator}").exists():
            continue
        delays = delays_at_step(calibration, STEP_S, engine)
        steps = [round(delays[name].value / STEP_S) for name in calibration.joint_names]
        theirs = ran(simulator, calibration, steps, folder)
        for name, taken, there, here in zip(
            calibration.joint_names, steps, theirs, ours, strict=True
        ):
            turn = 2 * np.pi * TONE_HZ
            lags = [1e3 * (-np.angle(1j * p) % (2 * np.pi)) / turn for p in (there, here)]
            rounded = 1e3 * (STEP_S * taken - delays[name].value)
            print(
                f"| {simulator} | {name} | {abs(there):.4f} | {abs(here):.4f} | {lags[0]:.1f} "
                f"| {lags[1]:.1f} | {rounded:+.1f} |"
            )


def main() -> None:
    """Print what was found; ends with 1 if a name is unknown."""
    from support import exported_servos as ours

    bad = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        print("| simulator | released | fields we write that it does not know |")
        print("|---|---|---|")
        for package, held in (("isaaclab", ours.ISAACLAB), ("mjlab", ours.MJLAB)):
            version, root = fetched(package, folder)
            there = fields(root, *_CLASSES[package])
            bad += len(held - there)
            print(f"| {package} | {version} | {', '.join(sorted(held - there)) or 'none'} |")
        version, root = fetched("newton", folder)
        text = {p.stem: p.read_text() for p in root.rglob("*.py") if p.stem in _NEWTON}
        text["add_actuator"] = text["builder"][text["builder"].index("def add_actuator") :]
        unknown = sorted(n for k, names in _NEWTON.items() for n in names if n not in text[k])
        bad += len(unknown)
        print(f"| newton | {version} | {', '.join(unknown) or 'none'} |")

        print_tones(folder)
    sys.exit(1 if bad else 0)


if __name__ == "__main__":
    main()
