"""A Python script in cells as a page: text, code, what the code prints, and its figures.

Cells begin with `# %%`, those of text with `# %% [markdown]`, as editors and Jupytext know them.
"""

from __future__ import annotations

import ast
import io
import re
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

_CELL = re.compile(r"^# %%(?P<kind>.*)\n", re.MULTILINE)


def page(script: Path, pictures: Path) -> str:
    """Markdown of a script that has been run; its cells share one name space.

    A figure is shown where it is drawn with pyplot, or where it is the last value of a cell.
    Figures go into the folder `pictures`, beside the page.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    pictures.mkdir(parents=True, exist_ok=True)
    names: dict[str, object] = {"__name__": script.stem}
    lines: list[str] = []
    _, *parts = _CELL.split(script.read_text())
    for number, (kind, text) in enumerate(zip(parts[::2], parts[1::2], strict=True)):
        if "[markdown]" in kind:
            lines += [re.sub(r"^# ?", "", text.strip(), flags=re.MULTILINE), ""]
            continue
        lines += ["```python", text.strip(), "```", ""]
        shown = io.StringIO()
        with redirect_stdout(shown):
            last = _run(text, str(script), names)
        if shown.getvalue().strip():
            lines += ["```text", shown.getvalue().rstrip(), "```", ""]
        figures = [plt.figure(k) for k in plt.get_fignums()]
        if hasattr(last, "savefig") and last not in figures:
            figures.append(last)
        for figure in figures:
            name = f"{script.stem}-{number}.png"
            figure.savefig(pictures / name, dpi=110, bbox_inches="tight")
            plt.close(figure)
            lines += [f"![Figure of the code above]({pictures.name}/{name})", ""]
    return "\n".join(lines)


def _run(text: str, name: str, names: dict[str, object]) -> Any:
    """Run a cell; its last value if it ends in an expression."""
    body = ast.parse(text).body
    last = body.pop() if isinstance(body[-1], ast.Expr) else None
    exec(compile(ast.Module(body, []), name, "exec"), names)
    return eval(compile(ast.Expression(last.value), name, "eval"), names) if last else None
