"""`servo`: list, show and compare servo cards."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from textwrap import wrap
from typing import Annotated, Any

import tyro

from pupper_sysid.cli import terminal
from pupper_sysid.cli.terminal import Json
from pupper_sysid.common.errors import InputError, refuse_outside
from pupper_sysid.servo_models.calibration.parts import ARMATURES, P_GAINS
from pupper_sysid.servo_models.calibration.quantity import Quantity, words_of
from pupper_sysid.servo_models.cards import compare
from pupper_sysid.servo_models.cards.card import ServoCard
from pupper_sysid.servo_models.cards.files import card_names, load_card
from pupper_sysid.servo_models.cards.numbers import TorquePD, unit

_WIDTH = 78


@dataclass(frozen=True)
class List:
    """List the servo cards of this tool, and what each says.

    Example: pupper-sysid servo list
    """

    json: Json = False

    def run(self) -> None:
        """Read every card and print a table."""
        cards, n = {name: load_card(name) for name in card_names()}, terminal.number
        if self.json:
            return terminal.print_json({"cards": {n: _summary(c) for n, c in cards.items()}})
        terminal.print_table(
            "Servo cards, as PD in torque", "name", "V", "P", "N·m/rad", "N·m", "kg·m²", "friction",
            "dead ms",
            rows=(
                (
                    name + ("" if card.published else " *"), _plain(card.supply_v),
                    _plain(card.gains.p),
                    n(pd.stiffness_nm_per_rad.value, 1), n(pd.effort_limit_nm.value, 2),
                    n(pd.armature_kg_m2.value, 4) + "+" * (card.armature != "servo"),
                    n(pd.friction_loss_nm.value, 3),
                    terminal.ms(pd.dead_time_s.value if pd.dead_time_s else None),
                )
                for name, card in cards.items()
                for pd in [card.pd()]
            ),
        )  # fmt: skip
        ours = any(not card.published for card in cards.values())
        terminal.err.print(
            ("* fitted here, all others cited. " if ours else "All are cited from others. ")
            + "`pupper-sysid servo show NAME` says where from. An armature with + holds the link."
        )
        terminal.warn(*(text for card in cards.values() for text in compare.implausible(card)))


@dataclass(frozen=True)
class Show:
    """Show one servo card: numbers, source, licence, notes.

    Example: pupper-sysid servo show sts3215-bam-m6
    """

    card: tyro.conf.Positional[str]
    """Name of a card, a card file, or a parameter file of BAM (.json)."""
    gain: float | None = None
    """P gain other than the card's, for the PD in torque."""
    yaml: bool = False
    """Print the card's file, and nothing else: a beginning for one of your own."""
    json: Json = False

    def run(self) -> None:
        """Read the card and print it."""
        card = load_card(self.card)
        refuse_outside("--gain", self.gain, *P_GAINS)
        if self.yaml:
            return print(card.to_yaml(), end="")
        if self.json:
            return terminal.print_json(_summary(card, self.gain) | {"card": card})
        for line in _head(card):
            terminal.out.print(line)
        for name in card.specimens:
            terminal.out.print(_numbers(card, name, self.gain))
        for note in (*compare.implausible(card), *card.notes):
            for n, line in enumerate(wrap(note, _WIDTH - 2)):
                terminal.out.print(("- " if n == 0 else "  ") + line)


@dataclass(frozen=True)
class Diff:
    """Compare two servos in numbers, lag and motion: cards, calibrations, presets, other files.

    Example: pupper-sysid servo diff sts3215-bam-m1 calibrated.yaml --joint shoulder_pan

    Example: pupper-sysid servo diff calibrated.yaml robot.xml --joint LF_hip
    """

    first: tyro.conf.Positional[str]
    """A card's name or file, a parameter file of BAM, a calibration or a preset; a robot's MJCF, or
    a Python configuration, which is read and not run."""
    second: tyro.conf.Positional[str]
    """What it is compared with, alike."""
    joint: str | None = None
    """Joint of a calibration, or specimen of a card; by default the first."""
    gain: float | None = None
    """P gain of both; by default that of a servo whose numbers hold at no other, else the
    first's."""
    json: Json = False

    def run(self) -> None:
        """Read both and print a table."""
        refuse_outside("--gain", self.gain, *P_GAINS)
        comparison = compare.compared(self.first, self.second, self.joint, self.gain, _servo)
        if self.json:
            return terminal.print_json(comparison)
        columns = (
            servo.title + ("" if servo.p_gain is None else f", P {servo.p_gain:g}")
            for servo in (comparison.first, comparison.second)
        )
        terminal.print_table(
            "", "", *columns, "ratio",
            rows=(
                (f"{row.quantity} [{row.unit}]", _with_interval(row.first),
                 _with_interval(row.second), terminal.number(row.ratio, 2))
                for row in comparison.differences
            ),
        )  # fmt: skip
        for sentence in (*comparison.notes, *_verdict(comparison)):
            for line in wrap(sentence, _WIDTH):
                terminal.out.print(line)


Servo = (
    Annotated[List, tyro.conf.subcommand("list")]
    | Annotated[Show, tyro.conf.subcommand("show")]
    | Annotated[Diff, tyro.conf.subcommand("diff")]
)


def _summary(card: ServoCard, gain: float | None = None) -> dict[str, Any]:
    """What `list --json` says of a card."""
    return {
        "servo": card.servo, "supply_v": card.supply_v, "p_gain": card.gains.p,
        "published": card.published, "source": card.source, "load": card.load,
        "armature": card.armature, "default": card.default,
        "pd": {name: card.pd(name, gain) for name in card.specimens},
    }  # fmt: skip


def _head(card: ServoCard) -> list[str]:
    gains = {g.upper(): v for g, v in card.gains if v is not None}
    files = "; ".join(f"{f.name} (sha256 {f.sha256[:12]}…)" for f in card.data)
    if len(card.data) > 4:
        first, last = card.data[0].name, card.data[-1].name
        files = f"{len(card.data)} files, {first} to {last}; hashes with --yaml"
    rows: dict[str, str] = {
        "servo": card.servo + (f" ({card.sku})" if card.sku else ""),
        "set-up": ", ".join(
            [f"{_plain(card.supply_v)} V"] * (card.supply_v is not None)
            + [f"{name} {_plain(value)}" for name, value in gains.items()]
        )
        or "not stated",
        "load": card.load,
        "armature": ARMATURES[card.armature],
        "numbers": f"cited, read on {card.date}" if card.published else f"fitted on {card.date}",
        "source": card.source.title,
        "": card.source.url,
        " ": card.source.file or "",
        "  ": f"commit {card.source.commit}" if card.source.commit else "",
        "licence": card.source.licence,
        "data": files,
        "scores": "; ".join(f"{s.value:.4g} {s.unit}, {s.what}" for s in card.scores),
    }
    lines = [card.name]
    for name, text in rows.items():
        for n, line in enumerate(wrap(text, _WIDTH - 9, break_on_hyphens=False)):
            lines.append(f"{name.strip() if n == 0 else '':9}{line}")
    return lines


def _numbers(card: ServoCard, name: str, gain: float | None) -> Any:
    """Table of one specimen: as it is stated, and as a PD in torque."""
    numbers, pd = card.specimens[name], card.pd(name, gain)
    table = terminal.table(f"\n{name}" if len(card.specimens) > 1 else "", "", "value", "unit")
    models: Mapping[str, Any] = {"": pd}
    if not isinstance(numbers, TorquePD):
        p = card.gains.p if gain is None else gain
        models = {"position loop": numbers, f"as PD in torque, P {_plain(p)}": pd}
    for title, part in models.items():
        if title:
            table.add_row(title, "", "")
        for key in type(part).model_fields:
            value: Any = getattr(part, key)
            if key != "model" and value is not None:
                table.add_row(f"  {words_of(key)}", _with_interval(value), unit(key))
    return table


def _with_interval(quantity: Quantity | None) -> str:
    if quantity is None:
        return "–"
    text, low, high = f"{quantity.value:.4g}", quantity.low, quantity.high
    if low is None or high is None or low >= high:  # known without error, such as a term left out
        return text
    return f"{text} [{low:.3g}, {high:.3g}]"


def _plain(value: float | None) -> str:
    return "–" if value is None else f"{value:g}"


def _servo(source: str, part: str | None, gain: float | None) -> compare.Servo:
    """A servo of whatever file states one."""
    path = Path(source)
    if path.suffix in (".xml", ".mjcf", ".py") or _starts_as_xml(path):
        from pupper_sysid.sim.export.foreign import foreign_servo

        return foreign_servo(path, part)
    return compare.servo_of(source, part, gain)


def _starts_as_xml(path: Path) -> bool:
    """Whether a file, however named, begins as an MJCF does."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(100).lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<")


def _verdict(comparison: compare.Comparison) -> Iterator[str]:
    """The largest difference, then lags and distance of the two motions, in words."""
    known = [row for row in comparison.differences if row.ratio is not None]
    if not known:
        raise InputError("The two have no number in common.")
    most, motion = max(known, key=lambda row: row.distance), comparison.motion
    if most.distance < 0.02:
        yield "They agree within 2 % in every number that both state."
    else:
        yield (
            f"They differ most in {most.quantity}: {most.ratio:.3g} times. A dash stands "
            "where only one states a number."
        )
    yield (
        "On tones of 1, 2 and 4 Hz, 0.2 rad: lag {} and {} ms, {} mrad apart (RMS), each as it "
        "stands, with the link that it is known to move."
    ).format(*map(terminal.ms, (motion.first_lag_s, motion.second_lag_s, motion.apart_rad)))
