"""pupper-train, pupper-play and pupper-eval as a user meets them."""

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

from pupper_sysid.cli import terminal
from pupper_sysid.cli.programs import pupper_eval, pupper_play, pupper_train
from pupper_sysid.common.results import plain
from pupper_sysid.policies.evaluation.evaluate import BATTERY
from pupper_sysid.policies.network.policy_file import Policy
from pupper_sysid.policies.train.learner import read_checkpoint
from pupper_sysid.policies.train.run_file import load_run, preset
from pupper_sysid.policies.walks.film import SIZE, Film
from pupper_sysid.sim.walking import env
from support.command_line import json_of, ran, refused
from support.json_keys import DOCUMENTED, key_line
from support.package import ROOT
from support.tiny_training import CALIBRATION

TINY = (
    "--actuator", CALIBRATION, "--environments", "4", "--threads", "1", "--iterations", "2",
    "--imitation.iterations", "2", "--imitation.epochs", "1",
    "--imitation.rollouts", "1", "--task.episode-s", "0.2",
    "--learner.steps-per-environment", "6", "--learner.minibatches", "2", "--learner.epochs", "1",
    "--architecture.hidden", "16", "--architecture.critic-hidden", "16", "--first-gait", "keep",
)  # fmt: skip


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A folder in which `pupper-train --name tiny` ran to its end."""
    folder = tmp_path_factory.mktemp("work")
    before = Path.cwd()
    os.chdir(folder)
    try:
        pupper_train.main([*TINY, "--name", "tiny"])
    finally:
        os.chdir(before)
    return folder / "runs" / "tiny"


# ------------------------------------------------------------------------------ pupper-train


def test_training_leaves_a_run_with_settings_curves_checkpoint_and_policy(trained):
    assert {p.name for p in trained.iterdir()} >= {
        "run.yaml", "progress.csv", "imitation.csv", "tensorboard", "last.pt", "policy_last",
    }  # fmt: skip
    settings = load_run(trained)
    assert settings.environments == 4 and settings.architecture.hidden == (16,)
    assert settings.actuator == CALIBRATION
    found = read_checkpoint(trained / "last.pt")
    assert found["iteration"] == 2 and found["more"]["imitated"] == 2


@pytest.mark.parametrize(("name", "kind"), [("fast", "lstm"), ("paper", "mlp"), ("release", "mlp")])
def test_all_settings_can_be_printed_and_are_those_of_the_preset(capsys, name, kind):
    arguments = ("--print-config", "--preset", name, f"--policy={kind}", "--seed", "7")
    out, err = ran(capsys, *arguments, program=pupper_train)
    assert err == ""
    assert yaml.safe_load(out) == plain(preset(name, kind)) | {"seed": 7}


def test_printed_settings_are_not_wrapped_or_coloured(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "40")
    name = "a/very/long/path/[red]with/brackets/" * 4 + "calibrated.yaml"
    out, _ = ran(capsys, "--print-config", "--actuator", name, program=pupper_train)
    assert yaml.safe_load(out)["actuator"] == name


def test_a_teacher_is_trained_and_then_learned_from(capsys, here):
    _, err = ran(capsys, *TINY, "--start", "teacher", "--name", "t", program=pupper_train)
    assert "pupper-train --start scratch --imitation.teacher runs/t" in " ".join(err.split())
    assert "has no RF_hip, " in err and "take the numbers of" in err  # its servos are those of LF
    taught = (*TINY, "--start", "scratch", "--imitation.teacher", "runs/t", "--name", "s")
    _, err = ran(capsys, *taught, program=pupper_train)
    assert "pupper-eval runs/s" in " ".join(err.split())
    assert (here / "runs/s/policy_best").is_dir()


def test_a_finished_run_can_be_resumed_and_stays_as_it_is(capsys, trained):
    _, err = ran(capsys, "--resume", trained, program=pupper_train)
    assert f"Going on with {trained}".replace(" ", "") in err.replace(" ", "")
    assert read_checkpoint(trained / "last.pt")["iteration"] == 2


@pytest.mark.slow
def test_ctrl_c_saves_and_ends_well(tmp_path):
    """A real process, a real signal: exit 130, a checkpoint, and the way to go on."""
    process = subprocess.Popen(
        [sys.executable, "-m", "pupper_sysid.cli.programs.pupper_train",
            *TINY, "--iterations", "100000",
         "--name", "stopped"],
        cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(ROOT)}, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        said = []
        for line in process.stderr:
            said.append(line)
            if "PPO 1/" in line:
                break
        process.send_signal(signal.SIGINT)
        _, rest = process.communicate(timeout=60)
    finally:
        process.kill()
    whole = "".join(said) + rest
    assert process.returncode == 130 and "Traceback" not in whole, whole
    assert "finishing this iteration; again ends at once" in " ".join(whole.split())
    assert "pupper-train --resume" in " ".join(whole.split())
    folder = tmp_path / "runs" / "stopped"
    assert 1 <= read_checkpoint(folder / "last.pt")["iteration"] < 100000
    assert (folder / "policy_last" / "contract.json").is_file()


# ------------------------------------------------------------------------------ pupper-eval


def test_an_evaluation_is_one_json_object_with_all_figures(capsys, trained):
    found = json_of(
        capsys, trained, "--episodes", "5", "--threads", "1",
        "--seconds", "0.5", "--terrain", "flat", "--extra-delay-ms", "0", "20", program=pupper_eval
    )  # fmt: skip
    assert found["actuator"] == CALIBRATION and found["feedback"] == "held"
    assert not found["quick"] and not found["battery"] and found["episode_s"] == 0.5
    names = [row["name"] for row in found["conditions"]]
    # flat ground and no added dead time are those of the random commands
    assert names[:2] == ["random commands", "forward"] and names[-1] == "dead time +20 ms"
    assert not any(name.startswith("ground") for name in names)
    for row in found["conditions"]:
        assert row["command"] is None or len(row["command"]) == 3
        for walker in ("policy", "trot", "standing"):
            own = row[walker]
            assert 0 <= own["fall_rate"] <= 1 and own["mae_vx_m_s"] > 0
            assert own["intervals"]["fall_rate"]["value"] == own["fall_rate"]
    first = found["conditions"][0]
    assert [first[w]["episodes"] for w in ("policy", "trot", "standing")] == [5, 2, 2]
    assert {f["walker"] for f in found["falls"]} <= {"policy", "trot", "standing"}
    # all but those of a fall, of which there need be none
    keys = DOCUMENTED["pupper-eval"]
    assert key_line(found | {"falls": []}) == keys[: keys.index(".{row")]


def test_a_quick_look_is_smaller_and_says_so(capsys, trained, monkeypatch):
    arguments = (trained, "--quick", "--terrain", "flat", "--extra-delay-ms", "0")
    for quick, full in (
        (pupper_eval._QUICK, pupper_eval._FULL),
        (pupper_eval._QUICK_BATTERY, pupper_eval._FULL_BATTERY),
    ):
        assert quick[0] < full[0] and quick[1] < full[1]
    monkeypatch.setattr(pupper_eval, "_QUICK", (2, 0.2))
    found = json_of(capsys, *arguments, program=pupper_eval)
    assert found["quick"] and found["episode_s"] == 0.2
    own = found["conditions"][0]["policy"]
    assert own["episodes"] == 2
    assert {row["policy"]["episodes"] for row in found["conditions"][1:]} == {1}
    error = own["intervals"]["mae_vx_m_s"]
    assert error["low"] < error["value"] == own["mae_vx_m_s"] < error["high"]
    out, err = ran(capsys, *arguments, "--seconds", "0.1", program=pupper_eval)
    assert "Quick look: 2 episodes of 0.1 s" in err and "±" in out
    assert "intervals are of 90 %" in err


@pytest.mark.slow
def test_the_battery_fits_a_terminal_of_80_columns_and_its_falls_say_what_came_before(
    capsys, trained, monkeypatch
):
    monkeypatch.setattr(terminal.out, "_width", 80)
    out, _ = ran(
        capsys, trained, "--battery", "--episodes", "2", "--seconds", "0.5", program=pupper_eval
    )
    lines = out.splitlines()
    assert max(map(len, lines)) <= 80
    for case in BATTERY:
        assert sum(line.startswith(case.name) for line in lines) >= 3
    columns = [line for line in lines if line.split()[:3] == ["policy", "trot", "standing"]]
    assert len(columns) == 1, "no title of a column is broken"
    assert "Speed over the commanded" not in out
    monkeypatch.setattr(env, "FALLEN_TILT", np.cos(np.deg2rad(8)))  # the least lean is a fall
    monkeypatch.setattr(pupper_eval, "_QUICK_BATTERY", (1, 1.0))
    found = json_of(capsys, trained, "--battery", "--quick", program=pupper_eval)
    assert found["battery"] and found["quick"]
    assert [row["name"] for row in found["conditions"][1:]] == [case.name for case in BATTERY]
    keys = key_line(found).replace(", command, policy", ", command[], policy")  # none here
    assert keys == DOCUMENTED["pupper-eval"]
    for fall in found["falls"]:
        assert 0 < fall["time_s"] <= 1.0 and 0 <= fall["tilt_before_deg"] < 90
        assert len(fall["command"]) == 3 and fall["row"] in {
            row["name"] for row in found["conditions"]
        }


def test_an_evaluation_is_a_table_and_a_page_with_every_direction(capsys, trained, tmp_path):
    arguments = (
        trained, "--episodes", "1", "--terrain", "rough", "--extra-delay-ms", "0", "--threads", "1",
        "--seconds", "0.1", "--report", tmp_path / "report",
    )  # fmt: skip
    out, _ = ran(capsys, *arguments, program=pupper_eval)
    page = tmp_path / "report" / "walking.html"
    text = page.read_text()
    for name in ("random commands", "forward", "turn right", "ground: rough"):
        assert name in out and name in text
    assert "standing, random" in out and "How it was trained" in text
    assert "learner.epochs" in text and CALIBRATION in text
    assert (tmp_path / "report" / "figures" / "training.png").stat().st_size > 2000
    assert "walking.html exists already" in refused(capsys, pupper_eval, *arguments)


def test_the_feedback_of_a_policy_without_its_run_is_that_of_its_contract(
    capsys, trained, tmp_path
):
    alone = tmp_path / "alone"
    shutil.copytree(trained / "policy_last", alone)
    contract = alone / "contract.json"
    contract.write_text(contract.read_text().replace('"feedback": "held"', '"feedback": "ideal"'))
    found = json_of(
        capsys, alone, "--episodes", "1", "--actuator", CALIBRATION,
        "--seconds", "0.2", "--terrain", "flat", "--extra-delay-ms", "0", "--threads", "1",
        program=pupper_eval,
    )  # fmt: skip
    assert found["feedback"] == "ideal"


# ------------------------------------------------------------------------------ pupper-play


def test_a_walk_is_told_in_numbers(capsys, trained):
    arguments = ("--seconds", "0.2", "--command", "0.1", "0", "0.3")
    out, _ = ran(capsys, trained, *arguments, program=pupper_play)
    assert "command 0.10 m/s forward, 0.00 m/s left, 0.30 rad/s" in " ".join(out.split())


def test_a_fall_is_told_with_its_time(capsys, trained, monkeypatch):
    """Folding all legs, the trunk falls 9 cm: within 0.5 s, not at once."""
    monkeypatch.setattr(Policy, "act", lambda *_: np.array([[0.0, 4.0, -4.0] * 4]))
    out, _ = ran(capsys, trained, "--seconds", "2", program=pupper_play)
    time = float(out.split("Fell after ")[1].split(" s.")[0])
    assert 0.02 < time < 0.6


def test_where_nothing_can_be_drawn_the_walk_goes_on_without_a_video(
    capsys, trained, here, monkeypatch
):
    import mujoco

    def no_gl(*_, **__):
        raise RuntimeError("no EGL display")

    monkeypatch.setattr(mujoco, "Renderer", no_gl)
    arguments = ("--seconds", "0.2", "--video", here / "walk.mp4")
    out, err = ran(capsys, trained, *arguments, program=pupper_play)
    assert "command 0.15 m/s" in out
    assert "No frames can be drawn here (RuntimeError: no EGL display)" in err
    assert not (here / "walk.mp4").exists()


@pytest.fixture
def film(monkeypatch) -> dict:
    """What is drawn and written, by a renderer and a writer that stand in for the real ones."""
    mujoco, imageio = pytest.importorskip("mujoco"), pytest.importorskip("imageio.v2")
    seen: dict = {"pictures": 0}

    class Screen:
        def __init__(self, model, height, width):
            assert model.vis.global_.offheight >= height and model.vis.global_.offwidth >= width

        def update_scene(self, data, camera, scene_option):
            seen.update(groups=scene_option.geomgroup.tolist(), distance_m=camera.distance)

        def render(self):
            return np.zeros((*SIZE, 3), np.uint8)

    class Writer:
        def __init__(self, path, fps, **how):
            seen["fps"] = fps

        def append_data(self, picture):
            seen["pictures"] += 1
            seen["written"] = picture.any(axis=2).sum(axis=1)

        def close(self): ...

    monkeypatch.setattr(mujoco, "Renderer", Screen)
    monkeypatch.setattr(imageio, "get_writer", Writer)
    return seen


def test_a_video_runs_as_fast_as_the_robot_at_any_control_rate(capsys, trained, here, film):
    settings = (trained / "run.yaml").read_text()
    shutil.copytree(trained, here / "slow")
    slow = settings.replace("control_step_s: 0.02", "control_step_s: 0.04")
    (here / "slow/run.yaml").write_text(slow)
    arguments = ("--seconds", "0.4", "--video", here / "walk.mp4")
    ran(capsys, here / "slow", *arguments, program=pupper_play)
    assert film["fps"] == pytest.approx(25) and film["pictures"] == 10
    # policy, speeds and time stand at the top of each picture
    assert film["written"][:160].sum() > 500 and not film["written"][200:].any()


def test_a_robot_of_another_size_whose_shapes_are_hidden_is_drawn(tmp_path, film):
    import mujoco

    distances = []
    for group, scale in ((3, 4.0), (0, 1.0)):
        model = mujoco.MjModel.from_xml_string(
            '<mujoco><worldbody><geom type="plane" size="1 1 1"/><body><freejoint/>'
            f'<geom size="0.1" group="{group}"/></body></worldbody></mujoco>'
        )
        made = Film(tmp_path / "walk.mp4", model, 0.02, ("a",), (0.1, 0.0, 0.0), scale)
        made.add(mujoco.MjData(model), np.zeros(3))
        assert film["groups"][3] == (group == 3) and film["groups"][0] == 1
        distances.append(film["distance_m"])
    assert distances[0] == pytest.approx(4 * distances[1])


def test_where_no_window_opens_that_is_said(capsys, trained, monkeypatch):
    for display in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(display, raising=False)
    said = refused(capsys, pupper_play, trained, "--viewer")
    assert "No window could be opened" in said and "DISPLAY" in said and "--video" in said
