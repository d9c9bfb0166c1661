"""The house keeps its shape: data flows one way, stages touch nothing outside, the top level is fixed, files stay true."""

from __future__ import annotations

import ast
import importlib
import json
import subprocess
from pathlib import Path

import pytest

from flow.config.classes import known_classes
from flow.config.schema import schema
from flow.graph import load_graph

ROOT = Path(__file__).resolve().parents[1]
ROOMS = {"flow": {"flow"}, "stages": {"flow", "stages"}, "links": {"flow", "stages", "links"}}
BASES = {"flow.message", "flow.stage", "flow.compile_cache"}  # what a stage may use of the engine
OUTSIDE = {
    "threading",
    "multiprocessing",
    "socket",
    "subprocess",
    "asyncio",
    "time",
    "os",
    "pathlib",
    "io",
    "random",
    "logging",
}
TOP_LEVEL = {"flow", "stages", "links", "configs", "deploy", "docs", "recordings", "tests"}


def imports_of(file: Path) -> set[str]:
    """Names of the modules that a file imports; `from package import module` is the module."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}: imports are written in full"
            inside = ROOT / (node.module or "").replace(".", "/")
            for alias in node.names:
                is_module = (inside / f"{alias.name}.py").is_file() or (inside / alias.name / "__init__.py").is_file()
                found.add(f"{node.module}.{alias.name}" if is_module else node.module or "")
    return found


def sources(room: str) -> list[Path]:
    return sorted((ROOT / room).rglob("*.py"))


@pytest.mark.parametrize("room", ROOMS)
def test_a_room_imports_only_what_lies_before_it(room):
    for file in sources(room):
        ours = {name for name in imports_of(file) if name.split(".")[0] in ROOMS}
        allowed = {name for name in ours if name.split(".")[0] in ROOMS[room]}
        assert ours == allowed, f"{file.relative_to(ROOT)} imports {sorted(ours - allowed)}"
        if room == "stages":
            engine = {name for name in ours if name.startswith("flow")}
            assert engine <= BASES, f"{file.relative_to(ROOT)} imports {sorted(engine - BASES)}"


def test_a_stage_has_no_clock_thread_socket_or_file():
    for file in sources("stages"):
        outside = {name for name in imports_of(file) if name.split(".")[0] in OUTSIDE}
        assert not outside, f"{file.relative_to(ROOT)} imports {sorted(outside)}"
        calls = {
            n.func.id
            for n in ast.walk(ast.parse(file.read_text()))
            if isinstance(n, ast.Call) and isinstance(n.func, ast.Name)
        }
        assert not calls & {"open", "print", "input", "eval", "exec"}, file


def test_no_room_imports_in_a_circle():
    """No two files of the product import each other, directly or through others."""
    modules = {
        ".".join(f.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): f
        for r in ROOMS
        for f in sources(r)
    }
    edges = {name: {i for i in imports_of(file) if i in modules and i != name} for name, file in modules.items()}
    state: dict[str, int] = {}

    def visit(name: str, way: tuple[str, ...]) -> None:
        assert state.get(name) != 1, f"circle: {' -> '.join((*way[way.index(name) :], name))}"
        if state.get(name) == 2:
            return
        state[name] = 1
        for following in sorted(edges[name]):
            visit(following, (*way, name))
        state[name] = 2

    for name in modules:
        visit(name, ())


def test_truth_is_read_only_where_runs_are_judged_or_made():
    readers = {
        str(f.relative_to(ROOT)) for r in ROOMS for f in sources(r) if "/truth/" in f.read_text(encoding="utf-8")
    }
    allowed = ("links/runs/truth.py", "links/recording/", "links/simulated/")
    assert all(name.startswith(allowed) for name in readers), readers


def test_the_top_level_is_fixed():
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode or not listed.stdout:
        pytest.skip("not a git checkout")
    folders = {line.split("/")[0] for line in listed.stdout.splitlines() if "/" in line and not line.startswith(".")}
    assert folders == TOP_LEVEL


def test_every_committed_recording_and_all_of_them_are_small():
    sizes = {file.name: file.stat().st_size for file in (ROOT / "recordings").glob("*.mcap")}
    assert sizes
    assert sum(sizes.values()) < 40_000_000
    assert sizes["street_sweep.mcap"] <= 3_000_000


def test_the_committed_schema_is_the_one_the_code_gives():
    committed = json.loads((ROOT / "configs" / "grd.schema.json").read_text(encoding="utf-8"))
    assert committed == json.loads(json.dumps(schema())), "run: grd schema -o configs/grd.schema.json"


CONFIGS = sorted(f for f in (ROOT / "configs").glob("*.yaml"))


@pytest.mark.parametrize("config", CONFIGS, ids=lambda f: f.name)
def test_every_configuration_is_without_problems_and_names_its_schema(config):
    load_graph(config)
    first = config.read_text(encoding="utf-8").splitlines()[0]
    assert first == "# yaml-language-server: $schema=grd.schema.json"


def test_the_readme_and_ci_run_the_same_test_command():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    ci = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    command = next(line.strip() for line in readme.splitlines() if "-m pytest" in line)
    assert command in ci


def test_each_class_that_an_error_suggests_can_be_used() -> None:
    """A tap that a package keeps to itself is none to be put into a configuration."""
    for kind in ("stages", "links"):
        for use in known_classes(kind):
            module, _, name = use.rpartition(".")
            assert hasattr(importlib.import_module(module), name), use
