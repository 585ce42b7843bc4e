"""The guided calibration of joints: with a scripted person, and over a port."""

import os
import threading
from contextlib import nullcontext

import numpy as np
import pytest

from pupper_sysid.cli.commands.emulate import Hand
from pupper_sysid.cli.commands.joint_maps import Guide
from pupper_sysid.cli.programs.pupper_sysid import main
from pupper_sysid.common.errors import BusError
from pupper_sysid.common.joints import JOINT_NAMES
from pupper_sysid.hardware.bus import BusSample
from pupper_sysid.hardware.joint_map import load_joint_map
from pupper_sysid.sim.emulator.bench import ServoBench
from pupper_sysid.sim.emulator.robot import draw_robot
from support.servo_servers import bench_of, on_a_port, still_servos
from support.stopwatch import wait_until
from support.virtual_time import VirtualTime

PRESET = load_joint_map("mini_pupper_2")


class ScriptedBus(VirtualTime):
    """Twelve servos in virtual time that stand where the test puts them."""

    name = "scripted"

    def __init__(self, joint_map=PRESET, confirms=True):
        self.joint_names = joint_map.joint_names
        self.counts = np.full(len(self.joint_names), joint_map.file.counts // 2)
        self.confirms, self.limp = confirms, False

    def read(self):
        position = np.zeros(len(self.counts))
        return BusSample(np.full(len(self.counts), self.time), position, self.counts.copy())

    def torque(self, on):
        assert not on, "a calibration never holds"
        self.limp = self.confirms
        return self.confirms


class ScriptedPerson:
    """Answers questions in turn, each with a word it must contain; in between moves the joints."""

    def __init__(self, *script):
        self.script = list(script)
        self.motions: list = []

    def ask(self, question):
        word, answer, *then = self.script.pop(0)
        assert word in question
        for do in then:
            do()
        return answer

    def unseen(self):
        return nullcontext()

    def line(self):
        """None while there are motions left, then Enter."""
        if not self.motions:
            return ""
        self.motions.pop(0)()
        return None


def guide(person, joints=JOINT_NAMES, bus=None, start=PRESET):
    bus = bus or ScriptedBus(start)
    return Guide(bus, start, list(joints), person), bus


def test_the_servos_go_limp_only_after_enter_and_must_confirm_it(capsys):
    bus = ScriptedBus()
    seen: list[bool] = []
    person = ScriptedPerson(("will go limp", "", lambda: seen.append(bus.limp)))
    guide(person, bus=bus)[0].go_limp()
    assert seen == [False] and bus.limp
    assert "added on top of it" in capsys.readouterr().err, "the proxy's counts are told apart"
    with pytest.raises(BusError, match="not every servo confirmed"):
        guide(ScriptedPerson(("limp", "")), bus=ScriptedBus(confirms=False))[0].go_limp()


def test_offsets_are_measured_again_if_the_robot_was_not_held_still(capsys):
    bus = ScriptedBus()
    read = bus.read

    def shaken():
        bus.counts[0] += 1
        return read()

    def hold():
        bus.read = read
        bus.counts[:] = np.arange(500, 512)

    def shake():
        bus.read = shaken

    person = ScriptedPerson(
        ("still", "", shake), ("k to keep", "x"), ("k to keep", ""), ("still", "", hold)
    )
    offsets = guide(person, bus=bus)[0].offsets()
    assert list(offsets.values()) == list(range(-12, 0)) and list(offsets) == list(JOINT_NAMES)
    assert "'x' is none of Enter, k" in capsys.readouterr().err


def test_a_joint_that_was_not_moved_is_named_and_can_be_moved_later_or_left(capsys):
    person = ScriptedPerson()
    steps, bus = guide(person, ("LF_hip", "LF_thigh"))

    def only(joint, counts):
        index = JOINT_NAMES.index(joint)
        return [lambda c=c: bus.counts.__setitem__(index, c) for c in np.repeat(counts, 2)]

    person.motions = only("LF_hip", [400, 700])
    person.script = [("keep the starting map's limits for it", "k")]
    assert steps.limits() == {"LF_hip": (406, 694)}
    assert "LF_thigh did not move from count 512" in capsys.readouterr().err

    def later():
        person.motions = only("LF_thigh", [300, 500])

    person.motions = only("LF_hip", [400, 700])
    person.script = [("go on moving", "", later)]
    # what a refused joint did before is forgotten: 300 to 500, of which 2 % are 4
    assert steps.limits() == {"LF_hip": (406, 694), "LF_thigh": (304, 496)}


def test_a_joint_that_stops_answering_is_not_taken_to_have_been_moved(capsys):
    person = ScriptedPerson()
    steps, bus = guide(person, ("LF_hip",))
    index = JOINT_NAMES.index("LF_hip")
    moved = [lambda c=c: bus.counts.__setitem__(index, c) for c in (400, 400, 700, 700)]
    unplugged = [lambda: bus.counts.__setitem__(index, -1)] * 30
    person.motions = [*moved, *unplugged]
    person.script = [("keep the starting map's limits for it", "k")]
    assert steps.limits() == {}
    assert "LF_hip does not answer any more" in _flat(capsys.readouterr().err)
    person.motions = [*moved, *unplugged[:5], moved[0]]  # a loose contact
    assert steps.limits() == {"LF_hip": (406, 694)}


def by(bus, counts):
    """A motion of all joints by some counts."""
    return lambda: bus.counts.__iadd__(counts)


DATA_SHEET = 1024 / np.radians(300)


@pytest.mark.parametrize(
    ("counts", "answer", "scale", "use", "words"),
    [
        (-270, None, 270 / (np.pi / 2), False, ["within 3 % of the map's 175.1, which is kept"]),
        # 307 counts for 90 degrees: 1024 would be 300.2 degrees
        (307, "n", DATA_SHEET, True, ["the starting map has 175.1 (+12 %)", "SCS0009's data"]),
        (307, "m", DATA_SHEET, False, ["the starting map has 175.1 (+12 %)", "SCS0009's data"]),
    ],
)
def test_a_scale_within_three_percent_keeps_the_maps_and_another_is_asked_about(
    capsys, counts, answer, scale, use, words
):
    person = ScriptedPerson()
    steps, bus = guide(person)
    person.script = [("first position", ""), ("by 90 degrees", "", by(bus, counts))]
    person.script += [("all joints", answer)] if answer else []
    measured, used = steps.scale("LF_hip", 90.0)
    assert measured == pytest.approx(scale, rel=0.002) and used is use
    err = _flat(capsys.readouterr().err)
    assert all(word in err for word in words)


def test_a_scale_that_no_servo_has_is_not_offered_and_the_step_can_be_skipped(capsys):
    person = ScriptedPerson()
    steps, bus = guide(person)
    person.script = [
        ("first position", ""), ("by 90 degrees", "", by(bus, 10)),
        ("first position", ""), ("by 90 degrees", "", by(bus, 60)), ("first position", "s"),
    ]  # fmt: skip
    assert steps.scale("LF_hip", 90.0) == (None, False)
    err = _flat(capsys.readouterr().err)
    assert "too little motion" in err and "no such servo has" in err


# --- the whole command, over a port


def _flat(text):
    return " ".join(text.split())


def run(monkeypatch, capsys, script, *arguments):
    """Exit code, stdout and stderr of the command; `script(type_line, heard)` plays the person."""
    read_end, write_end = os.pipe()
    said: list[str] = []

    def heard(words):
        # what was said so far is on stderr
        said.append(capsys.readouterr().err)
        return words in _flat("".join(said))

    def person():
        try:
            script(lambda text: os.write(write_end, f"{text}\n".encode()), heard)
        finally:  # or a failure here would leave the command waiting for ever
            os.close(write_end)

    thread = threading.Thread(target=person)
    with os.fdopen(read_end) as keyboard:
        monkeypatch.setattr("sys.stdin", keyboard)
        thread.start()
        try:
            main(["calibrate-joints", *map(str, arguments)])
            code = 0
        except SystemExit as end:
            code = int(end.code or 0)
        thread.join(5)
    rest = capsys.readouterr()
    return code, rest.out, _flat("".join(said) + rest.err)


def test_a_whole_calibration_over_a_port_writes_what_was_done_by_hand(
    monkeypatch, capsys, tmp_path
):
    servos = still_servos(ids=[5, 6])  # the scale is checked on the first that is there
    bench = bench_of(servos)
    out = tmp_path / "joints.yaml"

    def all_to(count):
        bench.counts = dict.fromkeys(bench.counts, count)

    def person(enter, heard):
        for words, *counts in (
            ("will go limp", 2100), ("Hold it still",), ("Step 2 of 3", 1100, 3100),
            ("first position", 2000), ("Now move LF_thigh", 2000 + 1024),
        ):  # fmt: skip
            assert wait_until(lambda words=words: heard(words), 20.0)
            for count in counts:
                all_to(count)
                threading.Event().wait(0.2)
            enter("")

    with on_a_port(servos) as port:
        code, said, err = run(
            monkeypatch, capsys, person, "--bus", f"feetech:{port.device}@1000000", "--out", out,
            "--joint-map", "sts3215",
        )  # fmt: skip
    assert code == 0, err
    new = load_joint_map(out)
    thigh, hip = new.file.joints["LF_thigh"], new.file.joints["LF_hip"]
    assert (thigh.id, thigh.offset_counts, thigh.limits_counts) == (5, 2100 - 2048, (1140, 3060))
    assert thigh.counts_per_rad == pytest.approx(4096 / (2 * np.pi)) and "which is kept" in err
    assert hip.source == "preset", "who did not answer keeps the preset"
    assert "LF_hip" in err and "no answer" in err
    assert bench.goals == [] and {on for _, on in bench.torques} == {False}
    assert "Wrote" in said and "limp" in said


def test_an_input_that_ends_is_a_sentence_and_leaves_no_file(monkeypatch, capsys, tmp_path):
    out = tmp_path / "joints.yaml"
    with on_a_port(still_servos(ids=[4])) as port:
        code, _, err = run(
            monkeypatch, capsys, lambda enter, heard: None,
            "--bus", f"feetech:{port.device}@1000000", "--out", out, "--joint-map", "sts3215",
        )  # fmt: skip
    assert code == 2 and "the input ended before the calibration did" in err
    assert not out.exists()


# ----- a rehearsal: keys in the emulator's window move limp joints until a joint map is written


def bench() -> ServoBench:
    rng = np.random.default_rng(0)
    return ServoBench(draw_robot(rng), load_joint_map("sts3215"), rng)


def test_only_limp_joints_move_and_they_stay_where_they_were_put():
    servos = bench()
    hand, before = Hand(servos), [servos.angle(i, 0.0) for i in range(12)]
    assert "holds its position" in hand.press("d")
    for i in range(12):
        servos.torque(i, 0.0, False)
    assert hand.press("D") == "all joints: +0.40 rad" and hand.press("?") == ""
    assert hand.press("n") == "LF_hip: chosen" and hand.press("a") == "LF_hip: +0.35 rad"
    moved = [servos.angle(i, 5.0) - b for i, b in enumerate(before)]
    assert moved == pytest.approx([0.35, *[0.4] * 11], abs=0.02)
    assert hand.press("0") == "LF_hip: +0.00 rad"
    servos.torque(1, 5.0, True)
    assert servos.hand_rad[1] == 0.0
