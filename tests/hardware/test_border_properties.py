"""Joint maps, Feetech frames and the proxy's datagrams over arbitrary data."""

from itertools import pairwise

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from pupper_sysid.common.errors import InputError
from pupper_sysid.hardware import esp32
from pupper_sysid.hardware.address import BusAddress, parse_address
from pupper_sysid.hardware.feetech import SERIES, Frame, FrameReader, Series
from pupper_sysid.hardware.joint_map import JointMap, joint_map_from, load_joint_map

SOME = settings(max_examples=80, deadline=None)
FEW = settings(max_examples=25, deadline=None)
PRESET = load_joint_map("mini_pupper_2").file.model_dump(by_alias=True)

# ---- joint map ----


@st.composite
def joint_maps(draw) -> JointMap:
    """A valid map of another robot, with or without push rods."""
    data = PRESET | {"joints": {}}
    linkage = draw(st.sampled_from(["parallel knee", "none"]))
    for joint, entry in PRESET["joints"].items():
        low = draw(st.integers(0, 400))
        calf = linkage != "none" and joint.endswith("_calf")
        neutral = draw(st.floats(-2, 2))
        data["joints"][joint] = entry | {
            "sign": draw(st.sampled_from([1, -1])),
            "neutral_rad": neutral,
            "counts_per_rad": draw(st.floats(70, 400)),
            "offset_counts": draw(st.integers(-100, 100)),
            "limits_counts": (low, draw(st.integers(650, 1023))),
            # around the neutral, where the counts always have room
            "limits_rad": (-3.0, 0.0) if calf else (neutral - 0.1, neutral + 3.0),
        }
    chosen = joint_map_from(data | {"linkage": linkage}, "drawn")
    return draw(st.sampled_from([chosen, chosen.per_servo()]))


@FEW
@given(joint_map=joint_maps(), seed=st.integers(0, 2**32 - 1))
def test_any_map_is_read_back_inverts_its_counts_and_limits_hold_them(
    joint_map, seed, tmp_path_factory
):
    path = tmp_path_factory.mktemp("map") / "joints.yaml"
    joint_map.save(path)
    assert load_joint_map(path).file == joint_map.file
    rng = np.random.default_rng(seed)
    angles = rng.uniform(-4, 4, (5, 12))
    np.testing.assert_allclose(joint_map.to_angles(joint_map.to_counts(angles)), angles, atol=1e-9)
    limits = joint_map.position_limits()
    low, high = np.array([joint_map.file.joints[j].limits_counts for j in joint_map.joint_names]).T
    # where both bounds of a calf contradict each other, the box wins: then only packing clips
    free = np.array([not j.endswith("_calf") for j in joint_map.joint_names])
    for goal in angles:
        counts = joint_map.to_counts(limits.clip(goal))
        assert (counts >= low - 1e-6)[free].all() and (counts <= high + 1e-6)[free].all()
        packed = joint_map.clip_counts(counts)
        assert (packed >= low).all() and (packed <= high).all()


# ---- Feetech ----

frames = st.builds(Frame, st.integers(0, 253), st.integers(0, 255), st.binary(max_size=20))


@SOME
@given(data=st.binary(max_size=300), cuts=st.lists(st.integers(0, 300), max_size=6))
def test_a_reader_takes_any_bytes_and_finds_only_frames_that_are_in_them(data, cuts):
    reader, whole = FrameReader(), FrameReader()
    edges = [0, *sorted(min(c, len(data)) for c in cuts), len(data)]
    found = [f for a, b in pairwise(edges) for f in reader.feed(data[a:b])]
    assert found == whole.feed(data), "the pieces in which bytes arrive do not matter"
    assert reader.rejected_bytes == whole.rejected_bytes
    assert all(f.encode() in data for f in found)


# no 0xFF in between: a header in the noise may claim the beginning of a true frame
noise = st.binary(max_size=8).map(lambda raw: raw.replace(b"\xff", b"\x00"))


@SOME
@given(parts=st.lists(st.tuples(noise, frames), max_size=6), after=noise)
def test_every_valid_frame_between_noise_is_found(parts, after):
    data = b"".join(before + frame.encode() for before, frame in parts) + after
    reader = FrameReader()
    assert reader.feed(data) == [frame for _, frame in parts]
    between = sum(len(before) for before, _ in parts)
    assert between <= reader.rejected_bytes <= between + len(after)


@SOME
@given(junk=st.binary(max_size=40), frame=frames)
def test_a_valid_frame_is_found_behind_any_junk_if_only_its_shape_is_awaited(junk, frame):
    def awaited(frame_id: int, length: int) -> bool:
        return (frame_id, length) == (frame.id, len(frame.data) + 2)

    found = FrameReader(awaited).feed(junk + frame.encode())
    # junk that has the very shape may cover the beginning, with a wrong checksum for 255 of 256
    assert frame in found or any(
        awaited(*pair) for pair in zip(junk[2:], (junk + b"\xff\xff")[3:], strict=False)
    )


@SOME
@given(
    series=st.sampled_from(sorted(SERIES.values(), key=lambda s: s.name)),
    name=st.sampled_from(sorted(SERIES[777].registers)), value=st.integers(-70_000, 70_000),
)  # fmt: skip
def test_a_register_keeps_its_value_or_refuses_it(series: Series, name, value):
    if name not in series.registers:
        return
    register = series.registers[name]
    magnitude_bits = 8 * register.size if register.sign_bit is None else register.sign_bit
    fits = abs(value) < 1 << magnitude_bits and (value >= 0 or register.sign_bit is not None)
    try:
        raw = series.encode(name, value)
    except OverflowError:
        assert not fits
    else:
        assert fits and series.decode(name, bytes(register.address) + raw) == value


# ---- the proxy ----


@SOME
@given(
    reply=st.binary(max_size=40)
    | st.binary(min_size=24, max_size=24).map(lambda b: b"\x1a\x02" + b)
)
def test_any_reply_is_counts_within_the_encoder_or_none(reply):
    counts = esp32.parse_counts(reply)
    assert (counts is None) == (len(reply) != 26 or reply[:2] != b"\x1a\x02")
    if counts is not None:
        sent = np.frombuffer(reply[2:], "<u2")
        assert ((counts == esp32.NO_COUNT) | (counts == sent)).all()
        assert (counts <= esp32.HIGHEST_COUNT).all() and (counts != 0).all()


@SOME
@given(words=st.binary(min_size=24, max_size=24), opcode=st.sampled_from([3, 4, 5]))
def test_loads_imu_and_power_of_any_bytes_are_possible_or_missing(words, opcode):
    reply = bytes([26, opcode]) + words
    load, raw = esp32.parse_load(reply), esp32.parse_imu(reply)
    assert (load is None) == (opcode != esp32.GET_LOAD)
    assert load is None or (np.isnan(load) | (np.abs(load) <= 1.03)).all()
    assert raw is None or (np.isfinite(raw).all() and np.abs(raw).max() <= 2048)
    supply_v = esp32.parse_supply(bytes([10, esp32.GET_POWER]) + words[:8])
    assert supply_v is None or 0 <= supply_v <= 11


# ---- addresses ----


@SOME
@given(
    text=st.text(max_size=20) | st.builds("feetech:{}@{}".format, st.text(max_size=9), st.text())
)
def test_any_text_is_an_address_or_refused(text):
    try:
        address = parse_address(text)
    except InputError as refusal:
        assert text in str(refusal)
    else:
        assert isinstance(address, BusAddress) and address.kind in ("esp32", "feetech")
        assert address.where and (address.baud is None or address.baud >= 0)
