"""Pages in headless Chromium: do they fit, how high are they, what does the console say?

    .venv/bin/python benchmarks/pages.py docs/_build/html report

Each `.html` file of the folders is opened in windows 375 and 1,280 pixels wide, light and dark.
Needs `chromium`. With `--shots FOLDER` each is kept as a picture, to be looked at.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import tempfile
from pathlib import Path

WIDTHS = (375, 1280)
_LEAVE_OUT = re.compile(r"genindex|search\.html|_modules|py-modindex")
_TALLEST = 12_000
_CHROMIUM = (
    "chromium", "--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr",
    "--allow-file-access-from-files", "--hide-scrollbars",
)  # fmt: skip
_PROBE = """<body style="margin:0"><div id=w></div><pre id=o></pre><script>
const pages = {pages}, widths = {widths}, found = [];
async function look() {{
  for (const page of pages) for (const width of widths) {{
    const f = document.createElement('iframe');
    f.style = 'border:0;height:900px;width:' + width + 'px';
    f.src = page;
    const loaded = new Promise(done => f.onload = done);
    w.replaceChildren(f);
    await loaded;
    await new Promise(done => setTimeout(done, 300));
    const e = f.contentDocument.documentElement;
    found.push([page, width, e.scrollWidth - e.clientWidth, e.scrollHeight,
      [...f.contentDocument.images].filter(i => i.complete && !i.naturalWidth).length]);
  }}
  o.textContent = JSON.stringify(found);
}}
look();</script></body>"""


def look(pages: list[Path], dark: bool, folder: Path) -> tuple[list[list], list[str]]:
    """Measures of each page and width, and what the console said."""
    probe = folder / "probe.html"
    probe.write_text(
        _PROBE.format(pages=json.dumps([p.as_uri() for p in pages]), widths=json.dumps(WIDTHS))
    )
    done = subprocess.run(
        [*_CHROMIUM, "--virtual-time-budget=600000", "--window-size=1400,1000",
         f"--user-data-dir={folder / 'profile'}", _mode(dark), "--dump-dom", str(probe)],
        capture_output=True, text=True, timeout=600, check=False,
    )  # fmt: skip
    said = re.search(r'<pre id="o">(\[.*?\])</pre>', done.stdout, re.DOTALL)
    if not said:
        raise SystemExit(f"Chromium gave no answer: {done.stderr[-500:]}")
    return json.loads(said.group(1)), [
        line for line in done.stderr.splitlines() if "CONSOLE" in line
    ]


def shoot(page: Path, width: int, height: int, dark: bool, out: Path, folder: Path) -> None:
    """One picture of a whole page."""
    subprocess.run(
        [*_CHROMIUM, f"--window-size={width},{min(height, _TALLEST)}", _mode(dark),
         f"--user-data-dir={folder / 'profile'}", f"--screenshot={out}", page.as_uri()],
        capture_output=True, timeout=120, check=False,
    )  # fmt: skip


def _mode(dark: bool) -> str:
    return f"--blink-settings=preferredColorScheme={0 if dark else 1}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--shots", type=Path)
    options = parser.parse_args()
    roots = {p.resolve(): f for f in options.folders for p in f.rglob("*.html")}
    pages = sorted(p for p in roots if not _LEAVE_OUT.search(str(p)))
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        light, lines = look(pages, False, folder)
        dark, more = look(pages, True, folder)
        print("| page | width | px too wide | height px | broken pictures |")
        print("|---|---|---|---|---|")
        for row, other in zip(light, dark, strict=True):
            uri, width, wide, height, broken = row
            page = next(p for p in pages if p.as_uri() == uri)
            print(
                f"| {page.relative_to(roots[page].resolve().parent)} | {width} | "
                f"{max(wide, other[2])} | {height:,} | {broken} |"
            )
            if options.shots:
                options.shots.mkdir(parents=True, exist_ok=True)
                for name, mode in (("light", False), ("dark", True)):
                    out = options.shots / f"{page.parent.name}-{page.stem}-{width}-{name}.png"
                    shoot(page, width, height, mode, out.resolve(), folder)
        print(f"\n{len(pages)} pages; lines of the console: {len(lines) + len(more)}.")
        for line in lines + more:
            print(line)


if __name__ == "__main__":
    main()
