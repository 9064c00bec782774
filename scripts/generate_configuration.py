"""Write docs/configuration.md from the models that read `lab.toml`: `make gen`."""

import sys
from pathlib import Path

from hilrig_runtime.config.template import lab_template

PAGE = Path(__file__).parents[1] / "docs/configuration.md"
TEXT = """# lab.toml

A lab is described by one file, which every service reads; with no file there is one rig with the defaults. A mistake
is named with its place, what was expected and what was found: `hilrig check lab.toml`. What follows is what
`hilrig check --template` prints: every key, its meaning and its default. Leave out what you do not change.

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

A class of 64 rigs, `rig1` to `rig64` at ports 5020 to 5083, all with a shorter second link; the teacher's own beside
them, and the seventh at a port of its own (which frees 5026 for the eighth):

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

A task, by which `hilrig report` grades the lab's runs ([review.md](review.md) says how): two poses, then a triangle,
and two parts in the tray, all within a minute. Any one of the three kinds is a task too.

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
    """The page's text."""
    return TEXT.format(template=lab_template())


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    sys.exit()
