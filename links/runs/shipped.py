"""The configurations and recordings that come with grd, found from any folder.

In the repository and in an installed wheel `configs/` and `recordings/` are next to the package `links`.

Source: ours.
"""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
CONFIGS, RECORDINGS = ROOT / "configs", ROOT / "recordings"
SCENARIOS = CONFIGS / "scenarios"
FOLDERS = {CONFIGS: ".yaml", RECORDINGS: ".mcap"}


def shipped(path: Path) -> Path:
    """`path` where it exists; otherwise the configuration or recording of that name that comes with grd, or `path`.

    `configs/quickstart.yaml`, `quickstart.yaml` and `quickstart` name the same file, as `street_sweep` names a
    recording.
    """
    return _shipped(path, FOLDERS)


def shipped_scenario(path: Path) -> Path:
    """The same for a scenario."""
    return _shipped(path, {SCENARIOS: ".yaml", CONFIGS: ".yaml"})


def _shipped(path: Path, folders: dict[Path, str]) -> Path:
    if path.exists() or path.is_absolute() or ".." in path.parts or path.suffix not in ("", ".yaml", ".mcap"):
        return path
    inside = [ROOT / path] if path.parts[0] in ("configs", "recordings") else [folder / path for folder in folders]
    if not path.suffix:
        inside += [folder / f"{path}{suffix}" for folder, suffix in folders.items()]
    return next((file for file in inside if file.is_file()), path)


def shipped_option(path: Path | None) -> Path | None:
    """The same for an option that may be left out."""
    return None if path is None else shipped(path)


def shipped_all(paths: list[Path] | None) -> list[Path] | None:
    """The same for an option that may be repeated."""
    return None if paths is None else [shipped(path) for path in paths]


def shipped_scenarios(paths: list[Path]) -> list[Path]:
    """The same for several scenarios."""
    return [shipped_scenario(path) for path in paths]
