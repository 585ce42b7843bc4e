"""`export`: a calibration, recording, servo model or policy in a form that other programs read."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from pupper_sysid.cli import terminal
from pupper_sysid.common.errors import InputError, refuse_outside
from pupper_sysid.common.files import refuse_overwrite, resolved, sha256, write_text
from pupper_sysid.common.reading.dialect import decimal
from pupper_sysid.servo_models.calibration.calibration import (
    PRESETS,
    Calibration,
    is_shipped,
    load_calibration,
)
from pupper_sysid.servo_models.calibration.parts import P_GAINS
from pupper_sysid.servo_models.cards import files
from pupper_sysid.servo_models.cards.card import CardCalibration
from pupper_sysid.sim.export.shared import INCLUDES_LINK, ExportedServos
from pupper_sysid.sim.export.targets import TARGETS

if TYPE_CHECKING:
    Format = str
else:
    Format = tyro.extras.literal_type_from_choices(["csv", *TARGETS, "bam", "onnx", "torchscript"])

_STEPS_S = 1e-5, 0.1


@dataclass(frozen=True)
class Export:
    """Write a calibration, a servo card, a recording, a servo model or a policy for other programs.

    Example: pupper-sysid export calibrated.yaml --to isaaclab --physics-step 0.005

    Example: pupper-sysid export calibrated.yaml --to mjcf --model robot.xml --out robot_servos.xml

    Example: pupper-sysid export calibrated.yaml --check

    Example: pupper-sysid export calibrated.yaml --to csv --out calibrated.csv

    Example: pupper-sysid export sts3215-bam-m6 --to bam

    Example: pupper-sysid export servo/ --to onnx --out servo.onnx

    Example: pupper-sysid export runs/mlp --to onnx --out policy.onnx
    """

    source: tyro.conf.Positional[str]
    """calibrated.yaml, the name of a preset (paper, release), a servo card, a recording, or the
    folder of a servo model, a policy or a training run."""
    to: Format = "csv"
    """Format: csv, a tidy table; mjcf, isaaclab, isaaclab-bam (of servos fitted under load), mjlab,
    newton and json of calibrations and cards, for other simulators; bam of cards and of servos
    fitted under load, parameters for BAM; onnx and torchscript of learned servo models and
    policies."""
    physics_step: float | None = None
    """Physics step of that simulator [s], in which most count delays; by default 0.002 for mjcf, or
    that of its model, and 0.005 for the others."""
    gain: float | None = None
    """P gain of the position loop to predict, the register's value; of calibrations of servos
    recorded at several gains or under a known load, for a simulator."""
    link_inertia: tuple[str, ...] = ()
    """Inertia of link and load to take off armatures that hold them, such as LF_thigh=0.0012
    [kg·m²]; for simulators whose bodies have it, too."""
    model: Path | None = None
    """With --to mjcf: your robot's MJCF, to write a whole model with these servos in place of its
    own actuators; the inertia of links is taken from it."""
    check: bool = False
    """Simulate the export in MuJoCo beside the calibration, print how far apart they are, and write
    nothing."""
    out: Path | None = None
    """File to write; by default the source's name with the format's ending, in
    this folder."""
    force: bool = False
    """Replace the file if it exists."""
    json: bool = False
    """Print one JSON object that names the file written, and nothing else."""

    def run(self) -> None:
        """Convert and write."""
        refuse_outside("--physics-step", self.physics_step, *_STEPS_S, "s")
        refuse_outside("--gain", self.gain, *P_GAINS)
        links = {}
        for text in self.link_inertia:
            joint, _, inertia = text.partition("=")
            try:
                links[joint] = decimal(inertia)
            except ValueError:
                joint = ""
            if not joint:
                raise InputError(
                    f"--link-inertia {text}: write a joint and its inertia in kg·m², such as "
                    "LF_thigh=0.0012."
                )
        if self.model is not None and self.to != "mjcf":
            raise InputError("--model is of `--to mjcf`; for others give --link-inertia.")
        from pupper_sysid.cli.policy_choice import is_policy

        path = Path(self.source)
        if not is_shipped(self.source) and path.is_dir():
            if self.gain is not None:
                raise InputError(f"--gain is of calibrations; {path} is a folder.")
            target = self._policy(path) if is_policy(path) else self._servo_model(path)
        else:
            target = self._table(path, links)
        if target is not None and self.json:
            terminal.print_json({"written": str(target)})
        elif target is not None:
            terminal.err.print(f"Wrote {target}.")

    def _policy(self, folder: Path) -> Path:
        if self.to not in ("onnx", "torchscript"):
            raise InputError(
                f"{folder} is a policy: export it with `--to onnx` or `--to torchscript`."
            )
        from pupper_sysid.cli.policy_choice import policy_at
        from pupper_sysid.policies.network.policy_file import ENDINGS, export_policy

        policy, _ = policy_at(folder)
        target = self.out or Path(f"{resolved(folder).name}{ENDINGS[self.to]}")
        worst = export_policy(policy, self.to, target, self.force)
        terminal.err.print(f"Its actions equal the policy's to {worst:.1e}.")
        return target

    def _servo_model(self, folder: Path) -> Path:
        from pupper_sysid.servo_models.servo_file import load_servo_model
        from pupper_sysid.sysid.export import ENDINGS, export_servo_model

        if self.to not in ("csv", "onnx", "torchscript"):
            raise InputError(
                f"{folder} is a servo model, which predicts positions and has no torques; "
                f"{self.to} needs a calibration (`pupper-sysid calibrate`). A servo model "
                f"can become {', '.join(ENDINGS)}."
            )
        saved = load_servo_model(folder)
        # not with_suffix: a folder may be called servo-0.5
        target = self.out or Path(f"{resolved(folder).name}{ENDINGS[self.to]}")
        export_servo_model(saved, self.to, target, self.force)
        return target

    def _table(self, path: Path, links: dict[str, float]) -> Path | None:
        from pupper_sysid.sysid.recordings.files import load
        from pupper_sysid.sysid.report.tables import tidy_table

        if path.name in ("contract.json", "weights.safetensors"):
            raise InputError(f"{self.source} is part of a servo model; give its folder.")
        kind, card = path.suffix.lower(), files.is_card(self.source)
        named = is_shipped(self.source) or card
        if not named and kind not in (".yaml", ".yml", ".csv"):
            raise InputError(
                f"{self.source}: neither a calibration (.yaml), nor a recording (.csv), nor the "
                "folder of a servo model, nor a servo card (`pupper-sysid servo list`), nor one of "
                f"the presets {', '.join(PRESETS)}."
            )
        if self.to == "bam":
            return self._bam(path, card)
        if self.to in ("onnx", "torchscript"):
            raise InputError(
                f"{self.source} cannot become {self.to}: only a learned servo model can, a folder "
                "that `pupper-sysid fit-servo` wrote. Export it with `--to csv`."
            )
        if named or kind != ".csv":
            calibration = load_calibration(self.source)
            if self.check:
                return self._check(calibration, links)
            if self.to != "csv":
                return self._simulator(path, calibration, links)
            if self.gain is not None:
                calibration = self._at_gain(calibration, self.gain)
        elif self.to != "csv":
            raise InputError(
                f"{self.source} is a recording; {self.to} needs a calibration. Make one with "
                f"`pupper-sysid calibrate {self.source}`."
            )
        else:
            calibration = load(path)
            terminal.warn(*calibration.warnings)
        target = self.out or Path(path.name).with_suffix(".tidy.csv" if kind == ".csv" else ".csv")
        tidy_table(calibration, target, self.force)
        return target

    @staticmethod
    def _at_gain(calibration: Calibration, gain: float) -> Calibration:
        """The calibration at another P gain; says how far that was tested."""
        sentences = {
            joint.servo.how_far_tested(gain)
            for joint in calibration.joints.values()
            if joint.servo is not None
        }
        at_gain = calibration.at_p_gain(gain)
        for sentence in sorted(sentences):
            terminal.err.print(sentence)
        return at_gain

    def _bam(self, path: Path, card: bool) -> Path:
        """A servo card, or a servo calibrated under load, as a parameter file of BAM."""
        lost = []
        if card:
            servo_card = files.load_card(self.source)
        else:
            calibration = load_calibration(self.source)
            servo_card, lost = files.bam_card(calibration), files.lost_in_bam(calibration)
        target = self.out or Path(f"{path.name.removesuffix(path.suffix)}_bam.json")
        write_text(target, json.dumps(files.to_bam(servo_card), indent=4) + "\n", self.force)
        terminal.warn(*files.not_in_bam(servo_card), *lost)
        return target

    def _check(self, calibration: Calibration, links: dict[str, float]) -> None:
        """Print how far the export is from the calibration."""
        from pupper_sysid.sim.export.check import SWITCHED_OFF, WHOLE, check

        step = 0.002 if self.physics_step is None else self.physics_step
        checked = check(ExportedServos.of(calibration, step, self.gain, links))
        if self.json:
            return terminal.print_json(checked)
        n, wide = terminal.number, f"{1e3 * step:g} ms"
        terminal.print_table(
            f"Export in MuJoCo, steps of {wide}, beside the calibration, RMS",
            "joint", "tones mrad", "walk mrad", "same steps mrad", "readings counts",
            "whole steps mrad",
            rows=(
                (name, n(1e3 * row.tones_rad, 2), n(1e3 * row.walk_rad, 2),
                 n(1e3 * row.same_steps_rad, 2), n(row.reading_counts, 2),
                 n(1e3 * row.whole_steps_rad, 1))
                for name, row in checked.joints.items()
            ),
        )  # fmt: skip
        if any(row.step_rad[WHOLE] > 0 for row in checked.joints.values()):
            terminal.out.print()
            terminal.print_table(
                f"What steps of {wide} cost, RMS on the tones [mrad]", "joint", *SWITCHED_OFF,
                rows=(
                    (name, *(n(1e3 * cost, 2) for cost in row.step_rad.values()))
                    for name, row in checked.joints.items()
                ),
            )  # fmt: skip
            terminal.out.print()
        for sentence in checked.notes:
            terminal.err.print(sentence)

    def _simulator(self, path: Path, calibration: Calibration, links: dict[str, float]) -> Path:
        from pupper_sysid.sim.export.export import exported_text

        if self.gain is not None:
            self._at_gain(calibration, self.gain)
        target = self.out or Path(f"{path.stem}{TARGETS[self.to].ending}")
        refuse_overwrite(target, self.force)
        text, servos = exported_text(
            calibration, self.to, self.physics_step, self.gain, links, self.model, target,
            sha256(path) if path.is_file() else None,
        )  # fmt: skip
        write_text(target, text, self.force)
        terminal.err.print(
            f"For a physics step of {1e3 * servos.physics_step_s:g} ms (--physics-step).",
            *servos.operating_points(), sep="\n")  # fmt: skip
        absent = [n for n in calibration.joint_names if n not in servos.calibration.joint_names]
        if absent and not isinstance(calibration, CardCalibration):
            terminal.warn(f"{self.model} has no joint {', '.join(absent)}; left out.")
        if servos.with_link:
            terminal.warn(
                f"{', '.join(servos.with_link)}: {INCLUDES_LINK[0].lower()}{INCLUDES_LINK[1:]} "
                "For example --link-inertia "
                f"{servos.with_link[0]}=0.0002, or --to mjcf --model robot.xml."
            )
        return target
