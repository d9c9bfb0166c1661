"""How many numbers of the detector are set by hand; the weights file of `grd train-detector` is none of them."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
NO_CHOICE = {0, 1, 2, 3, 0.5, 100, 500, 1e3, 1e6, 1e9, 1e-3, 1e-9, 1e-12, 1e18}  # counts, units, limits of arithmetic
MOST = {"stages/detect": 111, "stages/kernels/detect": 94}


def hand_set(text: str) -> list[float]:
    """Numeric literals outside indices that are neither counts nor factors of units."""
    tree = ast.parse(text)
    indices = {id(n) for s in ast.walk(tree) if isinstance(s, ast.Subscript) for n in ast.walk(s.slice)}
    numbers = [n.value for n in ast.walk(tree) if isinstance(n, ast.Constant) and id(n) not in indices]
    return [n for n in numbers if isinstance(n, int | float) and not isinstance(n, bool) and n not in NO_CHOICE]


def test_a_number_in_an_index_a_count_or_a_unit_is_none():
    assert hand_set("A_M = 4.5\nx = y[7:9] + 1e-9 * 2 * b\nz = min(0.7, True)\n") == [4.5, 0.7]


@pytest.mark.parametrize("folder", MOST)
def test_the_hand_set_numbers_of_the_detector_are_few(folder):
    counts = {file.name: len(hand_set(file.read_text())) for file in sorted((ROOT / folder).rglob("*.py"))}
    assert sum(counts.values()) <= MOST[folder], counts
