"""Independent simulator of hobby servos, and the servos, motions and recordings drawn from it.

It shares no code with the package or with MuJoCo, so that what it shows is not the fit's own
arithmetic. All torques are per total inertia. One servo is

    command -> dead time -> latch -> low-pass -> profile (speed and acceleration) -> set-point
    PID on the set-point minus the measured angle: sampled or continuous, dead zone, integral clamp
    -> clip at the effort (asymmetric) -> supply sag -> back-EMF -> friction with stick (Coulomb,
    Stribeck, cogging) -> motor | play or flexible link | link, gravity -> potentiometer -> reading

Steps are `STEP_S`; kick and drift alternate (symplectic Euler), friction is implicit, so that a
joint sticks where the other torques are below its friction.

`simulate` moves one servo, `draw_twin` draws servo, motion and bus by kind, `record` makes the
recording that a host would have. Twin `number` of a kind and motion is the same whatever else runs.
"""

import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

STEP_S = 1e-4
"""Length of a step [s]; `tests/sysid/fit/test_wide_servo.py` compares 0.2 and 0.05 ms."""
SETTLE_S = 1.5
"""Rest at the first command before the first row [s]."""
COUNT_RAD = 2 * np.pi / 4096
LEROBOT_ACCELERATION = 254
"""Register 41 of an STS3215 as LeRobot writes it; a unit is 100 counts/s²."""
NEVER = np.inf

Array = NDArray[np.float64]


class Servo(NamedTuple):
    """One servo; torques are per total inertia of motor and link."""

    dead_time_s: float = 0.01
    stiffness: float = 4000.0  # [1/s²]
    damping: float = 80.0  # inside of the effort limit [1/s]
    back_emf: float = 0.0  # outside of the effort limit: back-EMF and viscous friction [1/s]
    friction: float = 10.0  # Coulomb [rad/s²]
    effort: float = 1000.0  # [rad/s²]
    speed_limit: float = NEVER  # of the set-point [rad/s]
    acceleration_limit: float = NEVER  # of the set-point [rad/s²]
    low_pass_s: float = 0.0  # time constant of a first-order filter on the command
    dead_zone: float = 0.0  # half width, subtracted from the position error [rad]
    integral: float = 0.0  # [1/s³]
    integral_clamp: float = 0.0  # [rad/s²]
    loop_s: float = 0.0  # period of the position loop; 0 for a continuous one
    latch_s: float = 0.0  # period at which commands are taken over; 0 for at once
    asymmetry: float = 0.0  # share by which the effort is smaller downward
    sag: float = 0.0  # share of the torque lost to the supply at full effort
    stribeck: float = 0.0  # share by which static friction exceeds the Coulomb one
    stribeck_speed: float = 0.1  # [rad/s]
    cogging: float = 0.0  # [rad/s²]
    cogging_per_rad: float = 0.0
    gravity: float = 0.0  # torque -gravity sin(angle + gravity_phase) on the link [rad/s²]
    gravity_phase: float = 0.0
    motor_share: float = 1.0  # of the inertia; 1 for a rigid joint
    link_stiffness: float = 0.0  # of the contact or the link, per total inertia [1/s²]
    link_damping: float = 0.0  # [1/s]
    play: float = 0.0  # total [rad]
    link_friction_share: float = 0.0
    loop_on_motor: float = 1.0  # 1 where the loop measures the motor, 0 where the link
    read_on_motor: float = 1.0
    bend: float = 0.0  # largest deviation of the potentiometer's slope from 1
    bend_per_rad: float = 1.0
    bend_phase: float = 0.0
    dead_time_jitter_s: float = 0.0  # mean of an exponential addition per command
    dead_time_drift_s: float = 0.0  # added from first to last row

    def slope(self, angle: Array) -> Array:
        """Slope of the potentiometer."""
        return 1 + self.bend * np.cos(self.bend_per_rad * angle + self.bend_phase)

    def measured(self, angle: Array) -> Array:
        """Angle that the potentiometer shows."""
        wave = np.sin(self.bend_per_rad * angle + self.bend_phase) - np.sin(self.bend_phase)
        return angle + self.bend / self.bend_per_rad * wave


@njit(cache=True)
def _side(x: float) -> float:
    return 1.0 if x > 0 else (-1.0 if x < 0 else 0.0)


@njit(cache=True)
def _friction(servo, speed, dt, coulomb):
    """Speed after dry friction: it stops a joint that it can stop."""
    size = coulomb
    if servo.stribeck > 0:
        size *= 1 + servo.stribeck * np.exp(-((speed / servo.stribeck_speed) ** 2))
    kick = size * dt
    if abs(speed) <= kick:
        return 0.0
    return speed - _side(speed) * kick


@njit(cache=True)
def _run(servo, command, dt, angle, motor, link, set_points):
    """Step the servo through delayed commands, from rest at `angle`; fills the other arrays."""
    rigid = servo.motor_share >= 1.0
    m, n = servo.motor_share, 1.0 - servo.motor_share
    shift = np.sin(servo.bend_phase)
    q = x = angle
    v = w = 0.0  # speeds of motor and link
    wave = np.sin(servo.bend_per_rad * q + servo.bend_phase) - shift
    latched = filtered = set_point = q + servo.bend / servo.bend_per_rad * wave
    set_speed = integral = torque = 0.0
    next_latch = next_loop = 0.0
    for k in range(len(command)):
        now = k * dt
        if now >= next_latch - 1e-9:
            latched = command[k]
            next_latch += servo.latch_s if servo.latch_s > 0 else dt
        if servo.low_pass_s > 0:
            filtered += (latched - filtered) * (1 - np.exp(-dt / servo.low_pass_s))
        else:
            filtered = latched
        gap = filtered - set_point
        if servo.acceleration_limit < np.inf:
            a = servo.acceleration_limit
            wanted = 0.5 * a * dt * (np.sqrt(1 + 8 * abs(gap) / (a * dt * dt)) - 1)
            wanted = _side(gap) * min(wanted, servo.speed_limit)
            set_speed += min(max(wanted - set_speed, -a * dt), a * dt)
            set_point += set_speed * dt
            if abs(filtered - set_point) < a * dt * dt and abs(set_speed) <= a * dt:
                set_point, set_speed = filtered, 0.0
        elif servo.speed_limit < np.inf:
            set_point += min(max(gap, -servo.speed_limit * dt), servo.speed_limit * dt)
        else:
            set_point = filtered
        if now >= next_loop - 1e-9:
            period = servo.loop_s if servo.loop_s > 0 else dt
            next_loop += period
            s = q if servo.loop_on_motor > 0.5 else x
            u = v if servo.loop_on_motor > 0.5 else w
            seen, speed = s, u
            if servo.bend > 0:
                turn = servo.bend_per_rad * s + servo.bend_phase
                seen = s + servo.bend / servo.bend_per_rad * (np.sin(turn) - shift)
                speed = u * (1 + servo.bend * np.cos(turn))
            error = set_point - seen
            if servo.dead_zone > 0:
                error = _side(error) * max(abs(error) - servo.dead_zone, 0.0)
            if servo.integral > 0:
                integral += servo.integral * error * period
                integral = min(max(integral, -servo.integral_clamp), servo.integral_clamp)
            torque = servo.stiffness * error - servo.damping * speed + integral
            down = servo.effort * (1 - servo.asymmetry)
            torque = min(max(torque, -down), servo.effort)
            torque *= 1 - servo.sag * abs(torque) / servo.effort
        drive = torque
        if servo.cogging > 0:
            drive -= servo.cogging * np.sin(servo.cogging_per_rad * q)
        if rigid:
            drive -= servo.gravity * np.sin(q + servo.gravity_phase)
            v = (v + dt * drive) / (1 + dt * servo.back_emf)
            v = _friction(servo, v, dt / (1 + dt * servo.back_emf), servo.friction)
            q += dt * v
            x, w = q, v
        else:
            twist = q - x
            open_ = abs(twist) <= 0.5 * servo.play and servo.play > 0
            if open_:
                passed = 0.0
            else:
                bent = twist - _side(twist) * 0.5 * servo.play
                passed = servo.link_stiffness * bent + servo.link_damping * (v - w)
                if servo.play > 0 and passed * bent < 0:  # teeth push, they do not pull
                    passed = 0.0
            weight = servo.gravity * np.sin(x + servo.gravity_phase)
            v = (v + dt * (drive - passed) / m) / (1 + dt * servo.back_emf / m)
            w += dt * (passed - weight) / n
            share = servo.link_friction_share
            v = _friction(servo, v, dt / m, servo.friction * (1 - share))
            w = _friction(servo, w, dt / n, servo.friction * share)
            q += dt * v
            x += dt * w
        motor[k], link[k], set_points[k] = q, x, set_point


@dataclass(frozen=True)
class Path:
    """Motion of a servo on the simulator's steps.

    Attributes
    ----------
    time_s, angle, set_point : ndarray, shape (steps,)
        The angle is that of the part which is read, as its potentiometer shows it.
    delays_s : ndarray, shape (commands,)
        Dead time of each command.
    """

    time_s: Array
    angle: Array
    set_point: Array
    delays_s: Array
    slopes: tuple[float, float] = (1.0, 1.0)


def simulate(
    servo: Servo,
    sent_s: Array,
    commands: Array,
    stop_s: float,
    rng: np.random.Generator,
    step_s: float = STEP_S,
) -> Path:
    """Move a servo from rest by commands that are held between their times `sent_s`."""
    delays = servo.dead_time_s + servo.dead_time_drift_s * np.clip(sent_s / max(stop_s, 1e-9), 0, 1)
    if servo.dead_time_jitter_s > 0:
        delays = delays + rng.exponential(servo.dead_time_jitter_s, len(sent_s))
    arrivals = np.maximum.accumulate(sent_s + delays)
    first = sent_s[0] - SETTLE_S
    steps = int(np.ceil((stop_s - first) / step_s))
    time = first + step_s * np.arange(1, steps + 1)
    index = np.searchsorted(arrivals, time - 0.5 * step_s, side="right") - 1
    held = commands[np.maximum(index, 0)]
    angle = float(commands[0])
    for _ in range(50):  # where the potentiometer shows the first command
        at = np.array(angle)
        angle -= float((servo.measured(at) - commands[0]) / servo.slope(at))
    motor, link, set_point = np.empty((3, steps))
    floats = Servo(*map(float, servo))  # compiled once, whatever was given
    _run(floats, held, step_s, angle, motor, link, set_point)
    part = motor if servo.read_on_motor > 0.5 else link
    slopes = servo.slope(part)
    ends = (float(slopes.min()), float(slopes.max()))
    # kick and drift: angles are ahead by half a step
    return Path(time + 0.5 * step_s, servo.measured(part), set_point, arrivals - sent_s, ends)


# ------------------------------------------------------------------------------------------ motions


@dataclass(frozen=True)
class Stretch:
    """Commands of one trial: a function of the time since its start [s]."""

    duration_s: float
    command: Callable[[Array], Array]
    frequency_hz: float = float("nan")


RAMP_S, LEAD_IN_S = 0.5, 0.3


class Reach(NamedTuple):
    """Largest excursion, speed and acceleration of the commands (steps have the first only)."""

    size_rad: float
    speed_rad_s: float
    acceleration_rad_s2: float

    def at(self, hz: Array | float) -> Array:
        """Largest amplitude of a tone [rad]."""
        turn = 2 * np.pi * np.asarray(hz)
        most = np.minimum(self.size_rad, self.speed_rad_s / turn)
        return np.minimum(most, self.acceleration_rad_s2 / turn**2)


def _log(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _envelope(time: Array) -> Array:
    return np.clip((time - LEAD_IN_S) / RAMP_S, 0, 1)


def _tone(centre: float, size: float, hz: float) -> Callable[[Array], Array]:
    return lambda t: centre + size * _envelope(t) * np.sin(2 * np.pi * hz * (t - LEAD_IN_S))


def _tones(rng: np.random.Generator, total: float, centre: float, reach: Reach):
    edges = np.geomspace(1.0, 8.0, 5)
    tones = [round(_log(rng, *edges[i : i + 2]), 2) for i in range(4)]
    return [
        Stretch(max(total / 4, 5.0 / hz + 1.5), _tone(centre, float(reach.at(hz)), hz), hz)
        for hz in tones
    ]


def _one_after_another(rng: np.random.Generator, total: float, centre: float, reach: Reach):
    parts = _tones(rng, total, centre, reach)
    ends = np.cumsum([p.duration_s for p in parts])

    def command(time: Array) -> Array:
        values = np.full(len(time), centre)
        for part, end in zip(parts, ends, strict=True):
            inside = (time >= end - part.duration_s) & (time < end)
            values[inside] = part.command(time[inside] - (end - part.duration_s))
        return values

    return [Stretch(float(ends[-1]), command)]


def _walk(rng: np.random.Generator, total: float, centre: float, reach: Reach):
    grid = np.arange(0, total + 0.01, 0.01)
    knots = np.arange(0, total + 4, rng.uniform(2, 4))
    rate = np.interp(grid, knots, rng.uniform(1.5, 2.5, len(knots)))
    phase = 2 * np.pi * np.cumsum(rate) * 0.01
    order = np.arange(1, 13)
    sizes = rng.uniform(0.3, 1.0, 12) / order ** rng.uniform(1.2, 2.0)
    turns = rng.uniform(0, 2 * np.pi, 12)

    def wave(angle: Array) -> Array:
        return (sizes[:, None] * np.sin(order[:, None] * angle + turns[:, None])).sum(axis=0)

    circle = wave(np.linspace(0, 2 * np.pi, 2000))
    fastest = np.abs(np.gradient(circle, 2 * np.pi / 1999)).max() * 2 * np.pi * 2.5
    scale = min(reach.size_rad / np.abs(circle).max(), 2 * reach.speed_rad_s / fastest)
    strength = np.interp(grid, knots, rng.uniform(0.7, 1.0, len(knots)))

    def command(time: Array) -> Array:
        size = scale * _envelope(time) * np.interp(time, grid, strength)
        return centre + size * wave(np.interp(time, grid, phase))

    return [Stretch(total, command)]


def _teleop(rng: np.random.Generator, total: float, centre: float, reach: Reach):
    step = 0.01
    count = int(total / step) + 2
    moving, at = np.zeros(count), int(0.5 / step)
    while at < count:
        run, pause = int(rng.uniform(1.5, 5) / step), int(rng.uniform(0.4, 1.5) / step)
        moving[at : at + run] = 1
        at += run + pause
    band, slowest = rng.uniform(0.8, 2.5), 0.15
    noise = rng.standard_normal(count)
    speed, angle = np.zeros(count), np.zeros(count)
    state = np.zeros(3)
    share = 1 - np.exp(-2 * np.pi * band * step)
    for k in range(1, count):
        state[0] += share * (noise[k] - state[0])
        state[1] += share * (state[0] - state[1])
        state[2] += share * (moving[k] * state[1] - state[2])
        speed[k] = state[2] if moving[k] or abs(state[2]) > 1e-4 * np.abs(speed).max() else 0.0
        angle[k] = angle[k - 1] + step * speed[k]
        angle[k] -= moving[k] * 2 * np.pi * slowest * step * angle[k - 1]
    fastest = np.abs(np.diff(angle)).max() / step
    angle *= min(reach.size_rad / np.abs(angle).max(), 1.5 * reach.speed_rad_s / fastest)
    grid = step * np.arange(count)
    return [Stretch(total, lambda t: centre + np.interp(t, grid, angle))]


def _steps(rng: np.random.Generator, total: float, centre: float, reach: Reach, two: bool = False):
    """Jumps to levels, every 0.5 to 1.2 s or, between `two` levels, at a clock's ticks."""
    low, high = (rng.uniform(0.1, 0.25),) * 2 if two else (0.5, 1.2)
    starts = [0.0]
    while starts[-1] < total:
        starts.append(starts[-1] + rng.uniform(low, high))
    values = reach.size_rad * rng.uniform(-1, 1, len(starts))
    if two:
        values = 0.5 * reach.size_rad * rng.choice([-1.0, 1.0], len(starts))
    values[0] = 0.0
    return [Stretch(total, lambda t: centre + values[np.searchsorted(starts, t, "right") - 1])]


def _chirp(rng: np.random.Generator, total: float, centre: float, reach: Reach):
    low, high = rng.uniform(0.3, 0.8), rng.uniform(5, 9)

    def command(time: Array) -> Array:
        growth = np.log(high / low)
        hz = low * np.exp(growth * time / total)
        turn = 2 * np.pi * low * total / growth * (np.exp(growth * time / total) - 1)
        return centre + reach.at(hz) * _envelope(time) * np.sin(turn)

    return [Stretch(total, command)]


MOTIONS = {
    "tones": _tones, "tones_unnamed": _one_after_another, "walk": _walk, "teleop": _teleop,
    "steps": _steps, "chirp": _chirp, "prbs": partial(_steps, two=True),
}  # fmt: skip


# -------------------------------------------------------------------------------------------- kinds


@dataclass(frozen=True)
class Bus:
    """How the host sends and reads."""

    rate_hz: float
    jitter: float  # standard deviation of the time of a turn, as a share of the period
    read_after_s: float  # from a row's command to its read; negative where the read comes first
    quantum_rad: float
    noise_rad: float
    offset_rad: float
    age_s: float  # of live readings
    stamps: str = "true"  # or "end": one time per row, when its last transaction is over
    stated: bool = True  # whether the header states if readings are live
    poll_s: float = 0.0  # period of a polled bus; 0 for live readings
    loss: float = 0.0
    resampled_hz: float = 0.0  # rate to which rows are interpolated; 0 for not
    drift: float = 0.0  # share by which the readings' clock is faster than that of the commands
    setup: dict | None = None  # of the servo, as the header states it


@dataclass(frozen=True)
class Twin:
    """One drawn servo on its bus, and its motion."""

    kind: str
    motion: str
    number: int
    seed: int
    servo: Servo
    bus: Bus
    stretches: list[Stretch]


LAWS = ("slew", "back_emf", "no_limit")
KINDS = (
    *LAWS, "profile", "sts3215_lerobot", "low_pass", "dead_zone", "integral", "slow_loop",
    "backlash", "gravity", "flexible", "stribeck", "cogging", "bent_pot", "asymmetric", "sag",
    "jitter_dead_time", "drifting_dead_time", "drifting_clocks", "polled", "resampled",
)  # fmt: skip
IN_CLASS = LAWS


def _base(rng: np.random.Generator, law: str, size: float) -> Servo:
    """A servo of the class that DelayedPD assumes."""
    stiffness, ratio = _log(rng, 500, 40_000), _log(rng, 0.3, 1.5)
    total, effort = 2 * ratio * np.sqrt(stiffness), _log(rng, 40, 3000)
    share = rng.uniform(0.2, 0.9) if law == "back_emf" else 0.0
    most = min(200.0, 0.5 * effort, 0.3 * stiffness * size)
    return Servo(
        dead_time_s=_log(rng, 0.002, 0.05), stiffness=stiffness, damping=(1 - share) * total,
        back_emf=share * total, friction=_log(rng, 0.5, max(most, 1.0)), effort=effort,
        speed_limit=_log(rng, 2, 15) if law == "slew" else NEVER,
    )  # fmt: skip


def _sts3215(rng: np.random.Generator) -> Servo:
    """STS3215 at 12 V on an arm: 2.94 N·m, 4.7 to 6 rad/s, with 8 to 28 g·m² at the joint."""
    inertia = _log(rng, 0.008, 0.028)
    effort = 2.94 / inertia
    return Servo(
        dead_time_s=_log(rng, 0.002, 0.025), stiffness=_log(rng, 15, 45) / inertia,
        damping=_log(rng, 0.02, 0.2) / inertia, back_emf=effort / rng.uniform(4.7, 6.0),
        friction=_log(rng, 0.03, 0.15) / inertia, effort=effort,
        acceleration_limit=100 * LEROBOT_ACCELERATION * COUNT_RAD,
    )  # fmt: skip


def _featured(rng: np.random.Generator, kind: str, servo: Servo, size: float) -> Servo:
    """The servo with the feature of its kind; the draws of a kind come in the order they stand."""
    k, total = servo.stiffness, servo.damping + servo.back_emf
    uniform = rng.uniform
    simple: dict[str, Callable[[], dict[str, float]]] = {
        "low_pass": lambda: {"low_pass_s": _log(rng, 0.005, 0.06)},
        "dead_zone": lambda: {"dead_zone": min(_log(rng, 0.002, 0.03), 0.2 * size)},
        # below k * total the loop is stable
        "integral": lambda: {"integral": k * total * uniform(0.05, 0.4),
                             "integral_clamp": servo.effort * uniform(0.1, 0.5)},
        "gravity": lambda: {"gravity": min(_log(rng, 5, 150), 0.6 * servo.effort),
                            "gravity_phase": uniform(-np.pi, np.pi)},
        "stribeck": lambda: {"stribeck": uniform(0.3, 1.5), "stribeck_speed": _log(rng, 0.03, 0.5)},
        "cogging": lambda: {"cogging": servo.friction * uniform(0.3, 1.5),
                            "cogging_per_rad": _log(rng, 6, 60)},
        "bent_pot": lambda: {"bend": _log(rng, 0.05, 0.3), "bend_per_rad": 1 / uniform(0.2, 1.0),
                             "bend_phase": uniform(-np.pi, np.pi)},
        "asymmetric": lambda: {"asymmetry": uniform(0.1, 0.4)},
        "sag": lambda: {"sag": uniform(0.1, 0.4)},
        "jitter_dead_time": lambda: {"dead_time_jitter_s": _log(rng, 0.001, 0.01)},
        "drifting_dead_time": lambda: {"dead_time_drift_s": servo.dead_time_s * uniform(0.2, 1.0)},
    }  # fmt: skip
    if kind in simple:
        return servo._replace(**simple[kind]())
    if kind == "profile":
        speed = _log(rng, 2, 15) if rng.random() < 0.5 else NEVER
        return servo._replace(acceleration_limit=_log(rng, 10, 200), speed_limit=speed)
    if kind == "slow_loop":
        period = 1 / _log(rng, 20, 50)
        if rng.random() < 0.5:  # a fast loop that takes over commands at its frame rate
            return servo._replace(latch_s=period)
        while True:  # a loop that is slow itself: weaker, and stable
            k, ratio = _log(rng, 50, 4000), _log(rng, 0.3, 1.5)
            total, share = 2 * ratio * np.sqrt(k), uniform(0.5, 1.0)
            slow = servo._replace(
                stiffness=k, damping=(1 - share) * total, back_emf=share * total, loop_s=period,
                friction=min(servo.friction, 0.3 * k * size), speed_limit=NEVER,
            )  # fmt: skip
            if _radius(slow) < 0.9:
                return slow
    if kind in ("backlash", "flexible"):
        m = uniform(0.5, 0.9)
        two = servo._replace(motor_share=m, link_friction_share=uniform(0.1, 0.4))
        if kind == "flexible":
            w = 2 * np.pi * _log(rng, 6, 25)  # resonance of the link on a held motor
            return two._replace(
                link_stiffness=w * w * (1 - m), link_damping=2 * _log(rng, 0.02, 0.2) * w * (1 - m)
            )
        w, reduced = 2 * np.pi * 150, m * (1 - m)
        return two._replace(
            link_stiffness=w * w * reduced, link_damping=1.6 * w * reduced,
            play=min(_log(rng, 0.005, 0.05), 0.3 * size), read_on_motor=0.0,
            loop_on_motor=float(rng.random() < 0.5),
        )  # fmt: skip
    return servo


def _radius(servo: Servo) -> float:
    """Spectral radius of the sampled loop, for torques that are held for one period."""
    t, b = servo.loop_s, servo.back_emf
    decay = np.exp(-b * t)
    reach = (1 - decay) / b
    step = np.array([[(t - reach) / b], [reach]])  # of a unit torque: angle, speed
    free = np.array([[1.0, reach], [0.0, decay]])
    return float(np.abs(np.linalg.eigvals(free - step @ [[servo.stiffness, servo.damping]])).max())


def _bus(rng: np.random.Generator, kind: str, number: int) -> Bus:
    rate, quantum = _log(rng, 20, 1000), _log(rng, 1e-4, 6e-3)
    if kind == "sts3215_lerobot":
        rate, quantum = _log(rng, 30, 100), COUNT_RAD
    if kind in ("polled", "resampled", "drifting_clocks"):
        rate = _log(rng, 20, 200)
    after = min(rng.uniform(0.05, 0.5) / rate, 0.005)
    bus = Bus(
        rate_hz=rate, jitter=_log(rng, 0.002, 0.1), quantum_rad=quantum,
        read_after_s=after if rng.random() < 0.8 else -after,
        noise_rad=quantum * rng.uniform(0, 1), offset_rad=rng.normal(0, 0.01),
        age_s=rng.uniform(0, 0.0003), stated=bool(rng.random() < 0.7),
        stamps="end" if rng.random() < 0.25 else "true",
    )  # fmt: skip
    if kind == "polled":
        return replace(bus, stamps="true", poll_s=0.02, loss=rng.uniform(0, 0.4))
    if kind == "resampled":
        return replace(bus, stamps="end", resampled_hz=rate * rng.uniform(0.9, 2.2))
    if kind == "drifting_clocks":
        drift = rng.uniform(0.0004, 0.0012) * rng.choice([-1, 1])
        return replace(bus, stamps="true", drift=drift)
    if kind == "sts3215_lerobot":
        setup: dict = {"model": "STS3215", "p_gain": 16, "i_gain": 0, "d_gain": 32}
        if number % 2 == 0:
            setup["registers"] = {"acceleration": LEROBOT_ACCELERATION}
        return replace(bus, stamps="true", setup=setup)
    return bus


MOST_ROWS = 12_000


def draw_twin(kind: str, motion: str, number: int, seed: int) -> tuple[Twin, Path, Array, Array]:
    """Draw twin `number`: servo, bus, motion; its path, the times of all sends and their commands.

    Drawn again until the joint follows its commands and stands still before the first.
    """
    names = [zlib.crc32(kind.encode()), zlib.crc32(motion.encode())]
    for attempt in range(200):
        rng = np.random.default_rng([seed, *names, number, attempt])
        size, peak = _log(rng, 0.08, 0.5), _log(rng, 2, 12)
        law = kind if kind in LAWS else str(rng.choice(LAWS))
        servo = _sts3215(rng) if kind == "sts3215_lerobot" else _base(rng, law, size)
        servo = _featured(rng, kind, servo, size)
        bus = _bus(rng, kind, number)
        total = min(_log(rng, 10, 40), MOST_ROWS / bus.rate_hz)
        # far above its limit a profile's motion depends on every rounding
        reach = Reach(size, peak, servo.acceleration_limit * _log(rng, 0.5, 4))
        stretches = MOTIONS[motion](rng, total, rng.uniform(-0.5, 0.5), reach)
        twin = Twin(kind, motion, number, seed, servo, bus, stretches)
        if servo.back_emf > 0 and servo.effort / servo.back_emf < 2.0:
            continue  # no joint is that slow
        sent, commands, _ = sends(twin)
        path = simulate(servo, sent, commands, sent[-1] + 0.5, sender(twin, "servo"))
        if _follows(twin, path, sent, commands):
            return twin, path, sent, commands
    raise RuntimeError(f"no {kind} follows {motion} in 200 draws")


def sender(twin: Twin, part: str) -> np.random.Generator:
    """Random numbers of one part of a twin."""
    names = [zlib.crc32(x.encode()) for x in (twin.kind, twin.motion, part)]
    return np.random.default_rng([twin.seed, *names, twin.number])


GAP_S = 1.2
SHIFT_S = 0.001


def sends(twin: Twin) -> tuple[Array, Array, NDArray[np.int64]]:
    """Time, command and trial of every send; trial -1 on the way back between trials."""
    rng, period = sender(twin, "host"), 1 / twin.bus.rate_hz
    times, values, trials, start = [], [], [], 0.0
    for number, stretch in enumerate(twin.stretches):
        count = int(stretch.duration_s * twin.bus.rate_hz)
        late = twin.bus.jitter * period * np.abs(rng.standard_normal(count))
        late += np.where(rng.random(count) < 0.005, rng.uniform(0.3, 1.5, count) * period, 0)
        # turns after a late one are made up for, each in a fifth of a period at least
        least = 0.2 * period * np.arange(count)
        own = np.maximum.accumulate(period * np.arange(count) + late - least) + least
        # a program computes commands for its turns; they go out when they go out
        value = stretch.command(own)
        times += [start + own, [start + own[-1] + period]]
        values += [value, value[:1]]
        trials += [np.full(count, number), [-1]]
        start += stretch.duration_s + period + GAP_S
    return np.concatenate(times), np.concatenate(values), np.concatenate(trials)


def _follows(twin: Twin, path: Path, sent: Array, commands: Array) -> bool:
    """Whether the joint moves with its commands, and rests before them."""
    if not np.isfinite(path.angle).all():
        return False
    rest = path.angle[(path.time_s > sent[0] - 0.4) & (path.time_s <= sent[0])]
    if np.ptp(rest) > 2e-3 + twin.servo.play:
        return False
    grid = np.arange(sent[0] + 0.5, sent[-1], 0.002)
    held = commands[np.searchsorted(sent, grid, "right") - 1]
    moved = np.interp(grid, path.time_s, path.angle)
    gain = moved.std() / held.std()
    if not 0.3 < gain < 2.0 or any(t["gain"] > 2 for t in tone_truths(twin, path, sent, commands)):
        return False
    best = max(np.corrcoef(held[: len(held) - n], moved[n:])[0, 1] for n in range(0, 200, 5))
    return bool(best > 0.6)


# ---------------------------------------------------------------------------------------- readings


@dataclass(frozen=True)
class Rows:
    """What a host logs."""

    sent_s: Array
    read_s: Array
    command: Array
    position: Array
    trial: NDArray[np.int64]
    frequency_hz: Array


def readings(twin: Twin, path: Path) -> Rows:
    """Rows of the recording, with the errors of readings and clocks."""
    bus, rng = twin.bus, sender(twin, "readings")
    sent, commands, trial = sends(twin)
    own = trial >= 0
    sent, commands, trial = sent[own], commands[own], trial[own]
    slow = np.minimum(1e-4 * np.abs(rng.standard_normal(len(sent))), 0.05 / bus.rate_hz)
    read = sent + bus.read_after_s + slow
    measured = read - bus.age_s
    if bus.poll_s > 0:
        polls = np.arange(sent[0] - 10 * bus.poll_s, read[-1], bus.poll_s)
        polls = polls + rng.uniform(0, bus.poll_s)
        polls = polls[rng.random(len(polls)) >= bus.loss]
        index = np.searchsorted(polls, read, "right") - 1
        value = _counted(np.interp(polls, path.time_s, path.angle), bus, rng)
        position = value[np.maximum(index, 0)]
    else:
        position = _counted(np.interp(measured, path.time_s, path.angle), bus, rng)
    hz = np.array([s.frequency_hz for s in twin.stretches])[trial]
    read = read * (1 + bus.drift)
    if bus.stamps == "end":  # one stamp, when the turn's last transaction is over
        sent = read = np.maximum(sent, read) + 1e-4
    rows = Rows(sent, read, commands, position, trial, hz)
    return _resampled(rows, bus.resampled_hz) if bus.resampled_hz > 0 else rows


def _counted(angle: Array, bus: Bus, rng: np.random.Generator) -> Array:
    value = angle + bus.offset_rad + bus.noise_rad * rng.standard_normal(len(angle))
    return bus.quantum_rad * np.round(value / bus.quantum_rad)


def _resampled(rows: Rows, rate_hz: float) -> Rows:
    """Rows interpolated to an even grid in every trial."""
    parts = []
    for number in np.unique(rows.trial):
        own = rows.trial == number
        old = rows.sent_s[own]
        new = np.arange(old[0], old[-1], 1 / rate_hz)
        parts.append(
            (new, np.interp(new, old, rows.command[own]), np.interp(new, old, rows.position[own]),
             np.full(len(new), number), np.full(len(new), rows.frequency_hz[own][0]))
        )  # fmt: skip
    time, command, position, trial, hz = (np.concatenate(c) for c in zip(*parts, strict=True))
    return Rows(time, time, command, position, trial, hz)


# -------------------------------------------------------------------------------------------- truth

Band = tuple[float, float]


def truths(twin: Twin, path: Path) -> dict[str, Band]:
    """Ends of the values that an answer may have, by quantity; infinite without a limit.

    A band has a width where the servo has no single number: two masses (per total inertia … per
    that of the motor), a bent potentiometer (its slopes), static and Coulomb friction, torque up
    and down, a command that waits for the loop, the age of live readings, which no stamp shows.
    """
    s = twin.servo
    wait = max(s.loop_s, s.latch_s)
    dead = (s.dead_time_s, s.dead_time_s + wait + s.dead_time_drift_s + age_s(twin.bus))
    if s.dead_time_jitter_s > 0:
        dead = (float(np.median(path.delays_s)), float(path.delays_s.mean()))
    low, high = path.slopes
    heavy = 1 / s.motor_share
    weak = (1 - s.asymmetry) * (1 - s.sag)
    total = s.damping + s.back_emf
    nothing = 0.02 * total  # of a damping that the servo has not
    half = 0.5 * s.play * (1 - s.read_on_motor) * s.loop_on_motor
    return {
        "dead_time_s": (min(dead), max(dead)),
        "stiffness": (s.stiffness * low * (1 - s.sag), s.stiffness * high * heavy),
        "damping": (s.damping * low * (1 - s.sag) - nothing * (s.damping == 0),
                    s.damping * high * heavy + nothing * (s.damping == 0)),
        "back_emf": (s.back_emf, s.back_emf * heavy + nothing * (s.back_emf == 0)),
        "damping_sum": ((s.damping * low * (1 - s.sag) + s.back_emf),
                        (s.damping * high + s.back_emf) * heavy),
        "friction_loss": (s.friction * low,
                          (s.friction * (1 + s.stribeck) + s.cogging) * high * heavy),
        "effort_limit": (s.effort * weak * low, s.effort * high * heavy),
        "speed_limit": (s.speed_limit, s.speed_limit),
        "acceleration_limit": (s.acceleration_limit, s.acceleration_limit),
        "offset_rad": (twin.bus.offset_rad - half, twin.bus.offset_rad + half),
    }  # fmt: skip


def age_s(bus: Bus) -> float:
    """Age of live readings, which no recording tells from lag [s]."""
    return 0.0 if bus.poll_s > 0 else bus.age_s


def tone_truths(twin: Twin, path: Path, sent: Array, commands: Array) -> list[dict]:
    """True lag of each named tone: phase delay from the held command to the motion [s]."""
    times, _, trials = sends(twin)
    lags, near = [], None
    for i, stretch in sorted(enumerate(twin.stretches), key=lambda x: x[1].frequency_hz):
        hz = stretch.frequency_hz
        if not hz > 0:
            continue
        rows = times[trials == i]
        start = rows[0] + LEAD_IN_S + RAMP_S + 0.3
        grid = np.arange(start, start + np.floor((rows[-1] - start) * hz) / hz, 5e-4)
        held = commands[np.searchsorted(sent, grid, "right") - 1]
        moved = np.interp(grid, path.time_s, path.angle)
        response = _phasor(grid, moved, hz) / _phasor(grid, held, hz)
        # the lowest tone settles its own period, each other one is near the tone below
        near = 0.4 / hz if near is None else near
        near -= float(np.angle(response * np.exp(2j * np.pi * hz * near))) / (2 * np.pi * hz)
        truth = near + age_s(twin.bus)
        lags.append({"trial": i, "frequency_hz": hz, "truth": truth, "gain": float(abs(response))})
    return lags


def _phasor(time: Array, value: Array, hz: float) -> complex:
    columns = [np.ones(len(time))]
    for n in (1, 2, 3, 5):
        columns += [np.cos(2 * np.pi * n * hz * time), -np.sin(2 * np.pi * n * hz * time)]
    fit = np.linalg.lstsq(np.stack(columns, 1), value, rcond=None)[0]
    return complex(fit[1], fit[2])


def lag_truth(twin: Twin, path: Path, sent: Array, commands: Array) -> float:
    """Time shift at which the motion and the held command correlate best while recorded [s].

    What comes after the last command is not recorded: after a jump it moves the lag by 20 ms.
    """
    grid = np.arange(sent[0] - 0.6, sent[-1], SHIFT_S)
    held = commands[np.maximum(np.searchsorted(sent, grid, "right") - 1, 0)]
    moved = np.interp(grid, path.time_s, path.angle)
    return best_shift_s(held, moved, SHIFT_S, 0.6) + age_s(twin.bus)


def best_shift_s(held: Array, moved: Array, earliest_s: float, longest_s: float) -> float:
    """Shift of a motion behind its command that correlates best, both every `SHIFT_S` [s]."""
    early, first = round(earliest_s / SHIFT_S), round(longest_s / SHIFT_S)
    # one window of the motion against each shifted window of the command
    last = len(held) - early
    window = moved[first:last] - moved[first:last].mean()
    shifts = np.arange(1 - early, first)
    scores = np.empty(len(shifts))
    for n, shift in enumerate(shifts):
        earlier = held[first - shift : last - shift]
        scores[n] = window @ (earlier - earlier.mean()) / max(earlier.std(), 1e-12)
    top = int(np.clip(np.argmax(scores), 1, len(scores) - 2))
    a, b, c = scores[top - 1 : top + 2]
    return float(SHIFT_S * (shifts[top] + 0.5 * (a - c) / (a - 2 * b + c)))
