"""README's first picture: a walking robot beside the report on the servos of `make demo`.

Made by::

    make demo
    .venv/bin/pupper-play data/samples/policies/lstm --seconds 3 --video walk.mp4
    .venv/bin/python docs/first_picture.py walk.mp4 demo/report docs/pictures/robot_and_report.png
"""

from __future__ import annotations

import sys
from pathlib import Path

_SECONDS = 1.2  # into the walk
_AROUND_ROBOT = (410, 230, 890, 590)  # left, upper, right, lower [pixels of 1280 x 720]
_HEIGHT, _MARGIN = 540, 24  # pixels


def picture(video: Path, report: Path):
    """Draw the robot of `video` and the lag budget of the folder `report` side by side."""
    import imageio.v3 as imageio
    from PIL import Image

    rate = imageio.immeta(video)["fps"]
    frame = Image.fromarray(imageio.imread(video, index=round(_SECONDS * rate)))
    sides = [frame.crop(_AROUND_ROBOT), Image.open(report / "figures/lag_budget.png")]
    sides = [
        side.convert("RGB").resize((round(side.width * _HEIGHT / side.height), _HEIGHT))
        for side in sides
    ]
    width = sum(side.width for side in sides) + 3 * _MARGIN
    page = Image.new("RGB", (width, _HEIGHT + 2 * _MARGIN), "white")
    at = _MARGIN
    for side in sides:
        page.paste(side, (at, _MARGIN))
        at += side.width + _MARGIN
    return page


if __name__ == "__main__":
    video, report, out = map(Path, sys.argv[1:])
    # a few hundred colours: a third of the bytes
    picture(video, report).quantize(256).save(out, optimize=True)
