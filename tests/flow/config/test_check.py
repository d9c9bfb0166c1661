"""Every kind of configuration error: its text, line and suggestion, pinned."""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path

import pytest

from flow.config.classes import EXTRAS, known_classes
from flow.config_error import ConfigError
from flow.graph import Graph, load_graph
from tests.flow.toys import GRAPH


def errors_of(tmp_path: Path, text: str, **kwargs) -> list[str]:
    file = tmp_path / "x.yaml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        load_graph(file, **kwargs)
    return [str(p).replace(f"{tmp_path}/", "") for p in caught.value.errors]


def only_error(tmp_path: Path, text: str, **kwargs) -> str:
    (error,) = errors_of(tmp_path, text, **kwargs)
    return error


def test_a_valid_graph_has_no_errors_and_ranks_producers_first(tmp_path):
    (tmp_path / "x.yaml").write_text(GRAPH)
    graph = load_graph(tmp_path / "x.yaml")
    assert list(graph.nodes) == ["numbers", "double", "add"]
    assert [(e.producer, e.output, e.consumer, e.port) for e in graph.edges] == [
        ("numbers", "number", "double", "number"),
        ("numbers", "number", "add", "left"),
        ("double", "number", "add", "right"),
    ]


CASES = {
    "unknown stage": (
        ("tests.flow.toys.Double", "stages.detct.KernelDetect"),
        "x.yaml:3: stages.double.use: unknown stage 'stages.detct.KernelDetect'. Did you mean 'stages.detect.KernelDetect'?",
    ),
    "unknown class in a known module": (
        ("tests.flow.toys.Double", "tests.flow.toys.Dubble"),
        "x.yaml:3: stages.double.use: unknown stage 'tests.flow.toys.Dubble'.",
    ),
    "no import path": (
        ("tests.flow.toys.Double", "Double"),
        "x.yaml:3: stages.double.use: must name a class as module.Class, got 'Double'.",
    ),
    "a link under stages": (
        ("use: tests.flow.toys.Double", "use: tests.flow.toys.Printer"),
        "x.yaml:3: stages.double.use: 'tests.flow.toys.Printer' is no stage; it belongs under 'links:'.",
    ),
    "no stage at all": (
        ("use: tests.flow.toys.Double", "use: tests.flow.toys.Number"),
        "x.yaml:3: stages.double.use: 'tests.flow.toys.Number' is no stage.",
    ),
    "a class written wrongly": (
        ("use: tests.flow.toys.Double", "use: tests.flow.toys.Untyped"),
        "x.yaml:3: stages.double.use: 'tests.flow.toys.Untyped' is not written as a stage must be: "
        "Untyped.on_number: a port takes one annotated message.",
    ),
    "missing use": (
        ("    use: tests.flow.toys.Double\n", ""),
        "x.yaml:2: stages.double.use: is missing.",
    ),
    "unknown setting": (
        ("{name: adder}", "{name: adder, windw: 4}"),
        "x.yaml:7: stages.add.config.windw: unknown setting 'windw'. Did you mean 'window'?",
    ),
    "unknown setting, nothing near": (
        ("{name: adder}", "{name: adder, colour: red}"),
        "x.yaml:7: stages.add.config.colour: unknown setting 'colour'. Add has 'window' or 'name'.",
    ),
    "wrong type": (
        ("{name: adder}", "{name: adder, window: many}"),
        "x.yaml:7: stages.add.config.window: must be a valid integer, unable to parse string as an integer, got 'many'.",
    ),
    "out of range": (
        ("{name: adder}", "{name: adder, window: 0}"),
        "x.yaml:7: stages.add.config.window: must be greater than or equal to 1, got 0.",
    ),
    "missing setting": (
        ("    config: {name: adder}\n", ""),
        "x.yaml:5: stages.add.config.name: is missing and has no default.",
    ),
    "settings that are no mapping": (
        ("{name: adder}", "[adder]"),
        "x.yaml:7: stages.add.config: must be a mapping of settings.",
    ),
    "unknown key": (
        ("inputs: {number", "input: {number"),
        "x.yaml:4: stages.double.input: unknown key 'input'; there is 'use', 'config', 'inputs', 'needs', 'thread', 'process' or 'low_priority'. Did you mean 'inputs'?",
    ),
    "unknown port": (
        ("left: numbers.number", "left: numbers.number\n      lef: numbers.number"),
        "x.yaml:10: stages.add.inputs.lef: unknown port 'lef'. Did you mean 'left'?",
    ),
    "unwired port": (
        ("      left: numbers.number\n", ""),
        "x.yaml:8: stages.add.inputs: port 'left' (Number) is not wired. "
        "Of that type there is 'double.number' or 'numbers.number'.",
    ),
    "unknown node": (
        ("left: numbers.number", "left: nubers.number"),
        "x.yaml:9: stages.add.inputs.left: no stage or link 'nubers'. Did you mean 'numbers'?",
    ),
    "unknown output": (
        ("left: numbers.number", "left: numbers.nmber"),
        "x.yaml:9: stages.add.inputs.left: 'numbers' has no output 'nmber'. Did you mean 'number'?",
    ),
    "no edge": (
        ("left: numbers.number", "left: numbers"),
        "x.yaml:9: stages.add.inputs.left: must read node.output, got 'numbers'.",
    ),
    "a source of truth": (
        (
            "numbers: {use: tests.flow.toys.Numbers}",
            "numbers: {use: tests.flow.toys.Numbers, config: {topic: /truth/drone}}",
        ),
        "x.yaml:12: links.numbers.config.topic: truth is for evaluation only: no source may bring in '/truth/drone'.",
    ),
    "type mismatch": (
        ("left: numbers.number", "left: add.text"),
        "x.yaml:9: stages.add.inputs.left: type mismatch: add.text is Text, add.left takes Number.",
    ),
    "cycle": (
        (
            "{number: numbers.number}",
            "{number: again.number}\n  again:\n    use: tests.flow.toys.Double\n    inputs: {number: double.number}",
        ),
        "x.yaml:4: stages.double.inputs: cycle double -> again -> double; "
        "a cycle is legal only through a link (a servo, an autopilot).",
    ),
    "unknown section": (
        ("links:", "lnks: {}\nlinks:"),
        "x.yaml:11: lnks: unknown section 'lnks'; there is 'include', 'replay', 'rig', 'stages' or 'links'. "
        "Did you mean 'links'?",
    ),
    "a name twice": (
        (
            "  numbers: {use: tests.flow.toys.Numbers}",
            "  numbers: {use: tests.flow.toys.Numbers}\n  numbers: {use: tests.flow.toys.Numbers}",
        ),
        "x.yaml:13: links.numbers: is written twice (first on line 12).",
    ),
    "a name for a stage and a link": (
        (
            "  numbers: {use: tests.flow.toys.Numbers}",
            "  numbers: {use: tests.flow.toys.Numbers}\n  add: {use: tests.flow.toys.Words}",
        ),
        "x.yaml:13: links.add: a stage has the name 'add' already; an edge could not distinguish them.",
    ),
    "a bad name": (
        ("links:\n", "links:\n  Two Words: {use: tests.flow.toys.Words}\n"),
        "x.yaml:12: links.Two Words: 'Two Words' is no name: use small letters, digits and '_', starting with a letter.",
    ),
    "two sources of one topic": (
        ("links:\n", "links:\n  other: {use: tests.flow.toys.Numbers}\n"),
        "x.yaml:13: links.numbers.config.topic: 'other' already brings in /numbers: one source for each topic.",
    ),
    "not YAML": (
        ("{name: adder}", "{name: adder"),
        "x.yaml:8: is not YAML: expected ',' or '}', but got ':'.",
    ),
    "a reference to nothing": (
        ("{name: adder}", "{name: $rig.title}"),
        "x.yaml:7: stages.add.config.name: '$rig.title' refers to nothing: the configuration has no 'rig'.",
    ),
    "a recording that is not there": (
        ("links:\n", "replay: street.mcap\nlinks:\n"),
        "x.yaml:11: replay: no such recording 'street.mcap'.",
    ),
    "an include that is not there": (
        ("stages:\n", "include: base.yaml\nstages:\n"),
        "x.yaml:1: include: no such file 'base.yaml'.",
    ),
    "an include of itself": (
        ("stages:\n", "include: x.yaml\nstages:\n"),
        "x.yaml:1: include: 'x.yaml' includes itself.",
    ),
}


@pytest.mark.parametrize("kind", CASES)
def test_the_text_of_an_error(kind, tmp_path):
    (old, new), expected = CASES[kind]
    assert old in GRAPH
    found = errors_of(tmp_path, GRAPH.replace(old, new, 1))
    assert expected in found
    # one mistake is one error, unless it removes what other nodes need
    if kind not in ("missing use", "not YAML", "a name twice", "unknown key"):
        assert found == [expected]


def test_all_errors_are_reported_in_the_order_of_the_lines(tmp_path):
    text = GRAPH.replace("toys.Double", "toys.Dubble").replace("name: adder", "name: adder, window: 0")
    text = text.replace("left: numbers.number", "left: numbers.nmber")
    assert [p.split(":")[1] for p in errors_of(tmp_path, text)] == ["3", "7", "9"]


def test_a_missing_file_is_an_error_with_a_similar_name(tmp_path):
    (tmp_path / "quickstart.yaml").write_text(GRAPH)
    with pytest.raises(ConfigError, match=r"quickstrat\.yaml: no such file\. Did you mean 'quickstart\.yaml'\?"):
        load_graph(tmp_path / "quickstrat.yaml")
    with pytest.raises(ConfigError, match=r"nothing\.yaml: no such file\.$"):
        load_graph(tmp_path / "nothing.yaml")


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (b"", "x.yaml: is empty."),
        (b"- 1\n", "x.yaml:1: must be a mapping at the top, as in 'name: value'."),
        (b"\xff\xfe\x00", "x.yaml: is not UTF-8 text (byte 0)."),
        (b"a: " + b"[" * 5000, "x.yaml"),
        (b"#" * 1_000_001, "x.yaml: larger than 1000000 bytes: that is no configuration."),
        (
            b"a: &a [1,1,1,1,1,1,1,1,1,1]\nb: &b [*a,*a,*a,*a,*a,*a,*a,*a,*a,*a]\nc: &c [*b,*b,*b,*b,*b,*b,*b,*b,*b,*b]\n"
            b"d: &d [*c,*c,*c,*c,*c,*c,*c,*c,*c,*c]\ne: [*d,*d,*d,*d,*d,*d,*d,*d,*d,*d]\n",
            "x.yaml: is too large or too deep: that is no configuration.",
        ),
        (b"stages: !!python/object/apply:os.system ['true']\n", "x.yaml"),
    ],
)
def test_a_file_that_is_no_configuration(content, text, tmp_path):
    (tmp_path / "x.yaml").write_bytes(content)
    with pytest.raises(ConfigError) as caught:
        load_graph(tmp_path / "x.yaml")
    assert text in str(caught.value)


def test_a_module_that_does_not_define_the_class_is_not_imported(tmp_path, monkeypatch):
    """Importing a module executes it, and so does importing the packages around it."""
    package = tmp_path / "intruding"
    package.mkdir()
    code = f"open({str(tmp_path / 'executed')!r}, 'w').close()\n"
    (package / "__init__.py").write_text(code)
    (package / "module.py").write_text(code + "import stages\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    for use in ("intruding.Double", "intruding.module.Double", "intruding.none.Double"):
        text = GRAPH.replace("tests.flow.toys.Double", use)
        assert only_error(tmp_path, text) == f"x.yaml:3: stages.double.use: unknown stage '{use}'."
    assert not (tmp_path / "executed").exists()


@pytest.mark.parametrize(("library", "extra"), EXTRAS.items())
def test_a_missing_library_is_named_with_the_extra_that_installs_it(tmp_path, monkeypatch, library, extra):
    (tmp_path / "needy_module.py").write_text(f"import {library}.part\n\n\nclass Double: ...\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setitem(sys.modules, library, None)  # importing it raises ImportError
    (error, *_) = errors_of(tmp_path, GRAPH.replace("tests.flow.toys.Double", "needy_module.Double"))
    assert error.startswith("x.yaml:3: stages.double.use: 'needy_module' cannot be imported: ")
    assert error.endswith(f": pip install -e '.[{extra}]'")
    project = tomllib.loads((Path(__file__).parents[3] / "pyproject.toml").read_text(encoding="utf-8"))
    distribution = {"sklearn": "scikit-learn"}.get(library, library)
    assert any(named.startswith(distribution) for named in project["project"]["optional-dependencies"][extra])


def test_only_a_driver_that_cannot_be_imported_is_not_suggested(monkeypatch):
    before = known_classes("links")
    for name in [name for name in sys.modules if name == "links.camera" or name.startswith("links.camera.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "links.camera", None)  # importing it raises ImportError
    assert before.keys() - known_classes("links").keys() == {"links.camera.Camera"}


def test_a_class_that_only_the_engine_makes_is_not_suggested():
    classes = known_classes("links")
    assert classes["links.lidar.Lidar"].__name__ == "Lidar"
    assert not [path for path in classes if path.startswith("links.zenoh.")]  # a hosts file makes these


def test_set_changes_a_setting_by_the_stages_name(tmp_path):
    (tmp_path / "x.yaml").write_text(GRAPH)
    graph = load_graph(tmp_path / "x.yaml", sets=["add.window=7", "stages.double.config.factor=0.5"])
    assert graph.nodes["add"].build().settings.window == 7
    assert graph.nodes["double"].build().settings.factor == 0.5


@pytest.mark.parametrize(
    ("option", "text"),
    [
        ("ad.window=7", "--set ad.window=7: no stage or link 'ad'. Did you mean 'add'?"),
        ("add.window", "--set add.window: must read NAME.SETTING=VALUE, as in --set detect.accept_probability=0.9."),
        ("add.window=0", "--set add.window=0: stages.add.config.window: must be greater than or equal to 1, got 0."),
        ("add.windw=4", "--set add.windw=4: stages.add.config.windw: unknown setting 'windw'. Did you mean 'window'?"),
        ("add.window=[1", "--set add.window=[1: the value is not YAML: expected ',' or ']', but got '<stream end>'."),
    ],
)
def test_a_wrong_set_names_the_option(option, text, tmp_path):
    assert only_error(tmp_path, GRAPH, sets=[option]) == text


def test_an_overlay_changes_settings_and_null_removes(tmp_path):
    (tmp_path / "x.yaml").write_text(GRAPH)
    (tmp_path / "over.yaml").write_text("stages:\n  double: null\n  add:\n    inputs: {right: numbers.number}\n")
    graph = load_graph(tmp_path / "x.yaml", overlays=[tmp_path / "over.yaml"])
    assert list(graph.nodes) == ["numbers", "add"]


def test_removing_what_does_not_exist_is_an_error(tmp_path):
    (tmp_path / "over.yaml").write_text("stages:\n  dubble: null\n")
    found = only_error(tmp_path, GRAPH, overlays=[tmp_path / "over.yaml"])
    assert found == "over.yaml:2: stages.dubble: removes what does not exist."


def test_a_stage_swapped_in_an_overlay_starts_with_its_own_settings(tmp_path):
    text = GRAPH.replace("toys.Double\n", "toys.Double\n    config: {factor: 3}\n")
    (tmp_path / "x.yaml").write_text(text)
    (tmp_path / "over.yaml").write_text("stages:\n  double: {use: tests.flow.toys.WrongArray}\n")
    with pytest.raises(ConfigError, match="has no output 'number'"):  # not: unknown setting 'factor'
        load_graph(tmp_path / "x.yaml", overlays=[tmp_path / "over.yaml"])


def test_a_lens_of_another_model_replaces_all_numbers(tmp_path):
    rig = "rig: {cameras: {a: {size_px: 9, lens: {model: equidistant, focal_px: 3, centre_px: [1, 2]}}}}\n"
    (tmp_path / "x.yaml").write_text(rig + GRAPH)
    lenses = []
    for lens in ("{model: ocam, centre_px: [4, 5]}", "{model: equidistant, focal_px: 4}", "{centre_px: [6, 7]}"):
        (tmp_path / "over.yaml").write_text(f"rig: {{cameras: {{a: {{lens: {lens}}}}}}}\n")
        camera = load_graph(tmp_path / "x.yaml", overlays=[tmp_path / "over.yaml"]).values["rig"]["cameras"]["a"]
        assert camera["size_px"] == 9
        lenses.append(camera["lens"])
    assert lenses == [
        {"model": "ocam", "centre_px": [4, 5]},
        {"model": "equidistant", "focal_px": 4, "centre_px": [1, 2]},
        {"model": "equidistant", "focal_px": 3, "centre_px": [6, 7]},
    ]


def test_an_include_copies_some_nodes_under_other_names(tmp_path):
    (tmp_path / "base.yaml").write_text(GRAPH)
    text = "include: [base.yaml, {file: base.yaml, nodes: [double, add], suffix: _2}]\n"
    (tmp_path / "x.yaml").write_text(text + "stages:\n  double_2: {config: {factor: 5}}\n")
    graph = load_graph(tmp_path / "x.yaml")
    assert set(graph.nodes) == {"numbers", "double", "add", "double_2", "add_2"}
    assert {(e.producer, e.consumer, e.port) for e in graph.edges if e.consumer.endswith("_2")} == {
        ("numbers", "double_2", "number"),
        ("numbers", "add_2", "left"),
        ("double_2", "add_2", "right"),
    }
    assert graph.nodes["double_2"].config == {"factor": 5}
    assert graph.nodes["double"].config != {"factor": 5}


@pytest.mark.parametrize(
    ("entry", "error"),
    [
        (
            "{file: base.yaml, nodes: [dubble], suffix: _2}",
            "x.yaml:1: include: 'base.yaml' has no stage or link 'dubble'. Did you mean 'double'?",
        ),
        (
            "{file: base.yaml, suffix: _2}",
            "x.yaml:1: include: must be a file name, {file: ..., nodes: [...], suffix: ...}, or a list of them, "
            "got {'file': 'base.yaml', 'suffix': '_2'}.",
        ),
        (
            "{file: bse.yaml, nodes: [], suffix: _2}",
            "x.yaml:1: include: no such file 'bse.yaml'. Did you mean 'base.yaml'?",
        ),
    ],
)
def test_a_copy_that_is_impossible_is_an_error(tmp_path, entry, error):
    (tmp_path / "base.yaml").write_text(GRAPH)
    assert only_error(tmp_path, f"include: [base.yaml, {entry}]\n") == error


def test_the_including_file_is_on_top_and_errors_name_the_included_file(tmp_path):
    (tmp_path / "base.yaml").write_text(GRAPH.replace("{name: adder}", "{name: adder, window: 0}"))
    found = only_error(tmp_path, "include: base.yaml\nstages:\n  double: {config: {factor: 5}}\n")
    assert found == "base.yaml:7: stages.add.config.window: must be greater than or equal to 1, got 0."


def test_a_reference_is_replaced_by_its_value(tmp_path):
    text = "rig: {names: {a: anna}, other: $rig.names.a}\n" + GRAPH.replace("adder", "$rig.other")
    (tmp_path / "x.yaml").write_text(text)
    assert load_graph(tmp_path / "x.yaml").nodes["add"].build().settings.name == "anna"


@pytest.mark.parametrize(("rig", "name"), [("{title: anna}", "anna"), ("{}", "bert")])
def test_a_reference_may_have_a_default(tmp_path, rig, name):
    (tmp_path / "x.yaml").write_text(f"rig: {rig}\n" + GRAPH.replace("{name: adder}", "{name: $rig.title or bert}"))
    assert load_graph(tmp_path / "x.yaml").nodes["add"].build().settings.name == name


@pytest.mark.parametrize(
    ("reference", "error"),
    [
        ("$rig.titel or bert", "'$rig.titel or bert' refers to nothing: rig has no 'titel'. Did you mean 'title'?"),
        ("$rig.name or [1, 2]", "'[1, 2]' after 'or' is no plain value"),
        ("$rig.name or '", "after 'or' is no plain value"),
        ("$rig.name or $rig.title", "after 'or' is no plain value"),
    ],
)
def test_a_default_does_not_hide_a_mistyped_reference(tmp_path, reference, error):
    text = "rig: {title: anna}\n" + GRAPH.replace("{name: adder}", f'{{name: "{reference}"}}')
    assert any(error in found for found in errors_of(tmp_path, text))


def test_a_reference_to_itself_is_an_error(tmp_path):
    text = "rig: {a: $rig.b, b: $rig.a}\n" + GRAPH.replace("adder", "$rig.a")
    assert any("'$rig.a' refers to itself." in p for p in errors_of(tmp_path, text))


def test_a_recordings_rig_replaces_the_files_own_and_set_changes_both(tmp_path):
    (tmp_path / "x.yaml").write_text("rig: {a: own, b: own}\n" + GRAPH.replace("{name: adder}", "{name: $rig.a}"))
    sections = {"rig": ("a: recorded", "street.mcap rig.yaml")}
    graph = load_graph(tmp_path / "x.yaml", sections=sections)
    assert (graph.nodes["add"].build().settings.name, graph.values["rig"]) == ("recorded", {"a": "recorded"})
    graph = load_graph(tmp_path / "x.yaml", sections=sections, sets=["rig.a=by hand"])
    assert graph.nodes["add"].build().settings.name == "by hand"


NEEDY = GRAPH.replace("use: tests.flow.toys.Double\n", "use: tests.flow.toys.Double\n    needs: $rig.cameras\n")


def load(tmp_path: Path, text: str) -> Graph:
    (tmp_path / "x.yaml").write_text(text, encoding="utf-8")
    return load_graph(tmp_path / "x.yaml")


def test_a_node_whose_need_is_met_is_in_the_graph(tmp_path):
    graph = load(tmp_path, NEEDY + "rig: {cameras: {drone: {}}}\n")
    assert graph.nodes == load(tmp_path, GRAPH).nodes
    assert graph.left_out_texts() == []


def test_nodes_whose_need_is_not_met_are_left_out_and_reported(tmp_path):
    text = NEEDY.replace("use: tests.flow.toys.Add\n", "use: tests.flow.toys.Add\n    needs: $rig.cameras\n")
    text = text.replace("stages:", "stages:\n  third: {use: tests.flow.toys.Double, inputs: {number: numbers.number}}")
    graph = load(tmp_path, text)
    assert list(graph.nodes) == ["numbers", "third"]
    assert [edge.consumer for edge in graph.edges] == ["third"]
    assert graph.left_out_texts() == ["the configuration has no $rig.cameras: double, add left out"]


def test_the_class_of_a_node_that_is_left_out_is_checked_too(tmp_path):
    text = NEEDY.replace("toys.Double", "toys.Dubble").replace("toys.Add\n", "toys.Add\n    needs: $rig.cameras\n")
    assert "unknown stage 'tests.flow.toys.Dubble'" in only_error(tmp_path, text)


def test_a_required_input_from_a_node_that_is_left_out_is_an_error(tmp_path):
    assert only_error(tmp_path, NEEDY) == (
        "x.yaml:11: stages.add.inputs.right: 'double' is left out, because the configuration has no $rig.cameras: "
        "add 'needs: $rig.cameras' to this node too."
    )


def test_an_optional_input_from_a_node_that_is_left_out_is_unwired(tmp_path):
    text = GRAPH.replace("double.number\n", "double.number\n      words: words.text\n")
    graph = load(tmp_path, text + "  words: {use: tests.flow.toys.Words, needs: $rig.radio}\n")
    assert [edge.port for edge in graph.edges] == ["number", "left", "right"]


@pytest.mark.parametrize(
    ("needs", "error"),
    [
        ("rig.cameras", "must name a value of the configuration, as $rig.cameras, got 'rig.cameras'."),
        ("[1]", "must name a value of the configuration, as $rig.cameras, got [1]."),
        ("$rig.c or 1", "must name a value of the configuration, as $rig.cameras, got '$rig.c or 1'."),
        ("$rig.camera", "'$rig.camera or null' refers to nothing: rig has no 'camera'. Did you mean 'cameras'?"),
    ],
)
def test_a_mistyped_need_is_an_error(tmp_path, needs, error):
    text = NEEDY.replace("$rig.cameras", needs) + "rig: {cameras: {}}\n"
    assert f"x.yaml:4: stages.double.needs: {error}" in errors_of(tmp_path, text)
