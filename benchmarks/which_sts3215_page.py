"""Tables, file and picture of which_sts3215.py."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pupper_sysid.servo_models.cards.card import ServoCard

HERE = Path(__file__).resolve().parent
PAGE = HERE.parent / "docs" / "which_sts3215.md"
PICTURE = HERE.parent / "docs" / "pictures" / "which_sts3215.png"
FILE = HERE / "which_sts3215.json"
OURS = "pupper-sysid"
MOTIONS = {
    "frequency_sweep": "frequency sweep", "prbs_excitation": "PRBS after 40 s",
    "step_response": "steps after 40 s", "chirp_sweep": "chirp after 40 s",
}  # fmt: skip
COLOURS = ("#4477aa", "#66ccee", "#ccbb44", "#ee6677", "#aa3377", "#228833")


def publish(found: dict[str, Any], write: bool = True) -> None:
    """Print the tables and, if asked, write file, page and picture."""
    made = {name: table(found["joints"]) for name, table in TABLES.items()}
    for lines in made.values():
        print("\n".join(lines), end="\n\n")
    if not write:
        return
    FILE.write_text(json.dumps(found | {"tables": made}, indent=1) + "\n")
    picture(found["joints"])
    text = PAGE.read_text()
    for name, lines in made.items():
        text = filled(text, name, lines)
    PAGE.write_text(text)


def numbers_hash(card: ServoCard) -> str:
    """SHA-256 of a card's numbers."""
    numbers = card.model_dump(mode="json")["specimens"]
    return hashlib.sha256(json.dumps(numbers, sort_keys=True).encode()).hexdigest()


def filled(page: str, name: str, lines: list[str]) -> str:
    """A page with the table between its two marks replaced."""
    begin, end = f"<!-- table {name} -->\n", "<!-- end -->"
    before, rest = page.split(begin)
    return f"{before}{begin}\n" + "\n".join(lines) + f"\n\n{end}" + rest.split(end, 1)[1]


def mean(joints: Mapping[str, Any], pick: Callable[[Any], Any]) -> np.ndarray:
    """Mean of something over joints."""
    return np.mean([pick(j) for j in joints.values()], axis=0)


def by_motion(joints: Mapping[str, Any], pick: Callable[[Any], Mapping[str, float]]) -> np.ndarray:
    """Mean over joints of the errors of each motion."""
    return mean(joints, lambda j: [pick(j)[m] for m in MOTIONS])


def _lines(head: list[str], rows: list[list[str]]) -> list[str]:
    return [f"| {' | '.join(r)} |" for r in (head, ["---"] * len(head), *rows)]


def _models(joints: Mapping[str, Any]) -> list[str]:
    return list(next(iter(joints.values()))["models"])


def errors(joints: Mapping[str, Any]) -> list[str]:
    """Error of each model on each motion, mean of joints."""
    rows = [("the command itself", by_motion(joints, lambda j: j["command"]))]
    for name in _models(joints):
        rows.append((name, by_motion(joints, lambda j, n=name: j["models"][n]["errors"])))
    rows.append((f"{OURS}, set-point not limited", by_motion(joints, lambda j: j["without ramp"])))
    return _lines(
        ["RMS, mrad", *MOTIONS.values(), "mean"],
        [[name, *(f"{v:.1f}" for v in own), f"{np.mean(own):.1f}"] for name, own in rows],
    )


def by_joint(joints: Mapping[str, Any]) -> list[str]:
    """Error of each model on `frequency_sweep`, by joint."""
    rows = []
    for name in _models(joints):
        own = [j["models"][name]["errors"]["frequency_sweep"] for j in joints.values()]
        rows.append([name, *(f"{v:.1f}" for v in own)])
    return _lines(["frequency sweep, RMS, mrad", *joints], rows)


def slow(joints: Mapping[str, Any]) -> list[str]:
    """Lag per speed and dead band in slow motion, dead time; shift and gain on the whole sweep."""
    lag, band = mean(joints, lambda j: j["robot"])
    rows = [["the robot", f"{lag:.0f}", f"{band:.1f}", *["–"] * 4]]
    for name in _models(joints):
        lag, band = mean(joints, lambda j, n=name: j["models"][n]["slow"])
        shift, shifted, gain, both = mean(joints, lambda j, n=name: j["models"][n]["shift"])
        dead = mean(joints, lambda j, n=name: j["models"][n]["dead time"])
        whole = mean(joints, lambda j, n=name: j["models"][n]["errors"]["frequency_sweep"])
        rows.append(
            [name, f"{lag:.0f}", f"{band:.1f}", f"{dead:.0f}", f"{whole:.1f}",
             f"{shifted:.1f} ({shift:+.0f} ms)", f"{both:.1f} ({gain:.2f})"]
        )  # fmt: skip
    return _lines(
        ["", "lag per speed, ms", "dead band, mrad", "dead time, ms", "error, mrad",
         "best shift", "and best gain"],
        rows,
    )  # fmt: skip


def exchange(joints: Mapping[str, Any]) -> list[str]:
    """Mean error with one term exchanged for ours."""
    names = [n for n in _models(joints) if n != OURS]
    terms = [t for t in next(iter(joints.values()))["models"][names[0]]["terms"] if "best" not in t]
    rows = []
    for name in names:
        own = [float(np.mean(by_motion(joints, lambda j, n=name: j["models"][n]["errors"])))]
        for term in terms:
            found = by_motion(joints, lambda j, n=name, t=term: j["models"][n]["terms"][t])
            own.append(float(np.mean(found)))
        ratio = mean(
            joints,
            lambda j, n=name: np.log(
                j["models"][n]["terms"]["best stiffness"] / j["models"][n]["stiffness"]
            ),
        )
        rows.append([name, *(f"{v:.1f}" for v in own), f"{np.exp(ratio):.2f}"])
    heads = ["stiffness fitted" if t == "stiffness" else t for t in terms]
    return _lines(["mean error, mrad", "as published", *heads, "best stiffness over its own"], rows)


TABLES: dict[str, Callable[[Mapping[str, Any]], list[str]]] = {
    "errors": errors, "joints": by_joint, "slow": slow, "exchange": exchange,
}  # fmt: skip


def picture(joints: Mapping[str, Any]) -> None:
    """Errors by motion, slow motion, and one jump."""
    from matplotlib.figure import Figure

    drawn = Figure(figsize=(11, 4.2), layout="constrained")
    first, second, third = drawn.subplots(1, 3)
    names = _models(joints)
    for n, (name, colour) in enumerate(zip(names, COLOURS, strict=True)):
        own = by_motion(joints, lambda j, m=name: j["models"][m]["errors"])
        first.plot(own, np.arange(len(MOTIONS)) + 0.08 * (n - 2.5), "o", color=colour, label=name)
        lags = np.array([j["models"][name]["slow"] for j in joints.values()])
        second.plot(*lags.T, "o", color=colour, ms=5)
    second.plot(*np.array([j["robot"] for j in joints.values()]).T, "k+", ms=10, label="robot")
    first.set_xscale("log")
    first.set_xticks([5, 10, 20, 50], ["5", "10", "20", "50"])
    first.minorticks_off()
    first.set_yticks(range(len(MOTIONS)), list(MOTIONS.values()))
    first.invert_yaxis()
    first.set_xlabel("RMS error, mean of joints [mrad]")
    first.grid(axis="x", which="both", lw=0.3)
    second.set_xlabel("lag per speed in slow motion [ms]")
    second.set_ylabel("dead band [mrad]")
    second.legend(fontsize="small")
    jump = next(j["jump"] for j in joints.values() if j["jump"])
    time = 1e3 * np.array(jump["time"])
    third.step(time, jump["command"], color="0.6", where="post", label="command")
    for name, colour in zip(names, COLOURS, strict=True):
        third.plot(time, jump["models"][name], color=colour, lw=1.2)
    third.plot(time, jump["reading"], "k+", ms=6, label="readings")
    third.set_xlabel("time after a jump of the wrist roll [ms]")
    third.set_ylabel("position [rad]")
    third.legend(fontsize="small")
    drawn.legend(
        *first.get_legend_handles_labels(), loc="outside lower center", ncols=len(names),
        fontsize="small",
    )  # fmt: skip
    drawn.savefig(PICTURE, dpi=130)
