"""The documents: links are valid, commands exist, the README is short."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from flow.config.classes import known_classes
from links import __version__
from links.cli.app import COMMANDS

ROOT = Path(__file__).resolve().parents[1]
DOCUMENTS = sorted(
    file
    for pattern in ("*.md", "docs/**/*.md", "deploy/*.md", "recordings/*.md", "links/**/*.md")
    for file in ROOT.glob(pattern)
)
GENERATED = {"settings.md", "commands.md", "operate.md", "hosts.md", "contribute.md", "recordings.md", "changelog.md"}


def name_of(file):
    return file.relative_to(ROOT).as_posix()


@pytest.mark.parametrize("file", DOCUMENTS, ids=name_of)
def test_every_relative_link_leads_to_a_file(file):
    for target in re.findall(r"\]\(([^)\s#]+)[^)]*\)", file.read_text(encoding="utf-8")):
        if "://" not in target and Path(target).name not in GENERATED:
            assert (file.parent / target).exists(), f"{name_of(file)} links to {target}"


@pytest.mark.parametrize("file", DOCUMENTS, ids=name_of)
def test_every_command_in_a_document_exists(file):
    for command in re.findall(r"(?:^    |`|bin/)grd ([a-z]+(?:-[a-z]+)*)\b", file.read_text(encoding="utf-8"), re.M):
        assert command in COMMANDS, f"{name_of(file)} names `grd {command}`"


@pytest.mark.parametrize("file", DOCUMENTS, ids=name_of)
def test_every_test_and_benchmark_in_a_document_exists(file):
    for path in re.findall(r"\btests/[\w/]+\.py\b", file.read_text(encoding="utf-8")):
        assert (ROOT / path).is_file(), f"{name_of(file)} names {path}"


@pytest.mark.parametrize("file", DOCUMENTS, ids=name_of)
def test_every_configuration_in_a_document_exists(file):
    made = {
        "configs/mine.yaml",
        "configs/rigs/mine.yaml",
        "configs/rigs/os1_beams.yaml",
        "configs/rigs/xt32_beams.yaml",
        "configs/rigs/vehicle_lens.yaml",
        "configs/rigs/drone_lens.yaml",
    }
    for path in re.findall(r"\bconfigs/[\w/]+\.yaml\b", file.read_text(encoding="utf-8")):
        assert path in made or (ROOT / path).is_file(), f"{name_of(file)} names {path}"


def named_in(reference: str) -> set[str]:
    return set(re.findall(r"^::: (\S+)$", (ROOT / "docs/reference" / reference).read_text(encoding="utf-8"), re.M))


def test_the_reference_has_every_stage():
    known = {f"{stage.__module__}.{stage.__qualname__}" for stage in known_classes("stages").values()}
    assert named_in("stages.md") == known | {"stages.track.imm_track.ImmPdafTrack"}  # known with its libraries only


def test_the_reference_has_every_module_of_messages():
    modules = {file.stem for file in (ROOT / "stages/messages").glob("*.py")} - {"__init__"}
    assert named_in("messages.md") == {f"stages.messages.{module}" for module in modules}


def test_the_readme_fits_a_page_and_its_lines_a_screen():
    lines = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    assert len(lines) <= 170
    assert [line for line in lines if len(line) > 120] == []


def test_prose_of_guides_fits_a_screen():
    """Tables, code and images may be wider."""
    for file in [*(ROOT / "docs" / "how-to").glob("*.md"), *(ROOT / "deploy").glob("*.md")]:
        lines = file.read_text(encoding="utf-8").splitlines()
        long = [line for line in lines if len(line) > 120 and not line.startswith(("|", "    ", "!["))]
        assert long == [], name_of(file)


def test_the_changelog_has_the_released_version():
    assert f"## [{__version__}]" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
