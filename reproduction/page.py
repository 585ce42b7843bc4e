"""The pages: every published claim beside what is found here.

`claims.md` is for a repository, `claims.html` for reading: one file with its pictures inside.
Beside them lie the pictures as PNG and SVG and the tables as CSV.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

import reproduction.evidence
from pupper_sysid.cli import policy_choice, terminal
from pupper_sysid.common.errors import InputError
from pupper_sysid.common.figure_style import BLUE, FAINT, JOINT_COLOURS, RED, axes_column, styled
from pupper_sysid.common.files import refuse_overwrite, sha256, versions, write_text
from pupper_sysid.common.page import Picture, Section, write_page
from pupper_sysid.common.tables import Column, Table
from pupper_sysid.policies.analysis import figures
from pupper_sysid.policies.analysis.autonomy import DELAYS_MS
from pupper_sysid.policies.deploy.stacks import STACKS
from pupper_sysid.servo_models.servo_file import WEIGHTS
from pupper_sysid.sysid.recordings.recording import Trial
from pupper_sysid.sysid.report.figures import within
from reproduction import policies as policy_claims
from reproduction import servos as servo_claims
from reproduction import walks as walk_claims
from reproduction.evidence import A_TROT, KINDS, Claim, PolicyEvidence, Training, gather, over

Evidence = tuple[list[PolicyEvidence], list[Training]]

if TYPE_CHECKING:
    from pupper_sysid.cli.commands.walks import Tries
    from reproduction.__main__ import Options

_SHOWN_S = 2.0
_THIGH = 1  # LF thigh, as the paper draws


@styled
def delay_trace_figure(
    actions: Mapping[str, Sequence[NDArray[np.floating]]], delays_ms: Sequence[float], step_s: float
) -> Figure:
    """The LF thigh's action over two seconds, a panel per delay, a line per policy."""
    figure, axes = axes_column(len(delays_ms), 1.9 * len(delays_ms))
    count = round(_SHOWN_S / step_s)
    time = step_s * np.arange(count)
    for i, (one, delay) in enumerate(zip(axes, delays_ms, strict=True)):
        for k, (policy, conditions) in enumerate(actions.items()):
            one.plot(
                time, conditions[i][:count, _THIGH], "-" if k == 0 else "--",
                color=JOINT_COLOURS[k], label=policy,
            )  # fmt: skip
        one.set(title=f"joints late by {delay:g} ms", ylabel="rad", xlim=(0, time[-1]))
    axes[-1].set_xlabel("time [s]")
    axes[0].legend(fontsize=7, loc="upper right")
    return figure


@styled
def training_figure(trainings: Sequence[Training]) -> Figure:
    """Reward per second and duration of an episode against samples, a line per training."""
    figure, axes = axes_column(2, 2 * 2.2)
    kinds, drawn = list(KINDS), set()
    for each in trainings:
        samples, *curves = each.curve
        label = KINDS[each.kind] if each.kind not in drawn else None
        drawn.add(each.kind)
        for one, curve in zip(axes, curves, strict=True):
            one.plot(samples, curve, color=JOINT_COLOURS[kinds.index(each.kind)], label=label)
    axes[0].set(ylabel="reward per second")
    axes[1].set(ylabel="episode [s]", xlabel="samples [millions]")
    axes[0].legend(fontsize=7)
    return figure


PAGE, REPORT = "claims.md", "claims.html"
PICTURES = (
    "training", "sweep", "gait-lstm", "gait-mlp", "orbits", "late", "ablation", "delay",
    "autonomy", "terrain", "compliance", "servos",
)  # fmt: skip
"""All that may be drawn; which are depends on the evidence."""
TABLES = ("claims", "beside", "table_one", "inputs")
"""As `PICTURES`."""
_STACK_ROUNDS, _STACK_SECONDS = 6, 10.0
_STACK_COMMANDS = ((0.15, 0.0, 0.0), (0.0, 0.08, 0.0), (0.0, 0.0, 0.4))


def write_claims(options: Options, tries: Tries) -> None:
    """Gather, judge, draw and write."""
    page, report = options.out / PAGE, options.out / REPORT
    drawings = [f"figures/{name}{ending}" for name in PICTURES for ending in (".png", ".svg")]
    tables = [f"tables/{name}.csv" for name in TABLES]
    for name in (PAGE, REPORT, *drawings, *tables):  # before hours of work
        refuse_overwrite(options.out / name, options.force)
    if options.beside is not None:
        reproduction.evidence.differences([], options.beside)
    for name, (policy, _) in tries.items():
        if policy.contract.kind not in KINDS:
            raise InputError(
                f"{name} is of the kind {policy.contract.kind}, about which nothing was published. "
                f"Leave it out; claims are about {', '.join(KINDS)}."
            )
    trainings = [reproduction.evidence.training(folder) for folder in options.from_nothing]
    recordings = terminal.load_all(options.recordings) if options.recordings else []
    walks = walk_claims.gather(options.imu)
    stacks: list[dict[str, Any]] = []
    if options.servo is not None:  # before hours of work, too: its servo model may not suit
        policy, run = policy_choice.policy_at(options.policies[0])
        closed = STACKS["closed-loop"]
        # the same smoothing in both: only the policy's observation differs
        predicted = replace(closed, observer="servo-model")
        stacks = walk_claims.compare_stacks(
            policy, {"encoders": closed, "servo model": predicted},
            # a servo model is one robot's: the one of --seed
            [walk_claims.Walker(options.seed, options.servo, k) for k in range(_STACK_ROUNDS)],
            _STACK_COMMANDS, _STACK_SECONDS,
            policy_choice.chosen_actuator(options.policies[0], policy, run, options.actuator),
            _show_step,
        )  # fmt: skip
    robot = servo_claims.gather(recordings, options.seed, _show_step)
    evidence = [
        gather(name, policy, trial, policy_choice.run_folder(path), _show_step)
        for (name, (policy, trial)), path in zip(tries.items(), options.policies, strict=True)
    ]
    longest = {
        joint: max(playback.trials(joint), key=lambda t: len(t.send_time_s))
        for playback in filter(None, [robot.played]) for joint in playback.joints
    }  # fmt: skip
    played = {j: (t.send_time_s, t.command_rad, t.position_rad) for j, t in longest.items()}
    claims = [
        *servo_claims.judge(robot), *policy_claims.judge(evidence, played, stacks, trainings),
        *walk_claims.judge(walks),
    ]  # fmt: skip
    other = None
    if options.beside is not None:
        other = reproduction.evidence.differences(claims, options.beside)
    pictures = _draw(evidence, robot, trainings)
    inputs = _inputs(options, tries)
    summary = _summary(claims, evidence, trainings)
    sections = _sections(
        claims, other, (evidence, trainings), pictures, inputs, options, summary[1:]
    )
    write_text(page, _markdown(_TITLE, summary[0], sections), options.force)
    write_page(report, _TITLE, summary[0], sections, options.force)
    if options.json:
        return terminal.print_json({
            "claims": claims, "page": str(page), "report": str(report),
            "pictures": [_file(p) for p in pictures], "inputs_sha256": inputs,
            "versions": versions(*_MORE),
        })  # fmt: skip
    terminal.print_table(
        "Published claims", "", "claim", "paper", "here", "verdict",
        rows=((c.id, c.claim, c.paper, c.ours, c.verdict) for c in claims),
    )  # fmt: skip
    terminal.err.print(
        f"Wrote {report}, {page} and {len(pictures)} pictures beside them.", soft_wrap=True
    )


def _show_step(what: str) -> None:
    terminal.err.print(f"{what} …", style="dim")


@styled
def _sweep_figure(trials: Sequence[Trial]) -> Figure:
    """Three periods of commands and readings of a joint's tones; stale readings are faint."""
    figure, panels = axes_column(len(trials), 0.6 + 1.35 * len(trials))
    for axes, trial in zip(panels, trials, strict=True):
        start = float(np.median(trial.send_time_s))
        rows = within(trial.send_time_s, start, start + 3.0 / trial.frequency_hz)
        time = trial.send_time_s[rows] - start
        reading = trial.position_rad[rows]
        fresh = np.diff(reading, prepend=np.nan) != 0
        axes.plot(time, trial.command_rad[rows], "--", color=BLUE, lw=1.2, label="command")
        axes.plot(time[~fresh], reading[~fresh], "o", ms=2.5, color=FAINT, label="stale reading")
        axes.plot(time[fresh], reading[fresh], "o", ms=3.0, color=RED, label="fresh reading")
        axes.set_title(f"{trial.joint}, {trial.frequency_hz:g} Hz")
        axes.set_ylabel("rad")
    panels[0].legend(fontsize=7.5, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    panels[-1].set_xlabel("time [s]")
    return figure


def _draw(
    evidence: list[PolicyEvidence], robot: servo_claims.ServoEvidence, trainings: list[Training]
) -> list[Picture]:
    """What can be shown of the evidence."""
    drawn: list[tuple[str, str, Figure]] = []
    if trainings:
        caption = "Trainings from random weights in the published task, each a line."
        drawn.append(("training", caption, training_figure(trainings)))
    if robot.sweep is not None:
        trials = robot.sweep.trials(robot.sweep.joints[-1])
        figure = _sweep_figure([t for t in trials if np.isfinite(t.frequency_hz)])
        caption = "As the paper's figure 2: commands and readings by frequency. Faint ones are old."
        drawn.append(("sweep", caption, figure))
    for kind in ("lstm", "mlp"):
        for first in [e for e in evidence if e.kind == kind][:1]:
            caption = f"As figure 4: the gait of {first.name}."
            drawn.append((f"gait-{kind}", caption, figures.gait_figure(first.walk)))
    moving = _one_per_kind([e for e in evidence if e.orbits])
    if moving:
        orbits = {f"{e.name} {k}": v.orbits for e in moving for k, v in e.orbits.items()}
        late = {e.name: e.orbits["actions"].states for e in moving}
        drawn += [
            ("orbits", "As figure 5: orbits of actions and hidden states, joints late by 0, 160, "
             "320 ms.", figures.orbit_figure(orbits, DELAYS_MS)),
            ("late", "As figure 6: the LF thigh's action in replay with late joints.",
             delay_trace_figure(late, DELAYS_MS, moving[0].walk.step_s)),
        ]  # fmt: skip
    every = _one_per_kind(evidence)
    for name, caption in _OF_ANALYSES.items():
        of_policies = {e.name: getattr(e, name) for e in every}
        drawn.append((name, caption, getattr(figures, f"{name}_figure")(of_policies)))
    if robot.servos is not None:
        caption = "As the extension's figure: four servo models on an unseen loop."
        drawn.append(("servos", caption, robot.servos.plot()))
    return [Picture(*each) for each in drawn]


_OF_ANALYSES = {
    "ablation":
        "As figure 7a: correlation of actions against noise in all that comes from the joints.",
    "delay": "Closed loop and replay against more delay, which the paper shows in replay only.",
    "autonomy": "Tests that the paper lacks: frozen inputs, pushes, other control rates.",
    "terrain": "Other ground.",
    "compliance": "As figure 7b: where one robot goes in six directions in ten seconds.",
}  # fmt: skip
"""Captions of the figures that are called as their analyses."""


def _file(picture: Picture) -> str:
    """Path of a picture from the page."""
    return f"figures/{picture.name}.png"


def _one_per_kind(evidence: list[PolicyEvidence]) -> list[PolicyEvidence]:
    """The first policy of each architecture."""
    return list({e.kind: e for e in reversed(evidence)}.values())[::-1]


def _markdown(title: str, answer: str, sections: list[Section]) -> str:
    """The same page as Markdown."""
    blocks = [f"# {title}", answer]
    for section in sections:
        blocks += [f"## {section.title}", *section.text]
        for picture in section.figures:
            blocks += [f"![{picture.caption}]({_file(picture)})", picture.caption]
        for table in section.tables:
            cells = [[c.page_heading for c in table.columns], ["---"] * len(table.columns)]
            cells += [[column.text(row) for column in table.columns] for row in table.rows]
            blocks.append("\n".join(f"| {' | '.join(row)} |" for row in cells))
    return "\n\n".join(blocks) + "\n"


def _sections(
    claims_found: list[Claim], other: list[dict[str, str]] | None, evidence: Evidence,
    pictures: list[Picture], inputs: dict[str, str], options: Options, summary: list[str],
) -> list[Section]:  # fmt: skip
    """The parts of the page."""
    claims = []
    for c in claims_found:
        taught = c.id in policy_claims.TAUGHT and any(e.first_gait == A_TROT for e in evidence[0])
        bounds = "; ".join(
            f"{k} {_number(v.low)} to {_number(v.high)}" for k, v in (c.interval or {}).items()
        )
        here = c.ours + (f" ({bounds})" if bounds else "")
        claims.append({**c.to_dict(), "id": c.id + (" †" if taught else ""), "here": here})
    columns = (
        Column("", "id", kind="key"),
        *(Column(key, key, kind="prose") for key in ("claim", "paper", "here", "how")),
        Column("verdict", "verdict", kind="words"),
    )
    kinds, rows = _table_one(evidence)
    one = tuple({"": title} | dict(zip(kinds, cells, strict=True)) for title, cells in rows)
    first = Column("", "", kind="words")
    compared = []
    if other is not None:
        text = "Every claim that both pages have is judged alike."
        if other:
            text = "Claims that the page given with `--beside` judges otherwise."
        shown = tuple(Column(head, key, kind="prose" if head else "key") for head, key in _OTHER)
        tables = [Table("beside", "Judged otherwise", shown, tuple(other))] if other else []
        compared = [Section("beside", _BESIDE, [text], tables=tables)]
    made_with = ", ".join(f"{name} {version}" for name, version in versions(*_MORE).items())
    return [
        Section(
            "claims", "Claims", [*summary, _ABOUT],
            tables=[Table("claims", "What the paper says, and what is found here",
                          columns, claims)],
        ),
        *compared,
        Section(
            "table", _TABLE_ONE,
            tables=[Table("table_one", "Architectures, means and ranges",
                          (first, *(Column(k, k, show=itemgetter(k)) for k in kinds)), one)],
        ),
        Section("pictures", "Pictures", figures=pictures),
        Section(
            "made", _MADE, [f"Made by: `{_command(options)}`", f"{made_with}."],
            tables=[Table("inputs", "What it was made from", (
                Column("input", "input", kind="words"),
                Column("SHA-256", "digest", kind="prose"),
            ), tuple({"input": k, "digest": v} for k, v in inputs.items()))],
        ),
    ]  # fmt: skip


_HOLD = {
    "holds": "hold", "holds partly": "hold in part", "does not hold here": "do not hold here",
    "not testable here": "cannot be tested here",
}  # fmt: skip
"""Verdicts about several."""
_TITLE, _TABLE_ONE = "The published claims, one by one", "Table I, regenerated"
_MADE, _BESIDE = "Where this comes from", "Beside the other page"
_OTHER = (
    ("", "id"), ("claim", "claim"), ("here", "here"), ("verdict here", "verdict"),
    ("there", "there"), ("verdict there", "verdict_there"),
)  # fmt: skip
"""Headings and keys of what another page judges otherwise."""
_MORE = ("torch", "pandas")  # packages that shape these numbers beside the usual ones
_ABOUT = (
    "Behind a number stands the range of the policies of a kind where there are several, else the "
    "90 % interval over robots or stretches of time. Policies were trained and walked in "
    "simulation with a calibrated robot; claims about the physical one are judged by its "
    "recordings and the logs of its IMU."
)


def _summary(
    claims: list[Claim], evidence: list[PolicyEvidence], trainings: list[Training]
) -> list[str]:
    """A paragraph each: the answer, what imitation decides, what was not tested as published."""
    by_verdict: dict[str, list[Claim]] = {}
    for one in claims:
        by_verdict.setdefault(one.verdict, []).append(one)
    counts = [f"{len(by_verdict[v])} {words}" for v, words in _HOLD.items() if v in by_verdict]
    answer = f"Of {len(claims)} published claims {', '.join(counts)}."
    for verdict, words in (("holds", "What holds"), ("holds partly", "In part")):
        if rows := by_verdict.get(verdict):
            answer += f" {words}: " + "; ".join(f"{c.claim} ({c.id})" for c in rows) + "."
    paragraphs = [answer]
    if any(e.first_gait == A_TROT for e in evidence):
        paragraphs.append(
            "**What the teacher decides (†).** These policies first imitated an open-loop trot, "
            "whose action follows from the command and the last two actions alone: joints, IMU and "
            "memory play no part in it. So a rhythm that runs through the last action, walking on "
            "with late, noisy or frozen joints, and much of the survival on other ground is what "
            "they were taught, whatever their architecture, and says nothing about one."
        )
    paragraphs.append(
        "**Not tested as published.** "
        + (
            f"{len(trainings)} trainings began from random weights, with the published task and "
            "rewards, without clock and teacher, the exploration learned: the claims about "
            "training (T1 to T4) are judged by them. No policy that walks was trained so here."
            if trainings
            else "No policy here was trained from random weights, so that the claims about "
            "training (T1 to T4) are open."
        )
    )
    return paragraphs


def _command(options: Options) -> str:
    """The command that makes the page, with files by their names."""
    flags: dict[str, Sequence[Any]] = {
        "": options.policies,
        "--from-nothing": options.from_nothing,
        "--recordings": [p.name for p in options.recordings],
        "--imu": [f"{kind}={Path(name).name}" for kind, name in _logs(options)],
        "--servo": [options.servo.name] if options.servo else (),
        "--actuator": [options.actuator] if options.actuator else (),
        "--feedback": [options.feedback] if options.feedback else (),
        "--beside": [options.beside] if options.beside else (),
        "--command": [f"{c:g}" for c in options.command],
        **{f"--{k}": [f"{getattr(options, k):g}"] for k in ("robots", "seconds", "seed")},
        "--out": [options.out],
    }
    words = [str(word) for flag, values in flags.items() if values for word in (flag, *values)]
    return " ".join(["python -m reproduction", *filter(None, words)])


def _logs(options: Options) -> list[tuple[str, str]]:
    """Kind of policy and file of each IMU log."""
    return [(kind, name) for kind, _, name in (text.partition("=") for text in options.imu)]


def _inputs(options: Options, tries: Tries) -> dict[str, str]:
    """SHA-256 of everything the page rests on, by name."""
    hashes = {
        f"policy {name}": policy.contract.weights_sha256 for name, (policy, _) in tries.items()
    }
    servos = {Path(trial.servos.source) for _, trial in tries.values()}
    if options.servo:
        servos.add(options.servo)
    files = [p / WEIGHTS if p.is_dir() else p for p in sorted(servos)]
    files += [options.beside] if options.beside else []
    files += [*options.recordings, *(Path(name) for _, name in _logs(options))]
    return hashes | {"/".join(f.parts[-2:]): sha256(f) for f in files if f.is_file()}


def _table_one(both: Evidence) -> tuple[list[str], list[tuple[str, list[str]]]]:
    """A column per architecture: their names, and rows of a title and a cell for each."""
    evidence, trainings = both
    kinds = [k for k in KINDS if any(e.kind == k for e in (*evidence, *trainings))]
    known = [e for e in evidence if e.trained]
    rows: dict[str, Any] = {
        "from random weights: million samples": (trainings, lambda t: t.million_samples, 1),
        "reward per second, published task": (trainings, lambda t: t.reward, 2),
        "learned action noise": (trainings, lambda t: t.std, 2),
        "stays up, s": (trainings, lambda t: t.lasted_s, 1),
        "steps/s, from random weights": (trainings, lambda t: t.steps_per_s, 0),
        "after imitation: reward per second": (known, lambda e: e.trained["reward"], 2),
        "scheduled action noise": (known, lambda e: e.trained["std"], 4),
        "updates of PPO": (known, lambda e: e.trained["updates"], 0),
        "steps/s, after imitation": (known, lambda e: e.trained["steps_per_s"], 0),
        "still up after 10 s, flat": (evidence, lambda e: e.terrain[0].survival, 2),
        "still up, other ground": (
            evidence, lambda e: float(np.mean([r.survival for r in e.terrain[1:]])), 2,
        ),
        "forward error, m/s": (evidence, lambda e: e.terrain[0].mae_vx_m_s, 3),
    }  # fmt: skip
    table_rows = [("policies", [str(sum(e.kind == k for e in evidence)) for k in kinds])]
    for title, (where, value, digits) in rows.items():
        cells = []
        for kind in kinds:
            mean = over(where, kind, value)
            cells.append(terminal.number(mean.value, digits))
            if np.isfinite(mean.low):
                cells[-1] += f" ({mean.low:.{digits}f} to {mean.high:.{digits}f})"
        table_rows.append((title, cells))
    return [KINDS[k] for k in kinds], table_rows


def _number(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
