"""The IMU: the trunk's axes and units from the chip's, and a reading that can be missing."""

import struct
from pathlib import Path

import numpy as np

from pupper_sysid.common.joints import JOINT_NAMES
from pupper_sysid.hardware import esp32
from pupper_sysid.hardware.esp32 import Esp32Bus
from pupper_sysid.hardware.imu import ImuSample, as_words, from_chip, to_chip
from pupper_sysid.servo_models.delayed_pd import DelayedPDParameters
from pupper_sysid.sim.emulator.esp32 import ImuProxy
from pupper_sysid.sim.robot.engine import mujoco
from pupper_sysid.sim.robot.mini_pupper import default_pose, robot_xml
from support.servo_servers import ScriptedProxy, StillBench, on_a_socket

G = 9.80665


# ---- axes and units ----


def test_a_chip_on_the_simulated_trunk_tells_tilt_and_turn_with_the_right_signs():
    servo = DelayedPDParameters(0.0, 0.0, 0.0, 1e-3, 1.0, 1.0, 0.0)
    xml = robot_xml(dict.fromkeys(JOINT_NAMES, servo), 0.002)
    # held up in the air, at rest but for its turning
    model = mujoco.MjModel.from_xml_string(xml.replace("<body ", '<body gravcomp="1" '))
    for axis, up in (
        ((0, 1, 0), (-np.sin(0.5), 0, np.cos(0.5))),  # nose down: forward points down
        ((-1, 0, 0), (0, -np.sin(0.5), np.cos(0.5))),  # rolled to the left: left points down
        ((0, 0, 1), (0, 0, 1)),  # turned to the left: still level
    ):
        data = mujoco.MjData(model)
        mujoco.mju_axisAngle2Quat(data.qpos[3:7], np.array(axis, float), 0.5)
        data.qpos[2], data.qpos[7:] = 1.0, default_pose()
        data.qvel[3:6] = 0.3 * np.array(axis)
        mujoco.mj_forward(model, data)
        read = [data.sensor(name).data for name in ("accelerometer", "gyro")]
        sample = from_chip(0.0, np.concatenate([read[0] / G, np.degrees(read[1])]))
        assert sample is not None
        # the site turns with the trunk about its own origin: no acceleration but g's reaction
        np.testing.assert_allclose(sample.acceleration_m_s2 / 9.81, up, atol=0.02)
        np.testing.assert_allclose(sample.rate_rad_s, 0.3 * np.array(axis), atol=1e-12)


def test_the_chips_numbers_come_back_in_words_of_a_16384th_g_and_their_ends_are_marked():
    raw = np.array([0.25, -0.5, -1.25, 30.0, -60.0, 7.5])
    sample = from_chip(0.0, raw)
    assert sample is not None
    np.testing.assert_allclose(to_chip(sample), raw, rtol=1e-15)
    words = as_words(np.array([0.4 / 16384, 0.6 / 16384, -1.0, 0.03, 0.04, -0.1]))
    np.testing.assert_array_equal(words, [0, 1 / 16384, -1, 0, 1 / 16, -2 / 16])
    for g in (1.99, -1.99, 2.3, -2.3):
        sample = from_chip(0.0, as_words(np.array([0.0, g, -1.0, 0.0, 0.0, 0.0])))
        assert sample is not None and sample.clipped is (abs(g) > 2)
        # 16 bits end at +32767/16384 g and -2 g
        assert abs(sample.acceleration_m_s2[0]) <= 2 * G


# ---- the proxy's datagram ----


def imu_reply(*values: float) -> bytes:
    return bytes([26, 4]) + struct.pack("<6f", *values)


def test_a_reply_that_no_chip_could_have_given_is_none():
    for wrong in (
        b"", imu_reply(*[0.0] * 6)[:-1], bytes([26, 3]) + bytes(24),
        imu_reply(float("nan"), 0, 0, 0, 0, 0), imu_reply(0, 0, float("inf"), 0, 0, 0),
        imu_reply(0, 2.1, 0, 0, 0, 0), imu_reply(0, 0, -1, 0, -2049, 0),
    ):  # fmt: skip
        assert esp32.parse_imu(wrong) is None, wrong


# ---- the bus ----


def read_imu(path: Path, *replies: bytes | None) -> ImuSample | None:
    """What the bus makes of successive answers."""
    # a client that leaves has its last request carried out once more
    answers = iter([*replies, None])
    with on_a_socket(ScriptedProxy(lambda request: next(answers)), path):
        bus = Esp32Bus(path)
        sample = bus.imu()
        bus.close()
    return sample


GOOD, OTHER, THIRD = (imu_reply(0, 0, -1, x, 0, 0) for x in (1.0, 2.0, 3.0))


def test_a_reading_counts_exactly_when_two_answers_agree(patient_proxy):
    for replies in ((GOOD, GOOD), (OTHER, GOOD, GOOD), (GOOD, OTHER, GOOD)):
        sample = read_imu(patient_proxy, *replies)
        assert sample is not None, replies
        np.testing.assert_allclose(sample.rate_rad_s, [0.0, np.radians(1.0), 0.0])
        np.testing.assert_allclose(sample.acceleration_m_s2, [0.0, 0.0, G])
        assert 0 <= sample.time_s < 5
    none, failed = (None,), (imu_reply(*[0.0] * 6),) * 2
    for replies in ((GOOD, OTHER, THIRD), failed, none, (GOOD, b"\x1a\x04\x00")):
        assert read_imu(patient_proxy, *replies) is None, replies


def test_a_proxy_for_the_imu_alone_does_not_move_the_servos_or_tell_of_them():
    still = StillBench("mini_pupper_2")
    proxy = ImuProxy(still, np.random.default_rng(0))
    setpoint = esp32.set_position(np.zeros(12, bool), np.full(12, 400))
    for request in (setpoint, esp32.request(esp32.GET_POSITION)):
        assert proxy.answer(request, b"before", 1.0) == b"before"
    assert still.goals == [] and still.torques == []
