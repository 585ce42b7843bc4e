"""Option values that nobody means, and every command."""

from __future__ import annotations

from pupper_sysid.cli.programs import pupper_analyze, pupper_sysid

OPTIONS: list[tuple[tuple[str, ...], bool]] = []
"""A command and whether it must be refused."""


def _values(words: str, option: str, *values: str, refused: bool = True) -> None:
    for value in values:
        OPTIONS.append(((*words.split(), option, value), refused))


_SWEEP = "pupper_sysid sweep --joints LF_hip --duration 0.5 --freqs 5"
_NO_NUMBERS = ("nan", "inf", "-inf", "4_1", "٤", "1e400", "", "x", "0x10")
_values(_SWEEP, "--rate", *_NO_NUMBERS, "0", "-1", "1e12", "1e-12")
_values("pupper_sysid sweep --joints LF_hip --freqs 5", "--duration", *_NO_NUMBERS, "0", "-1",
        "1e12", "1e-12", "1e308")  # fmt: skip
_values(_SWEEP, "--amplitude", *_NO_NUMBERS, "-1")
_values(_SWEEP, "--amplitude", "1e12", refused=False)  # reduced, with a warning
_values("pupper_sysid sweep --playback commands.csv", "--loops", "0", "-1", "1e12",
        "1000000000000", "9" * 400, "1_0", "٣", "1.5")  # fmt: skip
_values("pupper_sysid sweep --joints LF_hip --duration 0.5", "--freqs", "", ",", "1-1e12", "0",
        "-5", "1-10:0", "1-10:1e-300", "nan", "inf", "1-nan", "1_0", "٥", "10-1", "1:1", "1--5",
        "1e300")  # fmt: skip
_values(_SWEEP, "--joints", "", ",", "x", "LF_hip\x1b[31m", "a" * 100_000, "../LF_hip", "ＬＦ")
_values(_SWEEP, "--seed", "-1", "1.5", "1e3", "x", "٣", "9" * 5000)
_values(_SWEEP, "--seed", "9" * 200, refused=False)
_values(_SWEEP, "--bus", "", "x", "feetech:", "feetech:/dev/null", "feetech:/dev/zero@9",
        "feetech:/nonexistent", "esp32:/dev/null", "esp32:/nonexistent", "esp32:" + "x" * 300,
        "feetech:/dev/full@٥", "feetech:/dev/tty@99999999999999")  # fmt: skip
_values(_SWEEP, "--out", "/dev/null", "/dev/full", ".", "a" * 300 + ".csv",
        "sweep.csv/x.csv", "a\0.csv", "sweep.csv", "/proc/x.csv", "")  # fmt: skip
_values(f"{_SWEEP} --force", "--out", "/dev/stdout", "/proc/self/mem", ".")
_values(_SWEEP, "--until", "", "x", "dead_time:", "dead_time:nanms", "dead_time:1e400ms",
        "dead_time:-1ms", "dead_time:٢ms", "dead_time:0ms", "lag:2ms")  # fmt: skip
_values(_SWEEP, "--load", "", "pendulum", "pendulum:nankg@1m", "pendulum:1e400kg@1m",
        "pendulum:0kg@0m", "pendulum:٢kg@1m", "pendulum:1kg@1m,arm=x")  # fmt: skip
_values(f"{_SWEEP} --load none", "--gains", "", "0", "1,1", "256", "-1", "x", "٨", "1e1")
_values("pupper_sysid plan --joints LF_hip", "--seconds", *_NO_NUMBERS, "0", "-1", "1e12")
_values("pupper_sysid plan --joints LF_hip", "--rate", "0", "-1", "nan", "inf", "1e12", "1e-12")
_values("pupper_sysid import wide.csv", "--unit", "", "x", "counts:", "counts:nan", "counts:4_096",
        "counts:-1", "percent:0", "percent:inf", "scale:1e300", "scale:٣")  # fmt: skip
_values("pupper_sysid import wide.csv", "--time", "", "x", "\x1b[2J")
_values("pupper_sysid import wide.csv", "--time", "knee_command", refused=False)
_values("pupper_sysid import wide.csv --position knee_position", "--command", "", "{joint}{joint}",
        "(", "x" * 100_000, "{joint", "[a-")  # fmt: skip
_values("pupper_sysid import wide.csv", "--joints", "", "x", "a,a", ",,,")
_values("pupper_sysid import wide.csv", "--mapping", "/dev/zero", "/dev/null", ".", "x", "wide.csv")
_values("pupper_sysid export calibrated.yaml --to isaaclab", "--physics-step", "0", "-1", "nan",
        "inf", "1e-300", "1e300")  # fmt: skip
_values("pupper_sysid export calibrated.yaml --to mjcf", "--gain", "nan", "-1", "0", "1e300")
_values("pupper_sysid servo show sts3215-bam-m6", "--gain", "nan", "-1", "inf")
_values("pupper_sysid servo", "show", "x", "", "../card.yaml", "/dev/zero", "a" * 5000, ".")
_values("pupper_sysid calibrate sweep.csv", "--stall-torque", "0", "-1", "nan", "inf", "x")
_values("pupper_sysid calibrate fleet", "--jobs", "0", "-1", "x")
_values("pupper_sysid calibrate sweep.csv", "--cluster", "x", "tcp://1", "")
_values("pupper_sysid fit-servo sweep.csv", "--arch", "x", "")
_values("pupper_sysid doctor sweep.csv", "--read-limit", *_NO_NUMBERS, "0", "-1", "1001", "0.5")
_values("pupper_sysid monitor --bus emulated --once", "--rate", "0", "-1", "nan", "inf", "1e12")
_values("pupper_sysid monitor --bus emulated --rate 100", "--seconds", "0", "-1", "nan", "x")
_values("pupper_sysid emulate feetech", "--ids", "", "x", "0", "1-999999999999", "5-1", "1,", "٣",
        "-1", "1-2-3")  # fmt: skip
_values("pupper_sysid emulate feetech", "--baud", "0", "-1", "1", "9" * 50)
_values("pupper_sysid emulate feetech", "--faults", "x", "lost", "lost=2", "lost=nan", "lost=-1",
        "lost=٠", "lost=0.6,late=0.6")  # fmt: skip
_values("pupper_sysid emulate feetech --load none", "--backlash", "nan", "-1", "inf", "1e12")
_values("pupper_sysid emulate feetech --load none", "--registers", "p", "p=x", "p=-1", "p=70000",
        "x=1", "p=٣")  # fmt: skip
_values("pupper_sysid emulate esp32", "--socket", ".", "sweep.csv", "x" * 200, "/dev/null")
_POLICY = "pupper_deploy policy --actuator calibrated.yaml"
_values(f"{_POLICY} --name w", "--seconds", *_NO_NUMBERS, "0", "-1")
_values(f"{_POLICY} --seconds 0.2", "--name", "../../x", "a/b", "", ".x", "a\x1b[31m", "a" * 300)
_values(f"{_POLICY} --seconds 0.2 --name w", "--rate", "nan", "0", "-1", "inf", "1e12")
_values(f"{_POLICY} --seconds 0.2 --name w", "--scale-rad", "nan", "-1", "1e12", "inf")
_values(f"{_POLICY} --seconds 0.2 --name w", "--lowpass-hz", "nan", "-1", "inf")
_values(f"{_POLICY} --seconds 0.2 --name w", "--fade-in-s", "nan", "-1", "inf")
_values("pupper_deploy policy --actuator calibrated.yaml --seconds 0.2 --name w", "--script",
        "/dev/zero", ".", "x", "sweep.csv")  # fmt: skip
_values("pupper_deploy", "--playback", "/dev/zero", ".", "x", "sweep.csv")
_values("pupper_deploy policy", "--replay", "/dev/zero", ".", "x", "sweep.csv")
_PLAY = "pupper_play policy --actuator calibrated.yaml"
_values(_PLAY, "--seconds", "nan", "0", "-1", "inf", "x")
_values(f"{_PLAY} --seconds 0.1 --command 0 0", "--seed", "-1")
_values(f"{_PLAY} --seconds 0.1", "--video", ".", "/dev/null", "x.txt", "/nonexistent/x.mp4")
_EVAL = "pupper_eval policy --actuator calibrated.yaml --episodes 1 --seconds 0.2"
_values(_EVAL, "--threads", "-1", "x", "1_0")
_values("pupper_eval policy --actuator calibrated.yaml --quick", "--episodes", "0", "-1", "x",
        "9" * 30)  # fmt: skip
_values("pupper_eval policy --actuator calibrated.yaml --quick", "--seconds", "0", "-1", "nan",
        "inf", "1e12")  # fmt: skip
_values(_EVAL, "--extra-delay-ms", "nan", "-1", "inf", "1e12")
_TINY = "pupper_train --actuator calibrated.yaml --name t --imitation.iterations 1"
_TRAIN = f"{_TINY} --minutes 0.01 --iterations 1"
_values(_TRAIN, "--environments", "0", "-1", "x", "9" * 30)
_values(f"{_TINY} --environments 4 --iterations 1", "--minutes", "nan", "-1",
        "0", "x")  # fmt: skip
_values(f"{_TINY} --environments 4 --minutes 0.01", "--iterations", "0",
        "-1", "1e3")  # fmt: skip
_TRAIN += " --environments 4"
_values(_TRAIN, "--threads", "-1", "9" * 30)
_values(_TRAIN, "--architecture.memory", "0", "-1", "9" * 30)
_values(_TRAIN, "--architecture.hidden", "0", "-1", "9" * 30)
_values(_TRAIN, "--task.episode-s", "0", "-1", "nan", "inf")
_values(_TRAIN, "--task.physics-step-s", "0", "-1", "nan", "1e-12", "1e12")
_values(_TRAIN, "--task.control-step-s", "0", "-1", "nan", "1e-12", "1e12")
_values(_TRAIN, "--learner.minibatches", "0", "-1", "1000000")
_values(_TRAIN, "--learner.learning-rate", "nan", "-1", "inf")
_values("pupper_train", "--actuator", "/dev/zero", ".", "x", "sweep.csv", "")
_values("pupper_train", "--resume", "/dev/zero", ".", "x", "sweep.csv")
_ANALYZE = "pupper_analyze gait policy --actuator calibrated.yaml --quick"
_values(_ANALYZE, "--robots", "0", "-1", "9" * 30)
_values(_ANALYZE, "--seconds", "0", "-1", "nan", "inf")
_values("pupper_sysid", "x", "\x1b[2J", "", "a" * 10_000)


def every_command() -> list[tuple[str, ...]]:
    """Every command once, with the work that it does in a few seconds, and the help of all."""
    found: list[tuple[str, ...]] = []
    for program in ("pupper_train", "pupper_play", "pupper_eval", "pupper_deploy"):
        found += [(program, "--help"), (program, "--version")]
    for module in (pupper_sysid, pupper_analyze):
        program = module.__name__.rsplit(".", 1)[1]
        found += [(program, "--help"), (program, "--version"), (program,)]
        found += [(program, word, "--help") for word in module.COMMANDS]
    for words in (
        "doctor sweep.csv", "delay sweep.csv", "bode sweep.csv", "plan --joints LF_hip --seconds 5",
        "import wide.csv", "calibrate sweep.csv --out c.yaml --joints LF_hip", "sindy sweep.csv",
        "fit-servo sweep.csv --arch fir --out s", "compare sweep.csv --models calibrated.yaml",
        "report sweep.csv --out r", "export calibrated.yaml", "servo list",
        "servo show sts3215-bam-m6", "servo diff sts3215-bam-m6 sts3215-bam-m1",
        "init-robot robot.xml", "monitor --bus emulated --once", "backlash sweep.csv",
        "sweep --joints LF_hip --freqs 5 --duration 0.5",
    ):  # fmt: skip
        found.append(("pupper_sysid", *words.split()))
        if words.split()[0] not in ("export", "monitor"):
            found.append(("pupper_sysid", *words.split(), "--json"))
    found += [
        ("pupper_train", "--print-config"),
        ("pupper_deploy", "policy", "--actuator", "calibrated.yaml", "--seconds", "0.2"),
        ("pupper_deploy", "policy", "--actuator", "calibrated.yaml", "--seconds", "0.2", "--json"),
        ("pupper_play", "policy", "--actuator", "calibrated.yaml", "--seconds", "0.1"),
    ]
    return found
