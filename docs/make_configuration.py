"""Write docs/configuration.md from the models that read `lab.toml`: `make gen`."""

import sys
from pathlib import Path

from hilrig_runtime.template import lab_template

PAGE = Path(__file__).with_name("configuration.md")
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
"""


def page() -> str:
    """The page's text."""
    return TEXT.format(template=lab_template())


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    sys.exit()
