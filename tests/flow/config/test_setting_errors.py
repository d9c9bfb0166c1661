"""Errors of values that a pydantic model checks: their text, their path, and the file or option that is named."""

from __future__ import annotations

import ipaddress
from typing import Annotated, Literal

import pytest
from pydantic import Field, field_validator

from flow.config.setting_errors import check_values
from flow.config.tree import Tree
from flow.config_error import ConfigError, Location
from flow.graph import load_graph
from flow.stage import StrictModel
from tests.flow.toys import GRAPH


class Round(StrictModel):
    shape: Literal["round"] = "round"
    radius_m: float = 1.0


class Square(StrictModel):
    shape: Literal["square"] = "square"
    side_m: float = 1.0


class Drone(StrictModel):
    span_m: float = Field(0.5, gt=0)


class Toy(StrictModel):
    name: str = Field("x", pattern=r"^\w+$")
    sender: ipaddress.IPv4Address | None = None
    connection: str = ""
    size_px: int | tuple[int, int] = 1
    points: tuple[int, ...] = ()
    body: Annotated[Round | Square, Field(discriminator="shape")] = Round()
    drone: Drone | None = None

    @field_validator("connection")
    @classmethod
    def _is_known(cls, value: str) -> str:
        if value:
            raise ValueError(f"must be a, not {value!r}")
        return value


@pytest.mark.parametrize(
    ("values", "error"),
    [
        ({"name": "a b"}, r"toy.name: must match pattern '^\w+$', got 'a b'."),
        ({"sender": "foo"}, "toy.sender: is not a valid IPv4 address, got 'foo'."),
        ({"connection": "foo"}, "toy.connection: must be a, not 'foo'."),
        ({"size_px": "a"}, "toy.size_px: must be a valid integer, unable to parse string as an integer or must be a list, got 'a'."),
        ({"points": 3}, "toy.points: must be a list, got 3."),
        ({"drone": [1]}, "toy.drone: must be a mapping of settings, got [1]."),
        ({"drone": {"span_m": -1}}, "toy.drone.span_m: must be greater than 0, got -1."),
        ({"drone": {"span_m": 0}}, "toy.drone.span_m: must be greater than 0, got 0."),
        ({"drone": {"span": 1}}, "toy.drone.span: unknown setting 'span'. Did you mean 'span_m'?"),
        ({"drone": {"x": 1}}, "toy.drone.x: unknown setting 'x'. Toy.drone has 'span_m'."),
        ({"body": {"shape": "flat"}}, "toy.body: 'shape' must be 'round' or 'square', not 'flat'."),
        ({"body": {"shape": "square", "side_m": "a"}}, "toy.body.side_m: must be a valid number, unable to parse string as a number, got 'a'."),
        ([1], "toy: must be a mapping of settings."),
    ],
)  # fmt: skip
def test_the_text_and_the_path_of_an_error(values, error):
    tree = Tree(root=Location("x.yaml", 1))
    check_values(tree, ("toy",), Toy, values, "Toy")
    assert [str(found) for found in tree.errors] == [f"x.yaml:1: {error}"]


class Rig(StrictModel):
    drone: Drone | None = None


WITH_RIG = "rig:\n  drone: {span_m: 0.5}\n" + GRAPH.replace("adder", "$rig.drone.span_m").replace(
    "toys.Double\n", "toys.Double\n    config: {factor: $rig.drone.span_m}\n"
)


def errors_of(tmp_path, text: str, overlay: str = "", sets: tuple[str, ...] = ()) -> list[str]:
    (tmp_path / "x.yaml").write_text(text)
    (tmp_path / "over.yaml").write_text(overlay or "rig: {}")
    with pytest.raises(ConfigError) as caught:
        load_graph(tmp_path / "x.yaml", [tmp_path / "over.yaml"], sets, rig=Rig)
    return [str(error).replace(f"{tmp_path}/", "") for error in caught.value.errors]


@pytest.mark.parametrize(
    ("overlay", "sets", "error"),
    [
        ("", ("rig.drone.span_m=-1",), "--set rig.drone.span_m=-1: rig.drone.span_m: must be greater than 0, got -1."),
        ("", ("rig.foo=3",), "--set rig.foo=3: rig.foo: unknown setting 'foo'. rig has 'drone'."),
        ("", ("rig.drone=3",), "--set rig.drone=3: rig.drone: must be a mapping of settings, got 3."),
        ("rig:\n  drone: {span_m: .nan}", (), "over.yaml:2: rig.drone.span_m: must be a finite number, got nan."),
    ],
)
def test_a_wrong_rig_value_is_one_error_where_it_is_written(tmp_path, overlay, sets, error):
    assert errors_of(tmp_path, WITH_RIG, overlay, sets) == [error]


def test_errors_that_do_not_follow_from_the_rig_are_reported_too(tmp_path):
    text = WITH_RIG.replace("left: numbers.number", "left: numbers.nmber")
    first, second = errors_of(tmp_path, text, sets=("rig.foo=3",))
    assert first.startswith("--set rig.foo=3: rig.foo: ")
    assert second.startswith("x.yaml:12: stages.add.inputs.left: 'numbers' has no output 'nmber'.")


def test_an_error_of_a_whole_mapping_names_what_changed_it_last():
    tree = Tree(root=Location("x.yaml", 1))
    tree.locations = {("rig",): Location("x.yaml", 1), ("rig", "a"): Location("x.yaml", 2)}
    assert tree.last_location(("rig",)) == Location("x.yaml", 1)
    tree.locations["rig", "b"] = Location("--set rig.b=1", 0)
    assert tree.last_location(("rig",)) == Location("--set rig.b=1", 0)
