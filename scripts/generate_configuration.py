"""Generates docs/configuration.md from the schema of `lab.toml` (`make gen`)."""

import sys
from pathlib import Path

from hilrig_runtime.config.template import lab_template

PAGE = Path(__file__).parents[1] / "docs/configuration.md"
TEXT = """# lab.toml

A lab is configured by one file, which every service reads; without a file there is one rig with the defaults.
`hilrig check lab.toml` reports each error with its place, the accepted value and the value found. The template below is
the output of `hilrig check --template`: every key, its description and its default. Omit keys that you do not change.

```toml
{template}```

Two rigs, the second with a heavier quill, at a step of 10 ms:

```toml
name = "robotics"

[sim]
step_ms = 10

[[rigs]]
name = "left"

[[rigs]]
name = "right"
arm.masses_kg = [1.0, 1.0, 0.8]
```

A group of 64 rigs, `rig1` to `rig64` on ports 5020 to 5083, all with a shorter second link; one additional rig for the
teacher, and the seventh on its own port (so the eighth gets 5026):

```toml
name = "robotics"

[rigs]
count = 64
arm.l3_m = 0.25

[[rigs.single]]
name = "rig7"
port = 6007

[[rigs.single]]
name = "teacher"
allow = ["192.168.7.2/32"]
```

A task by which `hilrig report` grades the lab's runs (see [review.md](review.md)): two poses, then a triangle, and two
parts in the tray, all within a minute. A task may also consist of one of the three kinds only.

```toml
[task]
title = "Poses, a path, two parts"
time_limit_s = 60

[[task.poses]]
name = "left"
position_mm = [350, 200, 25]
tolerance_mm = 2
hold_s = 0.5

[[task.poses]]
name = "right"
position_mm = [350, -200, 25]
yaw_deg = 90

[task.path]
points_mm = [[300, 100, 25], [400, 100, 25], [350, 0, 25], [300, 100, 25]]
tolerance_mm = 5

[task.place]
parts = ["red", "blue"]
tolerance_mm = 2
```
"""


def page() -> str:
    """Return the page's text."""
    return TEXT.format(template=lab_template())


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    sys.exit()
