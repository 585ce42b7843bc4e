"""Recordings of servos with one fault each, or none, from a simulation of its own.

Shares no code with the product: a second-order position servo with dead time, Coulomb friction, a
speed limit and gravity, its encoder, its bus and its log, drawn from a wide world (`draw_world`).
`FAULTS` maps what is wrong to a function that spoils the recording, or the world before it is
simulated, and to the codes of findings that name it rightly.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd
from numba import njit
from numpy.typing import NDArray

STEP_S = 5e-4
MOTIONS = (
    "sine", "tones", "chirp", "steps", "prbs", "teleoperation", "walk", "multisine", "triangle",
)  # fmt: skip
SERVOS = {"hobby": (4, 12), "smart": (8, 20), "slow": (1, 4), "weak": (3, 8)}
"""Classes by their natural frequency [Hz]; a weak one follows a part of its command."""


@dataclass(frozen=True)
class World:
    """A servo, its bus and its command."""

    motion: str
    rate_hz: float
    duration_s: float
    amplitude_rad: float
    offset_rad: float
    gain: float
    bandwidth_hz: float
    damping: float
    dead_time_s: float
    friction_rad: float
    speed_rad_s: float
    gravity_rad: float
    quantum_rad: float
    noise_rad: float
    jitter: float
    poll_s: float
    loss: float
    seed: int
    clamp_rad: tuple[float, float] = (-np.inf, np.inf)
    stop_rad: tuple[float, float] = (-np.inf, np.inf)
    writer_share: float = 0.0
    values: dict = field(default_factory=dict)


def draw_world(rng: np.random.Generator, servo: str, motion: str, noise_rad: float) -> World:
    """A healthy recording of a class of servos and a kind of motion."""

    def between(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    bandwidth, amplitude = between(*SERVOS[servo]), between(0.05, 1.0)
    rate = between(25, 1000) if motion != "prbs" else between(40, 1000)
    polled, loaded = rng.random(2) < (0.4, 0.4)
    gain = float(rng.uniform(0.5, 0.9) if servo == "weak" else rng.uniform(0.8, 1.1))
    return World(
        motion=motion, rate_hz=rate, duration_s=float(rng.uniform(8, 16)), amplitude_rad=amplitude,
        offset_rad=float(rng.choice([0.0, rng.uniform(-0.7, 0.7)])), gain=gain,
        bandwidth_hz=bandwidth, damping=float(rng.uniform(0.5, 1.3)),
        dead_time_s=between(0.002, 0.08),
        friction_rad=float(amplitude * rng.choice([0.0, rng.uniform(0.0, 0.1)])),
        speed_rad_s=between(4, 20),
        gravity_rad=float(rng.uniform(0.02, 0.15) * amplitude) if loaded else 0.0,
        quantum_rad=between(0.0001, 0.006), noise_rad=noise_rad,
        jitter=float(rng.choice([0.0, 0.03])),
        poll_s=between(0.002, 0.06) if polled else 0.0,
        loss=float(rng.uniform(0, 0.6)) if polled else 0.0, seed=int(rng.integers(1 << 30)),
    )  # fmt: skip


def commanded(world: World, time: NDArray[np.float64], rng: np.random.Generator) -> NDArray:
    """Command about zero at each time [rad]."""
    t, end = np.maximum(time - 0.4, 0.0), world.duration_s
    top = min(1.2 * world.bandwidth_hz, world.rate_hz / 6, 8.0)
    if world.motion == "sine":
        wave = np.sin(2 * np.pi * rng.uniform(0.5, top) * t)
    elif world.motion == "tones":
        hz = np.geomspace(rng.uniform(0.5, 1.0), top, 4)
        each = (end - 0.4) / 4
        place = np.minimum((t / each).astype(int), 3)
        since = t - place * each
        wave = np.sin(2 * np.pi * hz[place] * since) * (since < each - 0.3)
        wave *= np.minimum(1.0, 2.0 / hz[place] ** 0.5)
    elif world.motion == "chirp":
        wave = np.sin(2 * np.pi * (0.2 * t + (top - 0.2) / (2 * end) * t**2))
    elif world.motion == "steps":
        hold = rng.uniform(0.4, 1.0)
        wave = rng.uniform(-1, 1, 99)[(t / hold).astype(int)] * (time > 0.4)
    elif world.motion == "prbs":
        hold = rng.uniform(0.12, 0.35)
        wave = rng.choice([-1.0, 1.0], 200)[(t / hold).astype(int)] * (time > 0.4)
    elif world.motion == "multisine":
        hz = np.geomspace(0.3, top, 8)
        phase = rng.uniform(0, 2 * np.pi, 8)
        wave = np.sin(2 * np.pi * np.outer(t, hz) + phase).sum(axis=1)
        wave = (wave - wave[0]) / np.abs(wave - wave[0]).max() * np.minimum(t / 0.3, 1.0)
    elif world.motion == "triangle":
        wave = 2 * np.abs((2 * rng.uniform(0.1, 0.8) * t + 0.5) % 2 - 1) - 1
        wave = wave - wave[0]
    elif world.motion == "walk":
        hz, phase = rng.uniform(0.8, 2.5), rng.uniform(0, 6)
        angle = 2 * np.pi * hz * t + phase
        wave = 0.6 * np.sin(angle) + 0.3 * np.sin(2 * angle + 1) + 0.15 * np.sin(3 * angle)
        wave = wave + 0.1 * np.interp(t, np.arange(0, 40, 0.3), rng.standard_normal(134))
        wave *= np.minimum(t / 0.5, 1.0)
    else:
        hz, phase = rng.uniform(0.1, 1.6, 6), rng.uniform(0, 6, 6)
        wave = np.sin(2 * np.pi * np.outer(t, hz) + phase).sum(axis=1) / 3
        wave = (wave - wave[0]) * np.minimum(t, 1.0)
    return world.amplitude_rad * wave


@njit(cache=True)
def _moved(goal, natural, damping, friction, speed, low, high, torque):
    """Position at each step of a servo whose error is `goal` minus position.

    `torque`: of what it would be, at each step; at 0 the joint is held.
    """
    position, velocity = goal[0], 0.0
    out = np.empty(len(goal))
    step = 5e-4
    for k in range(len(goal)):
        if torque[k] == 0.0:
            velocity, out[k] = 0.0, position
            continue
        strength = natural * natural * torque[k]
        force = strength * (goal[k] - position) - 2 * damping * natural * velocity
        hold = natural * natural * friction
        if velocity == 0.0 and abs(force) <= hold:
            out[k] = position
            continue
        sign = np.sign(velocity) if velocity != 0.0 else np.sign(force)
        velocity_new = velocity + step * (force - sign * hold)
        if velocity != 0.0 and velocity_new * velocity < 0:
            velocity_new = 0.0
        velocity = min(max(velocity_new, -speed), speed)
        position += step * velocity
        if position < low:
            position, velocity = low, 0.0
        elif position > high:
            position, velocity = high, 0.0
        out[k] = position
    return out


def simulated(world: World) -> pd.DataFrame:
    """Rows of the recording of `world`: send and read times, command and position."""
    rng = np.random.default_rng(world.seed)
    gaps = 1 + world.jitter * rng.standard_normal(int(world.duration_s * world.rate_hz) + 1)
    send = np.cumsum(np.maximum(gaps, 0.3)) / world.rate_hz
    command = commanded(world, send, rng)
    clock = np.arange(0.0, world.duration_s + 0.2, STEP_S)
    row = np.searchsorted(send, clock - world.dead_time_s, "right") - 1
    goal = np.where(row < 0, command[0], command[np.maximum(row, 0)])
    goal = np.clip(goal, *world.clamp_rad)
    gravity = world.gravity_rad * np.sin(goal / max(world.amplitude_rad, 1e-6))
    goal = world.gain * goal + gravity
    natural = 2 * np.pi * world.bandwidth_hz
    if world.writer_share > 0 or "times_s" in world.values:
        position = _with_writer(world, clock, send, goal, row, natural, rng)
    else:
        position = _moved(
            goal, natural, world.damping, world.friction_rad, world.speed_rad_s,
            *world.stop_rad, np.interp(clock, *world.values.get("torque", ([0.0], [1.0]))),
        )  # fmt: skip
    read = send + min(0.002, 0.3 / world.rate_hz)
    measured = read
    if world.poll_s > 0:
        polls = np.arange(-0.5, world.duration_s + 0.1, world.poll_s)
        polls = polls[(rng.random(len(polls)) >= world.loss) | (polls < 0)]
        measured = polls[np.searchsorted(polls, read, "right") - 1]
    value = np.interp(measured, clock, position)
    noise = world.noise_rad * rng.standard_normal(len(value))
    if world.poll_s > 0:  # a held value keeps its noise
        first = np.concatenate([[True], np.diff(measured) > 0])
        noise = noise[np.maximum.accumulate(np.where(first, np.arange(len(noise)), 0))]
    value = value + noise + world.offset_rad
    value = world.quantum_rad * np.round(value / world.quantum_rad)
    return pd.DataFrame({
        "send_time_s": send, "read_time_s": read, "command_rad": command + world.offset_rad,
        "position_rad": value,
    })  # fmt: skip


def _with_writer(world: World, clock, send, goal, row, natural, rng) -> NDArray:
    """Another program's goal stands from its writes until the next command."""
    home = world.values["home"]
    if "times_s" in world.values:
        times = np.concatenate([[-1.0], world.values["times_s"]])
        last = times[np.searchsorted(times, clock - world.dead_time_s, "right") - 1]
        taken = (last > send[np.maximum(row, 0)]) & (row >= 0)
    else:  # some commands are replaced
        hit = rng.random(int(row.max()) + 2) < world.writer_share
        taken = hit[np.maximum(row, 0)]
    return _moved(
        np.where(taken, home, goal), natural, world.damping, world.friction_rad, world.speed_rad_s,
        *world.stop_rad, np.ones(len(goal)),
    )  # fmt: skip


# ----- faults: what is changed before or after the simulation, and codes that name it
Spoil = Callable[[World, np.random.Generator], tuple[World, pd.DataFrame]]


def healthy(world: World, rng: np.random.Generator):
    return world, simulated(world)


def _rows(change: Callable[[pd.DataFrame, World, np.random.Generator], pd.DataFrame]) -> Spoil:
    def spoil(world: World, rng: np.random.Generator):
        return world, change(simulated(world), world, rng)

    return spoil


def _inverted(t, world, rng):
    return t.assign(position_rad=2 * world.offset_rad - t.position_rad)


def _scaled(t, world, rng):
    factor = rng.choice([57.29578, 1 / 57.29578, 3.2, 5.0, 0.03])
    about = world.offset_rad
    return t.assign(position_rad=about + (t.position_rad - about) * factor)


def _early(t, world, rng):
    lag = world.dead_time_s + 0.25 / world.bandwidth_hz + 2 * world.poll_s
    rows = int(np.ceil((lag + rng.uniform(0.04, 0.15)) * world.rate_hz))
    return t.assign(position_rad=t.position_rad.shift(-rows).ffill())


def _swapped(t, world, rng):
    return t.rename(columns={"command_rad": "position_rad", "position_rad": "command_rad"})


def _sign_bit(t, world, rng):
    step = world.quantum_rad if world.quantum_rad > 1e-3 else 0.00153
    count = np.round((t.position_rad - world.offset_rad) / step)
    kept = np.where(count < 0, 2**15 - count, count)
    return t.assign(position_rad=step * kept, command_rad=t.command_rad - world.offset_rad)


def _overflow(t, world, rng):
    step = world.quantum_rad if world.quantum_rad > 1e-3 else 0.00153
    bits = int(rng.choice([12, 14, 16]))
    count = np.round((t.position_rad - world.offset_rad) / step)
    return t.assign(position_rad=step * (count % 2**bits), command_rad=t.command_rad
                    - world.offset_rad)  # fmt: skip


def _wrapped(t, world, rng):
    shift = np.pi - world.offset_rad + rng.uniform(-0.3, 0.3) * world.amplitude_rad
    turned = (t.position_rad + shift + np.pi) % (2 * np.pi) - np.pi
    return t.assign(position_rad=turned, command_rad=t.command_rad + shift)


def _not_two_levels(world: World, rng) -> World:
    """A random binary command that is clamped is another binary command: nothing shows it."""
    return replace(world, motion="walk") if world.motion == "prbs" else world


def _clamped(world: World, rng):
    world = _not_two_levels(world, rng)
    reach = world.amplitude_rad * rng.uniform(0.35, 0.6)
    world = replace(world, clamp_rad=(-reach, reach))
    return world, simulated(world)


def _stopped(world: World, rng):
    world = _not_two_levels(world, rng)
    high = world.gain * world.amplitude_rad * rng.uniform(0.2, 0.5)
    world = replace(world, stop_rad=(-np.inf, high))
    return world, simulated(world)


def _second_writer(world: World, rng):
    world = replace(
        world, writer_share=float(rng.uniform(0.04, 0.12)),
        values={"home": float(rng.choice([-1, 1]) * rng.uniform(0.0, 1.0) * world.amplitude_rad)},
    )  # fmt: skip
    return world, simulated(world)


def _other_goal(world: World, rng) -> float:
    return float(rng.choice([-1, 1]) * rng.uniform(0.0, 1.0) * world.amplitude_rad)


def _now_and_then(world: World, rng):
    """Another program writes its goal every 0.5 to 3 s, overwritten by the next command."""
    times = 0.5 + np.cumsum(rng.uniform(0.5, 3.0, 40))
    world = replace(world, values={"home": _other_goal(world, rng), "times_s": times})
    return world, simulated(world)


def _at_its_rate(world: World, rng):
    """Another program writes its goal all the time, at a rate of its own."""
    hz = np.exp(rng.uniform(np.log(2.0), np.log(min(20.0, 0.5 * world.rate_hz))))
    times = rng.uniform(0.1, 0.6) + np.arange(0.0, world.duration_s, 1 / hz)
    times = times + 0.03 / hz * rng.standard_normal(len(times))
    world = replace(world, values={"home": _other_goal(world, rng), "times_s": np.sort(times)})
    return world, simulated(world)


def _derated(world: World, rng):
    at, factor = world.duration_s * rng.uniform(0.35, 0.65), rng.uniform(0.3, 0.6)
    table = simulated(world)
    late = table.read_time_s > at
    about = world.offset_rad
    return replace(world, values={"at": at}), table.assign(
        position_rad=np.where(late, about + factor * (table.position_rad - about),
                              table.position_rad))  # fmt: skip


def _torque_fades(world: World, rng):
    """A motor that heats or a battery that sinks: torque falls smoothly, friction does not."""
    torque = [0.0, world.duration_s], [1.0, 1 - rng.uniform(0.2, 0.5)]
    world = replace(world, values={"torque": torque})
    return world, simulated(world)


def _held_at_times(world: World, rng):
    """Something holds the joint for a while, several times."""
    times = int(rng.integers(2, 5))
    begins = np.linspace(1.5, world.duration_s - 1.5, times) + rng.uniform(-0.4, 0.4, times)
    ends = begins + rng.uniform(0.7, 1.2, times)
    clock = np.column_stack([begins - 1e-4, begins, ends, ends + 1e-4]).ravel()
    torque = np.tile([1.0, 0.0, 0.0, 1.0], times)
    world = replace(world, values={"torque": (clock, torque)})
    return world, simulated(world)


def _unplugged_at_times(t, world, rng):
    """Readings stay for a while, several times, while the joint goes on."""
    begins = np.cumsum(rng.uniform(1.8, 3.5, 3))
    time = t.read_time_s.to_numpy()
    row = np.arange(len(t))
    for begin in begins:
        out = (time > begin) & (time < begin + rng.uniform(0.7, 1.2))
        row = np.where(out, max(int(np.argmax(out)) - 1, 0) if out.any() else 0, row)
    return t.assign(position_rad=t.position_rad.to_numpy()[row])


def _zeros(t, world, rng):
    bad = rng.random(len(t)) < max(0.005, 4 / len(t))
    bad &= ~np.roll(bad, 1)
    value = rng.choice([0.0, -np.pi, t.position_rad.max() + 0.5])
    if abs(value - world.offset_rad) < 1.2 * world.amplitude_rad:
        value = world.offset_rad + 2.5 * world.amplitude_rad
    return t.assign(position_rad=np.where(bad, value, t.position_rad))


def _unrelated(t, world, rng):
    other = replace(world, seed=world.seed + 1, motion="teleoperation")
    value = simulated(other).position_rad.to_numpy()
    return t.assign(position_rad=np.resize(value, len(t)))


def _force(t, world, rng):
    """A leg that walks under a policy: the target is far from where the joint is pressed to."""
    time = t.send_time_s.to_numpy()
    hz = rng.uniform(0.4, 0.9)
    swing = world.amplitude_rad * (0.5 - 0.5 * np.cos(2 * np.pi * hz * time)) * 0.35
    pushed = 0.08 * world.amplitude_rad * np.sin(2 * np.pi * 2.1 * hz * time)
    target = swing - world.amplitude_rad * 1.5 * np.maximum(
        np.sin(2 * np.pi * hz * time + rng.uniform(-0.6, 0.6)), 0) ** 3  # fmt: skip
    target += 0.3 * world.amplitude_rad * np.interp(
        time, np.arange(0, 40, 0.08), rng.standard_normal(500))  # fmt: skip
    value = swing + pushed + world.offset_rad
    value = world.quantum_rad * np.round(value / world.quantum_rad)
    return t.assign(command_rad=target + world.offset_rad, position_rad=value)


def _held(world: World, rng):
    """Strokes hardly larger than the friction: the joint rests most of the time."""
    world = replace(
        world, motion="sine", friction_rad=0.6 * world.amplitude_rad, noise_rad=0.0,
        poll_s=0.0, loss=0.0,
    )  # fmt: skip
    return world, simulated(world)


def _part(t, low: float, high: float, rng) -> float:
    """A time within a part of the recording [s]."""
    time = t.read_time_s.to_numpy()
    return float(time[0] + np.ptp(time) * rng.uniform(low, high))


def _zero_jumps(t, world, rng):
    step = rng.choice([-1, 1]) * rng.uniform(0.3, 0.6) * world.amplitude_rad
    late = t.read_time_s > _part(t, 0.35, 0.65, rng)
    return t.assign(position_rad=t.position_rad + step * late)


def _heats(t, world, rng):
    time = t.read_time_s.to_numpy()
    gain = 1 - rng.uniform(0.35, 0.6) * (time - time[0]) / np.ptp(time)
    about = world.offset_rad
    return t.assign(position_rad=about + gain * (t.position_rad - about))


def _loses_power(t, world, rng):
    begin = _part(t, 0.3, 0.5, rng)
    out = ((t.read_time_s > begin) & (t.read_time_s < begin + 2.5)).to_numpy()
    first = max(int(np.argmax(out)) - 1, 0)
    return t.assign(position_rad=np.where(out, t.position_rad.iloc[first], t.position_rad))


def _speed(t, world, rng):
    time = t.read_time_s.to_numpy()
    return t.assign(position_rad=np.gradient(t.position_rad.to_numpy(), time))


def _rates(t, world, rng):
    """Commands of a drive that takes speeds or duty cycles, which it follows."""
    goal, time = t.command_rad.to_numpy(), t.send_time_s.to_numpy()
    return t.assign(command_rad=rng.uniform(0.2, 1.0) * np.gradient(goal, time))


def _changes(t, world, rng):
    """A policy's commands of this row less that of the row before."""
    return t.assign(command_rad=np.diff(t.command_rad.to_numpy(), prepend=t.command_rad.iloc[0]))


FAULTS: dict[str, tuple[Spoil, tuple[str, ...]]] = {
    "healthy": (healthy, ()),
    "sign": (_rows(_inverted), ("sign_inverted",)),
    "scale": (_rows(_scaled), ("wrong_unit", "scale_too_large", "hardly_moves", "scale_asks_care",
                               "degrees_by_step", "few_steps", "does_not_move", "degrees")),
    "shift": (_rows(_early), ("position_early", "columns_swapped", "at_once")),
    "swapped": (_rows(_swapped), ("columns_swapped", "position_early")),
    "sign bit": (_rows(_sign_bit), ("sign_bit",)),
    "overflow": (_rows(_overflow), ("encoder_overflow", "sign_bit", "angle_wrapped")),
    "wrap": (_rows(_wrapped), ("angle_wrapped",)),
    "clamp": (_clamped, ("clipped",)),
    "stop": (_stopped, ("clipped",)),
    "second writer": (_second_writer, ("second_writer",)),
    "gain change": (_derated, ("gain_changed",)),
    "bad reads": (_rows(_zeros), ("bad_readings",)),
    "unrelated": (_rows(_unrelated), ("unrelated", "loosely_related", "not_a_position_servo")),
    "force": (_rows(_force), ("not_a_position_servo", "unrelated", "loosely_related")),
    "friction": (_held, ("held_by_friction",)),
    "zero jumps": (_rows(_zero_jumps), ("zero_moves",)),
    "heats": (_rows(_heats), ("gain_drifts", "gain_changed")),
    "loses power": (_rows(_loses_power), ("frozen",)),
    "speed": (_rows(_speed), ("speed_for_position", "fast_joint", "degrees", "unrelated",
                              "not_a_position_servo")),
    "writer now and then": (_now_and_then, ("second_writer",)),
    "writer at its rate": (_at_its_rate, ("second_writer",)),
    "torque fades": (_torque_fades, ("torque_fades", "torque_changed", "gain_drifts")),
    "held at times": (_held_at_times, ("frozen", "left_path")),
    "unplugged at times": (_rows(_unplugged_at_times), ("frozen", "left_path")),
    # of one tone they are another scale
    "commands of speed": (_rows(_rates), ("speed_for_command", "hardly_moves", "scale_asks_care",
                                          "scale_too_large")),
    "changes of the goal": (_rows(_changes), ("speed_for_command", "scale_asks_care",
                                              "scale_too_large")),
}  # fmt: skip

ACCUSING = sorted({code for _, codes in FAULTS.values() for code in codes})
"""Codes that name a fault of the pair of columns: none may stand on a healthy recording."""

NOISES_RAD = (0.0, 3e-4, 2e-3)


def draw_recording(fault: str, number: int, seed: int) -> tuple[World, pd.DataFrame]:
    """A recording of a fault: servo, motion and noise in turn, the rest by chance."""
    rng = np.random.default_rng((seed, number, list(FAULTS).index(fault)))
    world = draw_world(
        rng, list(SERVOS)[number % len(SERVOS)], MOTIONS[number % len(MOTIONS)],
        NOISES_RAD[number % len(NOISES_RAD)],
    )  # fmt: skip
    return FAULTS[fault][0](world, rng)
