"""Files about the project: citation, notice, security policy, continuous integration; each agrees with its source."""

import re
import tomllib
from pathlib import Path

import yaml

ROOT = Path(__file__).parents[2]
COMPOSE = [ROOT / "compose.yaml", ROOT / "compose/secure.yaml"]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_citation_names_version_license_and_paper() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["cff-version"] == "1.2.0"
    assert citation["authors"] == [{"name": "The hilrig authors"}]
    assert citation["version"] == PROJECT["version"]
    assert citation["license"] == PROJECT["license"]
    (paper,) = citation["references"]
    assert f"https://doi.org/{paper['doi']}" in (ROOT / "README.md").read_text()


def test_version_and_date_are_those_of_the_newest_release() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    releases = re.findall(r"^## \[(\d+\.\d+\.\d+)\] - (\d{4}-\d\d-\d\d)$", (ROOT / "CHANGELOG.md").read_text(), re.M)
    assert releases[0] == (PROJECT["version"], str(citation["date-released"]))
    images = {service["image"] for file in COMPOSE for service in yaml.safe_load(file.read_text())["services"].values()}
    assert images == {f"hilrig:{PROJECT['version']}"}


def test_notice_names_vendored_files() -> None:
    notice = (ROOT / "NOTICE").read_text()
    (vendor,) = re.findall(r"in (tools/\S+);", notice)
    assert (ROOT / vendor / "VENDOR.toml").exists()
    assert {"LICENSE", "NOTICE"} == set(PROJECT["license-files"])


def test_workflow_runs_the_same_command_as_ci() -> None:
    (job,) = yaml.safe_load((ROOT / ".github/workflows/ci.yml").read_text())["jobs"].values()
    commands = [step["run"] for step in job["steps"] if "run" in step]
    assert commands == [".ci/run"]
    lowest, highest = job["strategy"]["matrix"]["python"]
    assert f">={lowest}" == PROJECT["requires-python"]
    versions = [line.rpartition(" ")[2] for line in PROJECT["classifiers"] if "Python :: 3." in line]
    assert (versions[0], versions[-1]) == (lowest, highest)


def test_commit_hooks_run_commands_of_make_check() -> None:
    (repo,) = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"]
    recipe = (ROOT / "Makefile").read_text().replace("$(BIN)", ".venv/bin")
    assert [hook["entry"] for hook in repo["hooks"] if hook["entry"] not in recipe] == []


def test_address_of_the_project_is_not_invented() -> None:
    # No public address exists yet: a link that leads nowhere is worse than none.
    assert "urls" not in PROJECT
    assert "authors" not in PROJECT or PROJECT["authors"] == [{"name": "The hilrig authors"}]
