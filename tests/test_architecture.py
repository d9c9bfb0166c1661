"""Architecture rules: import directions, pure stages, numba in kernels only, folder and file sizes, committed files."""

from __future__ import annotations

import ast
import importlib
import json
import re
import subprocess
from collections import Counter
from pathlib import Path

import pytest

from flow.config.classes import known_classes
from flow.config.schema import schema
from links.runs.request import RunRequest
from stages.geometry.rig import Rig

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = {"flow": {"flow"}, "stages": {"flow", "stages"}, "links": {"flow", "stages", "links"}}
BASES = {
    "flow.message",
    "flow.stage",
    "flow.counters",
    "flow.compile_cache",
}  # modules of the engine that a stage may import
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
MAX_FILES, MIN_LINES, MAX_FUNCTION = 15, 25, 60
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


def sources(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


@pytest.mark.parametrize("package", PACKAGES)
def test_a_package_imports_only_packages_below_it(package):
    for file in sources(package):
        own = {name for name in imports_of(file) if name.split(".")[0] in PACKAGES}
        allowed = {name for name in own if name.split(".")[0] in PACKAGES[package]}
        assert own == allowed, f"{file.relative_to(ROOT)} imports {sorted(own - allowed)}"
        if package == "stages":
            engine = {name for name in own if name.startswith("flow")}
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


def test_there_are_no_import_cycles():
    """No two modules of the product import each other, directly or through others."""
    modules = {
        ".".join(f.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): f
        for package in PACKAGES
        for f in sources(package)
    }
    edges = {name: {i for i in imports_of(file) if i in modules and i != name} for name, file in modules.items()}
    state: dict[str, int] = {}

    def visit(name: str, path: tuple[str, ...]) -> None:
        assert state.get(name) != 1, f"cycle: {' -> '.join((*path[path.index(name) :], name))}"
        if state.get(name) == 2:
            return
        state[name] = 1
        for following in sorted(edges[name]):
            visit(following, (*path, name))
        state[name] = 2

    for name in modules:
        visit(name, ())


def test_only_the_evaluation_of_runs_and_the_simulator_read_the_truth():
    readers = {
        str(f.relative_to(ROOT))
        for package in PACKAGES
        for f in sources(package)
        if "/truth/" in f.read_text(encoding="utf-8")
    }
    allowed = ("links/runs/truth.py", "links/recording/", "links/simulated/")
    assert all(name.startswith(allowed) for name in readers), readers


def test_numba_is_used_in_kernels_only():
    for package in PACKAGES:
        for file in sources(package):
            compiles = any(i.split(".")[0] == "numba" or i.endswith("kernels.compiled") for i in imports_of(file))
            assert not compiles or "kernels" in file.parts, file


def test_folders_have_at_most_15_files_and_files_at_least_25_lines():
    files = [file for package in PACKAGES for file in sources(package)]
    counts = Counter(str(file.parent.relative_to(ROOT)) for file in files)
    large = {folder for folder, count in counts.items() if count > MAX_FILES}
    assert not large, f"over {MAX_FILES} Python files: {sorted(large)}"
    small = {
        str(file.relative_to(ROOT))
        for file in files
        if file.name != "__init__.py" and len(file.read_text(encoding="utf-8").splitlines()) < MIN_LINES
    }
    assert not small, f"under {MIN_LINES} lines: {sorted(small)}"


def test_functions_outside_compiled_code_have_at_most_60_lines():
    for package in PACKAGES:
        for file in sources(package):
            if "kernels" in file.parts:
                continue
            for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
                if isinstance(node, ast.FunctionDef):
                    lines = (node.end_lineno or 0) - node.lineno + 1
                    assert lines <= MAX_FUNCTION, f"{file}:{node.lineno}: {node.name} has {lines} lines"


def test_the_top_level_is_fixed():
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode or not listed.stdout:
        pytest.skip("not a git checkout")
    folders = {line.split("/")[0] for line in listed.stdout.splitlines() if "/" in line and not line.startswith(".")}
    assert folders == TOP_LEVEL


def test_the_committed_recordings_are_small():
    sizes = {file.name: file.stat().st_size for file in (ROOT / "recordings").glob("*.mcap")}
    assert sizes
    assert (
        sum(sizes.values()) < 60_000_000
    )  # 30 s of all sensors at 5 Hz images, and each experiment until its pose is known
    assert sizes["street_sweep.mcap"] <= 3_000_000


def test_the_committed_schema_matches_the_code():
    committed = json.loads((ROOT / "configs" / "grd.schema.json").read_text(encoding="utf-8"))
    assert committed == json.loads(json.dumps(schema(Rig))), "run: grd schema -o configs/grd.schema.json"


CONFIGS = sorted(f for f in (ROOT / "configs").glob("*.yaml"))
OF_AN_EXTRA = {"baseline_imm.yaml": ("stonesoup", "sklearn")}


@pytest.mark.parametrize("config", CONFIGS, ids=lambda f: f.name)
def test_every_configuration_is_valid_and_names_its_schema(config):
    for package in OF_AN_EXTRA.get(config.name, ()):
        pytest.importorskip(package)
    RunRequest(config).graph()
    first = config.read_text(encoding="utf-8").splitlines()[0]
    assert first == "# yaml-language-server: $schema=grd.schema.json"


def test_ci_runs_the_two_commands_of_the_readme():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    ci = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    commands = [line.strip() for line in readme.splitlines() if line.strip().startswith("python3 -m venv")]
    assert len(commands) == 2
    assert all(command in ci for command in commands)


def test_each_class_that_an_error_suggests_can_be_imported() -> None:
    """A private tap of a package is no class for a configuration."""
    for kind in ("stages", "links"):
        for use in known_classes(kind):
            module, _, name = use.rpartition(".")
            assert hasattr(importlib.import_module(module), name), use


def test_every_message_type_has_its_own_schema_number():
    numbers = Counter(
        number
        for package in PACKAGES
        for file in sources(package)
        for number in re.findall(r"^@message\(schema=(\d+)\)", file.read_text(encoding="utf-8"), re.MULTILINE)
    )
    assert len(numbers) > 20
    assert not [number for number, count in numbers.items() if count > 1]
