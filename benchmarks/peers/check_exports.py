"""Do the released simulators know the names that our exports use, and move as we do?

    .venv/bin/python benchmarks/peers/check_exports.py

Downloads the newest wheels of Isaac Lab, mjlab and Newton (without what they depend on), reads the
fields of their configuration classes, and compares them with those of
`tests/support/exported_servos.py`, which the tests hold the exports against. Where `install.sh` has
been run, Newton, mjlab and Isaac Lab's actuators run their exports: unseen tones and a walk through
servos behind a floating base, against the calibration's own model, and the age of their readings.
"""

from __future__ import annotations

import ast
import os
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.servo_models.calibration.calibration import load_calibration
from pupper_sysid.sim.export.check import compiled, held, moved_by, unseen_tones, walk_commands
from pupper_sysid.sim.export.export import SIMULATORS
from pupper_sysid.sim.export.shared import ExportedServos
from pupper_sysid.sim.robot.servo_mjcf import FRICTION_SOLIMP, friction_solref

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
sys.path.insert(0, str(ROOT / "tests"))

CARDS = (str(ROOT / "data/samples/calibrated.yaml"), "sts3215-bam-m1", "sts3215-open-duck")
STEPS_S = (0.002, 0.005)
VENVS = Path(os.environ.get("EXPORT_VENVS", HERE))
"""Where `install.sh` made the environments."""

_CLASSES = {
    "isaaclab": ("actuators/", ("ActuatorBaseCfg", "IdealPDActuatorCfg", "DelayedPDActuatorCfg")),
    "mjlab": ("actuator/", ("ActuatorCfg", "BuiltinPositionActuatorCfg")),
}
_NEWTON = {
    "builder": {
        "joint_armature", "joint_friction", "joint_damping", "joint_target_ke", "joint_target_kd",
        "joint_target_mode", "custom_attributes",
    },
    "control": {"joint_f"},
}  # fmt: skip


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


def ran(
    simulator: str, servos: ExportedServos, commands: NDArray, folder: Path
) -> tuple[NDArray, NDArray]:
    """Positions and readings of the servos, shape (steps, joints), in a simulator."""
    step_s, names = servos.physics_step_s, servos.calibration.joint_names
    if simulator == "mujoco":
        there = moved_by(compiled(servos), names, commands, step_s)
        return there, there
    exported = folder / f"{simulator}_export.py"
    exported.write_text(SIMULATORS[simulator](servos))
    each = np.repeat(held(commands, step_s)[:, None], len(names), axis=1)
    np.savez(
        folder / "commands.npz", command=each, step_s=step_s, solref=friction_solref(step_s),
        solimp=FRICTION_SOLIMP,
    )  # fmt: skip
    subprocess.run(
        [VENVS / f".venv-{simulator}/bin/python", HERE / f"in_{simulator}.py", exported,
         "commands.npz", "out.npz"],
        cwd=folder, check=True, capture_output=True,
    )  # fmt: skip
    out = np.load(folder / "out.npz")
    return out["position"], out["reading"]


def print_parity(folder: Path) -> None:
    """Print how far each card is from its own model in each simulator that is installed."""
    print(
        "\n| card | step ms | simulator | tones mrad | walk mrad | readings: age ms | of the card "
        "| whole steps would cost mrad |\n|---|---|---|---|---|---|---|---|"
    )
    tones, walk = unseen_tones(), walk_commands()
    for card in CARDS:
        for step_s in STEPS_S:
            servos = ExportedServos.of(load_calibration(card), step_s)
            for simulator in ("mujoco", "mjlab", "newton", "isaaclab"):
                if simulator != "mujoco" and not (VENVS / f".venv-{simulator}").exists():
                    continue
                apart, age = [], np.nan
                for commands in (tones, walk):
                    there, readings = ran(simulator, servos, commands, folder)
                    here = own_motion(servos, commands, len(there))
                    apart.append(1e3 * np.sqrt(np.mean((there - here) ** 2)))
                    age = mean_age_s(there, readings, step_s)
                held_s = np.mean([
                    servos.calibration.held_feedback(n).mean_age_s
                    for n in servos.calibration.joint_names
                ])  # fmt: skip
                of_card = f"{1e3 * held_s:.1f}" if simulator != "mujoco" else ""
                shown = f"{1e3 * age:.1f}" if simulator != "mujoco" else ""
                cost = 1e3 * servos.cost_of_whole_steps()
                print(
                    f"| {Path(card).stem} | {1e3 * step_s:g} | {simulator} | {apart[0]:.2f} "
                    f"| {apart[1]:.2f} | {shown} | {of_card} | {cost:.1f} |"
                )


def own_motion(servos: ExportedServos, commands: NDArray, steps: int) -> NDArray[np.float64]:
    """Positions by the calibration's own PD in the steps of its fit, at the simulator's steps."""
    servo = servos.moving.delayed_pd()
    servo.reset(np.zeros(servo.batch))
    own = servo.rollout(np.repeat(held(commands, servo.time_step_s)[:, None], *servo.batch, axis=1))
    at = servos.physics_step_s * np.arange(1, steps + 1)
    fine = servo.time_step_s * np.arange(len(own) + 1)
    return np.stack([np.interp(at, fine, np.append(0.0, column)) for column in own.T], axis=1)


def mean_age_s(positions: NDArray, readings: NDArray, step_s: float) -> float:
    """Mean age of readings by the shift of the motion that fits them best."""
    at = step_s * np.arange(len(positions))
    ages = np.arange(0.0, 0.08, 0.0005)
    errors = [
        np.mean([
            np.mean((np.interp(at - age, at, p) - r)[40:] ** 2)
            for p, r in zip(positions.T, readings.T, strict=True)
        ])
        for age in ages
    ]  # fmt: skip
    return float(ages[int(np.argmin(errors))])


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
        unknown = sorted(n for k, names in _NEWTON.items() for n in names if n not in text[k])
        bad += len(unknown)
        print(f"| newton | {version} | {', '.join(unknown) or 'none'} |")

        print_parity(folder)
    sys.exit(1 if bad else 0)


if __name__ == "__main__":
    main()
