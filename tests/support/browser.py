"""A page in headless Chromium: does it fit, are its pictures drawn, is the console silent?"""

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest

needs_chromium = pytest.mark.skipif(shutil.which("chromium") is None, reason="no Chromium here")

_PROBE = """<body style="margin:0">
<iframe id=f src="{page}" style="width:{width}px;height:900px;border:0"></iframe>
<pre id=o></pre><script>
f.onload = () => {{
  const d = f.contentDocument, dark = f.contentWindow.matchMedia('(prefers-color-scheme: dark)');
  o.textContent = JSON.stringify({{
    content: d.documentElement.scrollWidth, view: d.documentElement.clientWidth,
    dark: dark.matches, paper: f.contentWindow.getComputedStyle(d.body).backgroundColor,
    drawings: d.querySelectorAll('main svg.drawing').length,
    empty: [...d.querySelectorAll('main svg.drawing')].filter(
      s => !s.closest('details:not([open])') && s.getBoundingClientRect().height < 50).length,
    hides: [...d.querySelectorAll('.toggles input')].every(i => {{
      i.click();
      const part = d.querySelector('.' + i.id.replace('show-', 'part-'));
      return f.contentWindow.getComputedStyle(part).display === 'none';
    }}),
  }});
}};</script></body>"""


def looks_right(page: Path, scratch: Path, width: int, dark: bool) -> None:
    """Open `page` in a window `width` pixels wide; fail if anything is amiss."""
    probe = scratch / "probe.html"
    probe.write_text(_PROBE.format(page=page.resolve(), width=width))
    done = subprocess.run(
        [
            "chromium", "--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr",
            "--allow-file-access-from-files", "--virtual-time-budget=5000",
            "--window-size=1400,1000", f"--user-data-dir={scratch / 'profile'}",
            f"--blink-settings=preferredColorScheme={0 if dark else 1}", "--dump-dom", str(probe),
        ],
        capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    said = re.search(r'<pre id="o">(\{.*?\})</pre>', done.stdout)
    assert said, done.stdout[-500:] + done.stderr[-500:]
    found = json.loads(said.group(1).replace("&quot;", '"'))
    assert found["content"] <= found["view"] <= width
    assert found["drawings"] > 0 and found["empty"] == 0
    assert found["hides"]
    assert found["dark"] is dark
    assert (found["paper"] == "rgb(255, 255, 255)") is not dark
    assert ":CONSOLE" not in done.stderr
