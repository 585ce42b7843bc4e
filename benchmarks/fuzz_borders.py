"""Coverage-guided fuzzing of every border, from files to options: only the project's own errors.

Each target is run for its share of the time by atheris (libFuzzer), which keeps inputs that reach
new lines and mutates those, beginning with good files of every kind (`hostile.kit`). An exception
that is no `PupperError` is counted by its place and shown, and the run goes on. Needs atheris,
which is no dependency of the project: `pip install atheris`. Exits with 1 if anything was raised.

    nice -n 10 .venv/bin/python benchmarks/fuzz_borders.py --seconds 3600 --seed 1
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

_SHOWN = 5
_LONGEST = 20_000  # bytes of an input

# target: the files of the kit that it begins with, and their ending
FILES: dict[str, tuple[str, ...]] = {
    "recording": ("sweep.csv", "cut.csv", "wide.csv", "long.csv", "theirs.csv"),
    "JSON log": ("bam.json", "ktune.json"),
    "npz": ("log.npz",),
    "parquet": ("log.parquet",),
    "MCAP": ("log.mcap",),
    "SQLite": ("bag/bag.db3",),
    "calibration": ("calibrated.yaml",),
    "joint map": ("joints.yaml",),
    "plan": ("plan.yaml",),
    "servo card": ("card.yaml", "bam_model.json"),
    "mapping": ("mapping.yaml",),
    "settings of a run": ("run/run.yaml",),
    "contract of a policy": ("policy/contract.json",),
    "contract of a servo model": ("servo/contract.json",),
    "log of a walk": ("walk.csv",),
    "commands": ("commands.csv", "script.csv"),
}
TEXTS = ("1-10:0.5,20", "pendulum:0.1kg@0.10m,arm=0.02kg", "8,16,32", "dead_time:2ms", "deg",
         "counts:4096", "feetech:/dev/ttyUSB0@500000", "lost=0.02,late=0.01", "LF,RB_calf",
         "tls://host:8786")  # fmt: skip
OTHERS = ("Feetech frames", "proxy datagrams", "ROS messages", "texts of options", "command line")
LINES = ("sweep --freqs 1-3 --rate 50", "doctor a.csv --seed 3", "import x --unit deg --joints a,b",
         "calibrate x --stall-torque 0.3 --jobs 2", "plan --seconds 9 --read-limit 2")  # fmt: skip


def _reader(name: str) -> Callable[[Path], Any]:
    """What reads a file of this target; imported here, where atheris instruments imports."""
    from pupper_sysid.common.border import read_json, validated

    if name in ("recording", "JSON log", "npz", "parquet", "MCAP", "SQLite"):
        from pupper_sysid.sysid.recordings.files import load

        return load
    if name == "calibration":
        from pupper_sysid.servo_models.calibration.calibration import load_calibration

        return load_calibration
    if name == "joint map":
        from pupper_sysid.hardware.joint_map import load_joint_map

        return load_joint_map
    if name == "plan":
        from pupper_sysid.sysid.plan.plan_file import load_plan

        return load_plan
    if name == "servo card":
        from pupper_sysid.servo_models.cards.files import load_card

        return load_card
    if name == "mapping":
        from pupper_sysid.sysid.recordings.importers.shared.options import read_mapping

        return read_mapping
    if name == "settings of a run":
        from pupper_sysid.policies.train.run_file import load_run

        return lambda path: load_run(path.parent)
    if name == "contract of a policy":
        from pupper_sysid.policies.network.policy_file import Contract

        return lambda path: validated(Contract, read_json(path), path)
    if name == "contract of a servo model":
        from pupper_sysid.servo_models.servo_file import Contract as Servo

        return lambda path: validated(Servo, read_json(path), path)
    if name == "log of a walk":
        from pupper_sysid.policies.deploy.walk_log import read_walk

        return read_walk
    from pupper_sysid.policies.deploy.commands import script
    from pupper_sysid.sysid.sweep.playback import playback

    return lambda path: _each(path, playback, script)


def _each(value: Any, *calls: Callable[[Any], Any]) -> None:
    """All calls, of which each may refuse the value."""
    from pupper_sysid.common.errors import PupperError

    for call in calls:
        try:
            call(value)
        except PupperError:
            continue


def _of_bytes(name: str) -> Callable[[bytes], Any]:
    """What takes the bytes of a target that is no file."""
    if name == "Feetech frames":
        from pupper_sysid.hardware.feetech.frames import FrameReader

        return lambda data: FrameReader().feed(data)
    if name == "proxy datagrams":
        from pupper_sysid.hardware.esp32 import datagrams as d

        return lambda data: _each(data, d.parse_counts, d.parse_load, d.parse_imu, d.parse_power)
    if name == "ROS messages":
        from pupper_sysid.sysid.recordings.importers.ros_messages import KINDS, decode

        def messages(data: bytes) -> None:
            try:
                decode(KINDS[data[0] % 3 if data else 0], data[1:])
            except ValueError:  # that is its own error
                pass

        return messages
    if name == "texts of options":
        return _texts()
    from pupper_sysid.cli.programs.pupper_sysid import COMMANDS
    from pupper_sysid.cli.user_errors import parse

    def line(data: bytes) -> None:
        word, *rest = data.decode(errors="replace").split(" ")
        if word in COMMANDS and not {"-h", "--help"} & {*rest}:
            try:
                parse(COMMANDS[word].load(), rest, word)
            except SystemExit as end:
                if end.code != 2:
                    raise ValueError(f"exit code {end.code}") from end

    return line


def _texts() -> Callable[[bytes], Any]:
    import numpy as np

    from pupper_sysid.common.joints import select_joints
    from pupper_sysid.hardware.address import parse_address
    from pupper_sysid.sim.emulator.faults import BusFaults
    from pupper_sysid.sysid.fleet.calibration import trust
    from pupper_sysid.sysid.plan.until import parse_goal
    from pupper_sysid.sysid.recordings.importers.shared.units import unit
    from pupper_sysid.sysid.sweep.bench import parse_gains, parse_load
    from pupper_sysid.sysid.sweep.excitation import parse_frequencies

    rng = np.random.default_rng(0)
    return lambda data: _each(
        data.decode(errors="replace"), parse_frequencies, parse_load, parse_gains, parse_goal,
        unit, parse_address, select_joints, trust, lambda text: BusFaults.parse(text, rng),
    )  # fmt: skip


def fuzz(name: str, corpus: Path, seconds: int, seed: int) -> None:
    """Run one target in this process, which ends with it; exceptions are listed beside `corpus`."""
    import atheris

    with atheris.instrument_imports(include=["pupper_sysid"], enable_loader_override=False):
        from pupper_sysid.common.errors import PupperError

        call = _reader(name) if name in FILES else _of_bytes(name)
    folder = Path(tempfile.mkdtemp(dir="/dev/shm" if os.path.isdir("/dev/shm") else None))
    ending = "run.yaml" if name == "settings of a run" else f"x{Path(FILES[name][0]).suffix}" if (
        name in FILES) else ""  # fmt: skip
    raised: dict[str, int] = {}

    def one(data: bytes) -> None:
        try:
            if ending:
                (folder / ending).write_bytes(data)
                call(folder / ending)  # pyright: ignore[reportArgumentType]
            else:
                call(data)  # pyright: ignore[reportArgumentType]
        except PupperError:
            return
        except Exception as error:
            at = traceback.extract_tb(error.__traceback__)
            ours = next((f for f in reversed(at) if "/site-packages/" not in f.filename), at[-1])
            key = f"{type(error).__name__} {Path(ours.filename).name}:{ours.lineno}"
            raised[key] = raised.get(key, 0) + 1
            if raised[key] == 1:
                text = f"{key}: {error}"[:300]
                (corpus.parent / "raised").open("a").write(json.dumps([name, text]) + "\n")
                (corpus.parent / f"crash-{len(raised)}-{name.replace(' ', '_')}").write_bytes(data)

    quiet = open(os.devnull, "w")  # what commands print is not looked at
    sys.stdout = quiet
    atheris.Setup(
        [sys.argv[0], str(corpus), f"-max_total_time={seconds}", f"-seed={seed}",
         f"-max_len={_LONGEST}", "-print_final_stats=1", "-timeout=20", "-rss_limit_mb=4096"],
        one,
    )  # fmt: skip
    with redirect_stdout(quiet):
        atheris.Fuzz()


def seeds(name: str, kit: Path, corpus: Path) -> None:
    """Write what a target begins with."""
    corpus.mkdir()
    if name in FILES:
        for k, file in enumerate(FILES[name]):
            data = (kit / file).read_bytes()
            if len(data) > _LONGEST and data[:1] in b"#ts":  # a table: its first rows do
                data = data[: data.rfind(b"\n", 0, _LONGEST) + 1]
            (corpus / f"{k}").write_bytes(data[:_LONGEST])
    for k, text in enumerate(TEXTS if name == "texts of options" else LINES):
        if name in ("texts of options", "command line"):
            (corpus / f"{k}").write_text(text)
    if name == "Feetech frames":
        (corpus / "0").write_bytes(bytes.fromhex("FFFF010201FBFFFF03040001F601"))
    if name == "proxy datagrams":
        (corpus / "0").write_bytes(b"\x1a\x02" + bytes(range(24)))
        (corpus / "1").write_bytes(b"\x0a\x05" + bytes(8))
    if name == "ROS messages":
        from hostile.kit import joint_state

        (corpus / "0").write_bytes(b"\0" + joint_state(10**9, 0.5))


def main() -> int:
    """Run all targets one after the other, and print the table; 1 if anything was raised."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seconds", type=int, default=3600, help="for all targets together")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="targets with this in their name")
    parser.add_argument("--keep", type=Path, help="folder for inputs that raised something")
    parser.add_argument("--target", nargs=2, help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.target:
        fuzz(chosen.target[0], Path(chosen.target[1]), chosen.seconds, chosen.seed)
        return 0
    from hostile.kit import make_kit

    names = [n for n in (*FILES, *OTHERS) if chosen.only in n]
    here, wrong, total = Path.cwd(), 0, 0
    print("| target | seconds | cases | exceptions, by place |\n|---|---|---|---|")
    with tempfile.TemporaryDirectory() as name:
        work = chosen.keep or Path(name)
        work.mkdir(exist_ok=True)
        kit = Path(name) / "kit"
        kit.mkdir()
        os.chdir(kit)
        with open(os.devnull, "w") as nowhere, redirect_stdout(nowhere), redirect_stderr(nowhere):
            make_kit(kit)
        os.chdir(here)
        for target in names:
            folder = Path(tempfile.mkdtemp(dir=work))
            seeds(target, kit, folder / "corpus")
            started = time.perf_counter()
            ended = subprocess.run(
                [sys.executable, __file__, "--target", target, str(folder / "corpus"),
                 "--seconds", str(max(chosen.seconds // len(names), 1)),
                 "--seed", str(chosen.seed)],
                capture_output=True, text=True, errors="replace", check=False,
            )  # fmt: skip
            found = re.search(r"number_of_executed_units: (\d+)", ended.stderr)
            cases = int(found[1]) if found else 0
            file = folder / "raised"
            raised = [json.loads(line) for line in file.read_text().splitlines()] if (
                file.exists()) else []  # fmt: skip
            if not found:
                raised.append([target, f"ended: {ended.stderr[-300:]}"])
            wrong, total = wrong + len(raised), total + cases
            print(f"| {target} | {time.perf_counter() - started:.0f} | {cases:,} | {len(raised)} |",
                  flush=True)  # fmt: skip
            for _, text in raised[:_SHOWN]:
                print(f"  {text}", file=sys.stderr, flush=True)
    print(f"\n{total:,} cases, {wrong} exceptions.")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
