"""Do the released simulators know the names that our exports use, and move as we do?

    .venv/bin/python benchmarks/peers/check_exports.py [WALK.csv]

Downloads wheels of Isaac Lab, mjlab and Newton (without what they depend on), reads the
fields of their configuration classes, and compares them with those of
`tests/support/exported_servos.py`, which the tests hold the exports against. Where `install.sh` has
been run, Newton, mjlab and Isaac Lab's actuators run their exports: unseen tones and a walk through
servos behind a floating base, against the calibration's own model, and the age of their readings.
`WALK.csv` has other commands for the walk, a column of angles every 20 ms [rad].
"""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from shared import ROOT, print_rows  # isort: skip

import numpy as np
from numpy.typing import NDArray

from pupper_sysid.servo_models.calibration.calibration import load_calibration
from pupper_sysid.sim.export.check import compiled, held, moved_by, unseen_tones, walk_commands
from pupper_sysid.sim.export.shared import ExportedServos
from pupper_sysid.sim.export.targets import TARGETS
from pupper_sysid.sim.robot.servo_mjcf import FRICTION_SOLIMP, friction_solref
from support import exported_servos as ours

HERE = ROOT / "benchmarks/peers"
CARDS = (
    str(ROOT / "data/samples/calibrated.yaml"), "sts3215-bam-m1", "sts3215-open-duck", "xl330-m288",
    "robstride-03",
)  # fmt: skip
STEPS_S = (0.002, 0.005)
RELEASES = {
    "isaaclab": ("2.2.0", "2.3.2.post1", ""),
    "mjlab": ("1.3.0", ""),
    "newton": ("1.3.0", ""),
}
"""The oldest that the exports claim, and the newest."""
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


def fetched(package: str, version: str, folder: Path) -> tuple[str, Path]:
    """A wheel's version, the newest by default, and where it lies unpacked."""
    folder = folder / f"{package}{version}"
    wanted = f"{package}=={version}" if version else package
    subprocess.run(
        [sys.executable, "-m", "pip", "download", "--no-deps", "--ignore-requires-python", "-q",
         "-d", folder, wanted],
        check=True, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    wheel = next(folder.glob(f"{package}-*.whl"))
    with zipfile.ZipFile(wheel) as file:
        file.extractall(folder)
    return wheel.name.split("-")[1], folder


def fields(root: Path, part: str, names: tuple[str, ...]) -> set[str]:
    """Annotated fields of some classes, wherever below `part` they stand."""
    return {
        field.target.id
        for path in root.rglob("*.py")
        if part in path.as_posix()
        for node in ast.parse(path.read_text()).body
        if isinstance(node, ast.ClassDef) and node.name in names
        for field in node.body
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)
    }


def ran(
    simulator: str, jobs: Sequence[tuple[ExportedServos, NDArray]], folder: Path
) -> list[tuple[NDArray, NDArray]]:
    """Positions and readings of servos under commands in a simulator, each (steps, joints)."""
    if simulator == "mujoco":
        moved = [moved_by(compiled(s), s.calibration.joint_names, c, s.physics_step_s)
                 for s, c in jobs]  # fmt: skip
        return [(there, there) for there in moved]
    files = []
    for n, (servos, commands) in enumerate(jobs):
        files.append([f"{simulator}{n}.py", f"{simulator}{n}.npz", f"{simulator}{n}_out.npz"])
        text = TARGETS[simulator].text(servos)
        # latencies that are drawn have no motion to be compared with: the mean is in the dead time
        (folder / files[-1][0]).write_text(re.sub(r'"jitter_s": [^,]*', '"jitter_s": 0.0', text))
        step_s, joints = servos.physics_step_s, len(servos.calibration.joints)
        np.savez(
            folder / files[-1][1], step_s=step_s, solref=friction_solref(step_s),
            command=np.repeat(held(commands, step_s)[:, None], joints, axis=1),
            solimp=FRICTION_SOLIMP,
        )  # fmt: skip
    subprocess.run(
        [VENVS / f".venv-{simulator}/bin/python", HERE / f"in_{simulator}.py",
         *(name for job in files for name in job)],
        cwd=folder, check=True, capture_output=True,
    )  # fmt: skip
    outs = [np.load(folder / out) for _, _, out in files]
    return [(out["position"], out["reading"]) for out in outs]


def parity(folder: Path, walk: NDArray) -> Iterator[list[str]]:
    """Rows: how far each card is from its own model in each simulator that is installed."""
    servos = [ExportedServos.of(load_calibration(c), h) for c, h in product(CARDS, STEPS_S)]
    jobs = [(each, commands) for each in servos for commands in (unseen_tones(), walk)]
    for simulator in ("mujoco", "mjlab", "newton", "isaaclab"):
        if simulator != "mujoco" and not (VENVS / f".venv-{simulator}").exists():
            continue
        motions = ran(simulator, jobs, folder)
        for n, each in enumerate(servos):
            apart = []
            for (_, commands), (there, _) in zip(jobs[2 * n :][:2], motions[2 * n :], strict=False):
                off = there - own_motion(each, commands, len(there))
                apart.append(f"{1e3 * np.sqrt(np.mean(off**2)):.2f}")
            of, step_s = each.calibration, each.physics_step_s
            held_s = np.mean([of.held_feedback(name).mean_age_s for name in of.joint_names])
            ages = (mean_age_s(*motions[2 * n + 1], step_s), held_s)
            shown = ["", ""] if simulator == "mujoco" else [f"{1e3 * x:.1f}" for x in ages]
            cost = f"{1e3 * max(each.whole_step_costs().values()):.1f}"
            card = Path(CARDS[n // len(STEPS_S)]).stem
            yield [card, f"{1e3 * step_s:g}", simulator, *apart, *shown, cost]


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


def names(folder: Path) -> Iterator[list[str]]:
    """Rows: the fields that we write and that a released package does not know."""
    for package, versions in RELEASES.items():
        for wanted in versions:
            version, root = fetched(package, wanted, folder)
            if package == "newton":
                text = {p.stem: p.read_text() for p in root.rglob("*.py") if p.stem in _NEWTON}
                bad = {n for k, own in _NEWTON.items() for n in own if n not in text[k]}
            else:
                isaac_lab = ours.ISAACLAB if version < "3" else ours.ISAACLAB_3
                written = ours.MJLAB if package == "mjlab" else isaac_lab
                bad = written - fields(root, *_CLASSES[package])
            yield [package, version, *sorted(bad)]


def main() -> None:
    """Print what was found; ends with 1 if a name is unknown."""
    walk = np.loadtxt(sys.argv[1], delimiter=",", ndmin=1) if sys.argv[1:] else walk_commands()
    with tempfile.TemporaryDirectory() as name:
        rows = list(names(Path(name)))
        print_rows(
            ("simulator", "released", "fields we write that it does not know"),
            ((package, version, ", ".join(bad) or "none") for package, version, *bad in rows),
        )
        print_rows(
            ("card", "step ms", "simulator", "tones mrad", "walk mrad", "readings: age ms",
             "of the card", "whole steps would cost mrad"), parity(Path(name), walk),
        )  # fmt: skip
    sys.exit(any(len(row) > 2 for row in rows))


if __name__ == "__main__":
    main()
