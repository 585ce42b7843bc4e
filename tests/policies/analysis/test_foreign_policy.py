"""Policies of other trainers walk here: from an ONNX file, its metadata and a few lines of YAML."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from pupper_sysid.common.joints import JOINT_NAMES
from pupper_sysid.data import SAMPLES
from pupper_sysid.policies.analysis.foreign_policy import (
    ForeignPolicy,
    exported_policy,
    servos_of_training,
)
from pupper_sysid.policies.analysis.servo_demand import servo_demand
from pupper_sysid.policies.analysis.trial import Trial
from pupper_sysid.policies.network.onnx_network import OnnxNetwork
from pupper_sysid.policies.network.policy_file import export_policy, load_policy
from pupper_sysid.sim.walking.servo_ranges import servo_ranges
from support.real_recordings import FOLDER
from support.refusals import assert_each_refused

onnx = pytest.importorskip("onnx")

DUCK = FOLDER.parent / "robots" / "open_duck_mini_v2.xml"
OWN_TERMS = """
control_step_s: 0.02
observation:
  - {term: constant, values: [0, 0, 0]}
  - base_ang_vel
  - projected_gravity
  - velocity_commands
  - joint_pos
  - {term: joint_vel, steps: 4}
  - joint_effort
  - actions
"""
"""The observation of this project's own policies."""


def exported_by(
    path: Path, nodes: Sequence[tuple], sizes: tuple[int, int],
    metadata: dict[str, str] | None = None, **weights: np.ndarray,
) -> Path:  # fmt: skip
    """A file of a policy of `nodes` (operator, inputs, outputs, attributes), and its weights."""
    helper, kinds = onnx.helper, onnx.TensorProto
    ends = [
        helper.make_tensor_value_info(name, kinds.FLOAT, [1, size])
        for name, size in zip(("obs", "actions"), sizes, strict=True)
    ]
    graph = helper.make_graph(
        [helper.make_node(*node[:3], **dict(*node[3:])) for node in nodes], "policy",
        ends[:1], ends[1:], [onnx.numpy_helper.from_array(w, name) for name, w in weights.items()],
    )  # fmt: skip
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    helper.set_model_props(model, metadata or {})
    onnx.save(model, str(path))
    return path


def linear(weights: np.ndarray, path: Path, metadata: dict[str, str] | None = None) -> Path:
    """A file of the policy `actions = weights @ observation`."""
    gemm = ("Gemm", ["obs", "w"], ["actions"], {"transB": 1})
    return exported_by(path, [gemm], weights.shape[::-1], metadata, w=weights.astype(np.float32))


def as_mjlab(names: Sequence[str], pose: Sequence[float], terms: str = "") -> dict[str, str]:
    """Metadata as mjlab's exporter writes them: numbers with three digits between commas."""
    count = len(terms.split(",")) if terms else 0
    return {
        "joint_names": ",".join(names), "default_joint_pos": ",".join(f"{p:.3f}" for p in pose),
        "action_scale": ",".join(["0.500"] * len(names)), "command_names": "twist",
    } | ({
        "observation_names": terms,
        "observation_terms_scale": ",".join(["1.000"] * count),
        "observation_terms_clip": ",".join(["[-inf, inf]"] * count),
        "observation_terms_history_length": ",".join(["0.000"] * count),
        "observation_terms_flatten_history_dim": ",".join(["1.000"] * count),
    } if terms else {})  # fmt: skip


@pytest.fixture
def exported(tmp_path) -> Path:
    """The sample MLP as an ONNX file of this project."""
    path = tmp_path / "own.onnx"
    export_policy(load_policy(SAMPLES / "policies/mlp"), "onnx", path)
    return path


@pytest.fixture
def theirs(exported) -> Path:
    """The same network with another trainer's metadata, and the YAML beside it."""
    model = onnx.load(str(exported))
    contract = load_policy(SAMPLES / "policies/mlp").contract
    pose = contract.default_pose_rad
    del model.metadata_props[:]
    onnx.helper.set_model_props(model, as_mjlab(list(pose), list(pose.values())))
    path = exported.with_name("theirs.onnx")
    onnx.save(model, str(path))
    path.with_suffix(".yaml").write_text(OWN_TERMS)
    return path


# ------------------------------------------------------------------------- the same policy


@pytest.mark.parametrize("kind", ["mlp", "lstm"])
def test_an_exported_policy_acts_as_the_one_it_came_from(tmp_path, kind):
    policy = load_policy(SAMPLES / "policies" / kind)
    export_policy(policy, "onnx", tmp_path / "own.onnx")
    same = exported_policy(OnnxNetwork(tmp_path / "own.onnx"))
    assert same is not None and same.contract == policy.contract
    rng = np.random.default_rng(0)
    start = rng.standard_normal((3, 12))
    policy.reset(start)
    same.reset(start)
    for _ in range(5):
        seen = rng.standard_normal((3, 60)).astype(np.float32)
        np.testing.assert_allclose(same.act(seen), policy.act(seen), rtol=1e-4, atol=1e-5)


def test_the_observation_of_terms_is_this_projects_own_where_the_terms_are(theirs):
    policy = load_policy(SAMPLES / "policies/mlp")
    foreign = ForeignPolicy.of(OnnxNetwork(theirs))
    foreign.fit(foreign.task(None))
    rng = np.random.default_rng(0)
    start = rng.standard_normal((3, 12)).astype(np.float32)
    foreign.reset(start)
    last = start
    for _ in range(3):
        seen = rng.standard_normal((3, 60)).astype(np.float32)
        seen[:, :3], seen[:, -12:] = 0.0, last  # as the environment gives them
        # metadata hold three digits of the pose
        np.testing.assert_allclose(foreign.observe(seen), seen, atol=6e-4)
        policy.reset(start)
        action = policy.act(seen)
        foreign.reset(last)
        np.testing.assert_allclose(foreign.act(seen), action, atol=1e-2)
        last = action
        foreign.reset(last)


# ------------------------------------------------------------------------- layouts


POSE = {"LF_hip": 0.1, "LF_thigh": 0.7, "LF_calf": -1.0}


def rows_of(
    tmp_path, size: int, terms: str, joints: Sequence[str] = JOINT_NAMES[:2]
) -> ForeignPolicy:
    """A policy of two joints with an observation of terms, fitted to the Mini Pupper."""
    path = linear(np.eye(2, size), tmp_path / "p.onnx")
    path.with_suffix(".yaml").write_text(
        f"joints: [{', '.join(joints)}]\ndefault_pose_rad: {[POSE[j] for j in joints]}\n"
        f"action_scale_rad: 0.25\ncontrol_step_s: 0.02\n{terms}\n"
    )
    policy = ForeignPolicy.of(OnnxNetwork(path))
    policy.fit(policy.task(None))
    policy.reset(np.zeros((1, 12)))
    return policy


def seen(**parts: Sequence[float]) -> np.ndarray:
    """An observation of the Mini Pupper with some parts other than 0."""
    row = np.zeros((1, 60), np.float32)
    places = {"rate": slice(3, 6), "command": slice(9, 12), "angle": slice(12, 24)}
    for name, values in parts.items():
        row[0, places[name]][: len(values)] = values
    return row


def test_history_age_clip_frames_and_a_phase_are_taken_from_the_yaml(tmp_path):
    # history repeats the first value and then moves, the oldest first
    policy = rows_of(tmp_path, 9, "observation: [{term: command, history: 3, scale: [2, 1, 1]}]")
    first, second = (policy.observe(seen(command=[k, 0, 0]))[0].tolist() for k in (1, 5))
    assert first == [2, 0, 0] * 3 and second == [2, 0, 0, 2, 0, 0, 10, 0, 0]
    terms = (
        "[{term: command, history: 2, newest: first, clip: [-1, 3]}, {term: base_ang_vel, age: 2}]"
    )
    policy = rows_of(tmp_path, 9, f"observation: {terms}")
    rows = [
        policy.observe(seen(command=[k, 0, 0], rate=[10 * k, 0, 0]))[0].tolist() for k in (1, 2, 7)
    ]
    assert rows[2] == [3, 0, 0, 2, 0, 0, 10, 0, 0]
    assert rows[0][6] == rows[1][6] == 10
    # frames stack whole rows
    nine = "frames: 2\nobservation: [command, {term: constant, values: [9]}]"
    policy = rows_of(tmp_path, 8, nine)
    policy.observe(seen(command=[1, 0, 0]))
    assert policy.observe(seen(command=[2, 0, 0]))[0].tolist() == [1, 0, 0, 9, 2, 0, 0, 9]
    # a phase runs with the actions: a quarter turn after 20 ms
    clock = "{term: phase, frequency_hz: 12.5, waves: [cos, sin]}"
    policy = rows_of(tmp_path, 2, f"observation: [{clock}]")
    policy.act(seen())
    np.testing.assert_allclose(policy.observe(seen())[0], [0.0, 1.0], atol=1e-6)


def test_joints_are_by_name_angles_from_the_policys_pose_and_speeds_over_its_steps(tmp_path):
    policy = rows_of(
        tmp_path,
        8,
        "observation: [joint_pos_rel, joint_pos_abs, {term: joint_vel, steps: 1}, joint_target]",
        ("LF_calf", "LF_hip"),
    )
    pose = policy._body.pose
    policy.observe(seen(angle=[0.0, 0.0, 0.0]))
    row = policy.observe(seen(angle=[0.02, 0.0, 0.04]))[0]
    np.testing.assert_allclose(row[:2], [pose[2] + 0.04 + 1.0, pose[0] + 0.02 - 0.1], atol=1e-6)
    np.testing.assert_allclose(row[2:4], [pose[2] + 0.04, pose[0] + 0.02], atol=1e-6)
    np.testing.assert_allclose(row[4:6], [2.0, 1.0], atol=1e-5)
    # the robot stood in its own pose before the first action
    np.testing.assert_allclose(row[6:], [pose[2], pose[0]], atol=1e-6)


def test_set_points_are_the_policys_pose_and_scale_and_other_joints_stay(tmp_path):
    policy = rows_of(tmp_path, 3, "observation: [command]", ("LF_calf", "LF_hip"))
    task = policy.task(None)
    action = policy.act(seen(command=[1.0, -2.0, 0.0]))[0].astype(float)
    target = task.body.pose + task.action_scale * action
    np.testing.assert_allclose(target[[2, 0]], [-1.0 + 0.25, 0.1 - 0.5], atol=1e-6)
    np.testing.assert_allclose(np.delete(target, [0, 2]), np.delete(task.body.pose, [0, 2]))


# ------------------------------------------------------------------------- files of others


@pytest.mark.parametrize("lists", [("[-inf, inf]", "[-1.0, 1.0]"), ("-inf;inf", "-1.000;1.000")])
def test_metadata_of_mjlabs_exporter_are_read(lists, tmp_path):
    scale = "[2.0, 2.0, 0.25]" if "[" in lists[0] else "2.000;2.000;0.250"  # since mjlab 1.6
    terms = "base_ang_vel,projected_gravity,joint_pos,joint_vel,actions,command"
    metadata = as_mjlab(JOINT_NAMES, np.linspace(-0.5, 0.6, 12), terms) | {
        "observation_terms_scale": f"0.250,1.000,1.000,0.050,1.000,{scale}",
        "observation_terms_clip": ",".join([lists[0]] * 5 + [lists[1]]),
        "observation_terms_history_length": "0.000,3.000,0.000,0.000,0.000,0.000",
    }
    path = linear(np.eye(12, 51), tmp_path / "walk.onnx", metadata)
    path.with_suffix(".yaml").write_text("control_step_s: 0.02\n")
    policy = ForeignPolicy.of(OnnxNetwork(path))
    assert policy.joints == JOINT_NAMES and policy.scale.tolist() == [0.5] * 12
    np.testing.assert_allclose(policy.pose, np.linspace(-0.5, 0.6, 12), atol=5e-4)
    names = [t.term for t in policy.terms]
    assert names == [
        "base_ang_vel", "projected_gravity", "joint_pos_rel", "joint_vel", "last_action", "command",
    ]  # fmt: skip
    assert policy.terms[1].history == 3 and policy.terms[5].scale == [2.0, 2.0, 0.25]
    assert policy.terms[5].clip == [-1.0, 1.0] and policy.terms[0].clip is None
    assert any("joint_pos" in note for note in policy.notes)


def test_a_network_for_one_robot_only_walks_robots_one_by_one(tmp_path):
    weights = np.arange(6, dtype=np.float32).reshape(2, 3)
    nodes = [
        ("Reshape", ["obs", "shape"], ["flat"]), ("MatMul", ["w", "flat"], ["y"]),
        ("Reshape", ["y", "back"], ["actions"]),
    ]  # fmt: skip
    network = OnnxNetwork(
        exported_by(tmp_path / "one.onnx", nodes, (3, 2), w=weights, shape=np.array([3]),
                    back=np.array([1, 2]))
    )  # fmt: skip
    given = np.eye(3, dtype=np.float32)
    np.testing.assert_allclose(network.run([given])[0], given @ weights.T)


def test_what_is_missing_or_does_not_fit_is_named_with_the_line_that_the_yaml_needs(tmp_path):
    base = "control_step_s: 0.02\nobservation: [command]\n"
    pose = f"joints: [{', '.join(JOINT_NAMES[:2])}]\ndefault_pose_rad: [0, 0.7]\n"
    good = pose + "action_scale_rad: 0.5\n" + base

    def use(source: str | dict[str, str] | tuple[str, str]) -> None:
        metadata = source if isinstance(source, dict) else None
        path = linear(np.eye(2, 2 if metadata is not None else 3), tmp_path / "walk.onnx", metadata)
        if isinstance(source, tuple):
            assert source[0] in good
            path.with_suffix(".yaml").write_text(good.replace(*source))
        policy = ForeignPolicy.of(OnnxNetwork(path))
        policy.fit(policy.task(None))

    named = as_mjlab(JOINT_NAMES[:2], [0.0, 0.0])
    assert_each_refused(
        [
            ({}, "joint_names"), ({}, "joints: ["), ({}, "action_scale_rad"),
            (named, "control_step_s: 0.02"), (named, "observation_names"), (named, "walk.yaml"),
            (("command", "height_scan"), "height_scan"),
            (("[command]", "[command, phase]"), "frequency_hz"),
            (("[command]", "[joint_pos, command]"), "joint_pos_rel 2"),
            (("LF_hip, ", ""), "gives 2 actions"), (("LF_hip", "knee"), "knee"),
            (("[0, 0.7]", "[0, 0, 0]"), "3 numbers for 2 joints"),
            (("[0, 0.7]", "[0, 40]"), "radians"), (("[0, 0.7]", "[0, 3.1]"), "limits"),
            (("[0, 0.7]", "{LF_hip: 0}"), "missing"), (("rad: 0.5", "rad: 0.5\ndt: 1"), "dt"),
            (("rad: 0.5", "rad: .nan"), "action_scale_rad"),
        ],
        use,
    )  # fmt: skip


def _looping(tmp_path) -> Path:
    helper, kinds = onnx.helper, onnx.TensorProto
    go, again = (helper.make_tensor_value_info(n, kinds.BOOL, []) for n in ("go", "again"))
    count = helper.make_tensor_value_info("i", kinds.INT64, [])
    same = helper.make_node("Identity", ["go"], ["again"])
    body = helper.make_graph([same], "body", [count, go], [again])
    nodes = [("Loop", ["", "yes"], [], {"body": body}), ("Identity", ["obs"], ["actions"])]
    return exported_by(tmp_path / "loop.onnx", nodes, (2, 2), yes=np.array(True))


def _huge(tmp_path) -> Path:
    """An outer product of 10¹⁰ numbers from a file of 800 kB."""
    nodes = [
        ("MatMul", ["a", "b"], ["ab"]), ("ReduceMean", ["ab"], ["mean"], {"keepdims": 1}),
        ("Add", ["obs", "mean"], ["actions"]),
    ]  # fmt: skip
    ones = np.ones(100_000, np.float32)
    return exported_by(tmp_path / "huge.onnx", nodes, (2, 2), a=ones[:, None], b=ones[None])


def _not_onnx(tmp_path) -> Path:
    path = tmp_path / "text.onnx"
    path.write_text("hello")
    return path


def _outside(tmp_path) -> Path:
    path = linear(np.eye(2), tmp_path / "outside.onnx")
    model = onnx.load(str(path))
    onnx.save(
        model, str(path), save_as_external_data=True, location="weights.bin", size_threshold=0
    )
    return path


def test_hostile_files_are_refused_before_they_are_run(tmp_path):
    long = {"joint_names": "x," * 200_000}
    assert_each_refused(
        [
            (_looping, "operator Loop"), (_huge, "1.0e+10 numbers"), (_outside, "another file"),
            (_not_onnx, "no ONNX file"),
            (lambda t: linear(np.eye(2), t / "long.onnx", long), "too long"),
            (lambda t: linear(np.full((2, 2), np.nan), t / "nan.onnx"), "not numbers"),
            (lambda t: linear(np.zeros((2, 2)), t / "zero.onnx"), "constant"),
        ],
        lambda make: OnnxNetwork(make(tmp_path)),
        names=".onnx",
    )  # fmt: skip


# ------------------------------------------------------------------------- another robot


def _stirring_duck(tmp_path) -> Path:
    """A policy that stands and turns the head of the Open Duck Mini by a clock."""
    legs = ("hip_yaw", "hip_roll", "hip_pitch", "knee", "ankle")
    heads = ("neck_pitch", "head_pitch", "head_yaw", "head_roll")
    names = [f"left_{j}" for j in legs] + list(heads) + [f"right_{j}" for j in legs]
    pose = [0, 0, -0.63, 1.37, -0.78, *[0] * 4, 0, 0, 0.63, 1.38, -0.8]
    weights = np.zeros((14, 2))
    weights[names.index("head_yaw"), 0] = 1.0
    path = linear(weights, tmp_path / "duck.onnx", as_mjlab(names, pose))
    path.with_suffix(".yaml").write_text(
        "control_step_s: 0.02\nobservation: [{term: phase, frequency_hz: 1.5}]\n"
    )
    return path


@pytest.mark.slow
def test_a_biped_of_another_trainer_needs_the_speed_of_its_clock(tmp_path):
    if not DUCK.is_file():
        pytest.skip(f"{DUCK} is not there")
    policy = ForeignPolicy.of(OnnxNetwork(_stirring_duck(tmp_path)))
    task = policy.task(DUCK)
    policy.fit(task)
    servos = servos_of_training(policy, task, DUCK)
    # those of the file's own position actuators
    assert servos.value["stiffness"] == pytest.approx(13.37)
    assert servos.value["effort_limit"] == pytest.approx(3.23)
    trial = Trial(task, servos, (0.0, 0.0, 0.0), robots=2, seconds=4.0, threads=1)
    candidate = servo_ranges("sts3215-bam-m1", body=task.body)
    demand = servo_demand(policy, trial, candidate, extra_dead_times_s=(0.0,))
    assert set(demand.joints) == set(policy.joints) and demand.survival == 1.0
    # the set-point is 0.5 sin(2π·1.5 t); a servo of 13.4 N·m/rad with 0.56 N·m·s/rad and the head's
    # inertia (0.03 kg·m²) follows it with |k / (k - J w² + i d w)|
    w, k, d, inertia = 2 * np.pi * 1.5, 13.37, 0.56, 0.027 + 0.003
    follows = abs(k / (k - inertia * w**2 + 1j * d * w))
    speed = demand.joints["head_yaw"].speed_rad_s.peak
    assert speed == pytest.approx(0.5 * w * follows, rel=0.35)
    assert max(j.speed_rad_s.p99 for n, j in demand.joints.items() if "knee" in n) < 0.2


def test_joints_that_the_model_lacks_and_servos_that_no_file_states_are_named(tmp_path):
    if not DUCK.is_file():
        pytest.skip(f"{DUCK} is not there")
    policy = ForeignPolicy.of(OnnxNetwork(_stirring_duck(tmp_path)))
    assert_each_refused(
        [(None, "left_ankle"), (DUCK.with_name("unitree_go1.xml"), "left_hip_yaw")],
        policy.task,
        names="duck.onnx",
    )
    own = rows_of(tmp_path, 3, "observation: [command]")
    assert_each_refused(
        [(None, "`actuator`")], lambda robot: servos_of_training(own, own.task(None), robot)
    )
