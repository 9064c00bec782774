"""The guides of `docs/controllers`: their programs and commands, as a reader copies them."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
GUIDES = ROOT / "docs/controllers"
EXAMPLES = ROOT / "examples"
_PORT = "5020"


def write_programs(guide: str, folder: Path, port: int) -> None:
    """Write the programs of a guide ("Save as `name`:") for the rig at this port, and copy the examples that it names.

    A folder of examples is copied under the name that the guide gives it ("`examples/folder/` to `name`").
    """
    text = (GUIDES / f"{guide}.md").read_text(encoding="utf-8")
    for name, program in re.findall(r"Save as `([^`]+)`[^\n]*:\n\n```\w*\n(.*?)```", text, re.DOTALL):
        (folder / name).write_text(program.replace(_PORT, str(port)), encoding="utf-8")
    for name in re.findall(r"`examples/([\w./-]+\.\w+)`", text):
        _copy(EXAMPLES / name, folder / Path(name).name, port)
    for name, target in re.findall(r"`examples/(\w+)/` to `(\w+)`", text):
        for source in filter(Path.is_file, (EXAMPLES / name).rglob("*")):
            _copy(source, folder / target / source.relative_to(EXAMPLES / name), port)


def _copy(source: Path, target: Path, port: int) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_text(source.read_text(encoding="utf-8").replace(_PORT, str(port)), encoding="utf-8")


def commands(guide: str, port: int) -> list[str]:
    """Return the command lines of a guide, without those that need root."""
    text = (GUIDES / f"{guide}.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```console\n(.*?)```", text, re.DOTALL)
    lines = [line for block in blocks for line in block.splitlines()]
    return [line.replace(_PORT, str(port)) for line in lines if not line.startswith("sudo ")]
