"""Writes docs/configuration.md from the configuration models of `lab.toml`; run by `make gen`."""

import sys
from pathlib import Path

from hilrig_runtime.config.template import lab_template

PAGE = Path(__file__).parents[1] / "docs/configuration.md"
TEXT = """# lab.toml

One file describes a lab; every service reads it. Without a file, a lab has one rig with the default settings.
`hilrig check lab.toml` reports each error with its place, the value found and the accepted values. The following is the
output of `hilrig check --template`: every key, its meaning and its default. Omit the keys that you do not change.

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

64 rigs for a class, `rig1` to `rig64` at ports 5020 to 5083, all with a shorter second link; an additional rig for the
teacher, and rig7 at another port (so that rig8 gets port 5026):

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

A class ([classroom.md](classroom.md)): rigs are claimed with codes by the students of a roster.

```toml
[classroom]
roster = "roster.csv"
claims = "claims"
```

A task that `hilrig report` uses to grade the runs of the lab (see [review.md](review.md)): two poses, then a triangle,
and two parts in the tray, all within one minute. A task needs at least one of these three kinds of goals.

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
    """Return the text of the page."""
    return TEXT.format(template=lab_template())


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    sys.exit()
