"""Optional inputs of nested graphs, `when:`, and the first of several streams that is there."""

from __future__ import annotations

import pytest

from dataflow.graph import Graph, GraphError, load_bundle, load_text

PART = """\
graph: part
params: {detect: true}
inputs: {image: TestPicture, depth: TestDepth?, lens: TestLens?, cloud: TestCloud?, hint: TestPose?}
outputs: {cloud: cloud | builder/cloud, pose: odometry/pose, boxes: detector/found}
operators:
  builder:
    use: graph_operators:CloudBuilder
    inputs: {depth: depth, image: image, camera: lens}
  detector: {use: "graph_operators:Detector", when: "${detect}", inputs: {image: image}, params: {model: m}}
  odometry:
    use: graph_operators:Odometry
    inputs: {image: image, hint: hint}
  mapper:
    use: graph_operators:Mapper
    inputs: {cloud: cloud | builder/cloud, pose: odometry/pose}
  fuse:
    use: graph_operators:Fuse
    inputs: {poses: [hint, odometry/pose]}
"""


def outer(inputs: str, more: str = "", part: str = PART) -> Graph:
    text = f"""\
graph: outer
operators:
  camera: {{use: "graph_operators:Camera"}}
  other: {{use: "graph_operators:Camera"}}
  part: {{use: part.yaml, inputs: {{image: camera/image{inputs}}}}}
{more}"""
    return load_text(text, files={"part.yaml": part})


def taken(graph: Graph, operator: str, port: str) -> tuple[str, ...]:
    return tuple(graph.relative(stream) for stream in graph.nodes[operator].inputs[port])


def faults(inputs: str, more: str = "", part: str = PART) -> list[str]:
    with pytest.raises(GraphError) as caught:
        outer(inputs, more, part)
    return [problem.message for problem in caught.value.problems]


def test_everything_is_there_where_every_input_is_given() -> None:
    graph = outer(", depth: camera/depth, lens: camera/info")
    assert {"part/builder", "part/detector", "part/odometry", "part/mapper", "part/fuse"} <= graph.nodes.keys()
    assert taken(graph, "part/mapper", "cloud") == ("part/builder/cloud",)


def test_operator_without_required_input_is_left_out_with_its_dependents() -> None:
    graph = outer("")
    assert "part/builder" not in graph.nodes
    assert "part/mapper" not in graph.nodes
    assert graph.left_out == {
        "part/builder": "part is not given its input 'depth'",
        "part/mapper": "part is not given its input 'cloud'; part is not given its input 'depth'",
    }


def test_optional_inputs_and_those_that_take_many_do_without() -> None:
    graph = outer("")
    assert taken(graph, "part/odometry", "hint") == ()
    assert taken(graph, "part/fuse", "poses") == ("part/odometry/pose",)


def test_the_first_way_that_is_there_is_taken_also_through_exported_outputs() -> None:
    wires = "{depth: other/depth, image: other/image, camera: other/info}"
    more = f'  clouds: {{use: "graph_operators:CloudBuilder", inputs: {wires}}}\n'
    given = outer(", depth: camera/depth, lens: camera/info, cloud: clouds/cloud", more)
    assert taken(given, "part/mapper", "cloud") == ("clouds/cloud",)
    assert given.aliases["outer/part/cloud"] == "outer/clouds/cloud"
    built = outer(", depth: camera/depth, lens: camera/info", more)
    assert built.aliases["outer/part/cloud"] == "outer/part/builder/cloud"
    assert "outer/part/cloud" not in outer("", more).aliases


def test_input_from_a_left_out_operator_is_a_fault() -> None:
    more = '  echo: {use: "graph_operators:Mapper", inputs: {cloud: part/cloud, pose: part/pose}}\n'
    assert faults("", more) == [
        "echo.cloud: 'part/cloud' is not made: part is not given its input 'cloud'; part is not given its input 'depth'"
    ]


def test_an_absence_passes_through_a_graph_whose_own_input_is_optional() -> None:
    middle = """\
graph: middle
inputs: {image: TestPicture, depth: TestDepth?, lens: TestLens?}
operators:
  inner: {use: part.yaml, inputs: {image: image, depth: depth, lens: lens}}
  use: {use: "graph_operators:Mapper", inputs: {cloud: inner/cloud, pose: inner/pose}}
"""
    text = """\
graph: outer
operators:
  camera: {use: "graph_operators:Camera"}
  m: {use: middle.yaml, inputs: {image: camera/image}}
"""
    graph = load_text(text, files={"middle.yaml": middle, "part.yaml": PART})
    assert graph.left_out.keys() == {"m/inner/builder", "m/inner/mapper", "m/use"}


def test_when_false_leaves_an_operator_out_and_settings_of_it_are_still_known() -> None:
    text = """\
graph: outer
operators:
  camera: {use: "graph_operators:Camera"}
  part: {use: part.yaml, inputs: {image: camera/image}, params: {detect: false}}
record: {exclude: [part/boxes, part/detector/*]}
"""
    graph = load_text(text, files={"part.yaml": PART}, settings=["part/detector.model=other.onnx"])
    assert graph.left_out["part/detector"] == "part/detector has 'when: false'"
    assert "outer/part/detector/found" not in graph.streams


@pytest.mark.parametrize(
    ("when", "made_with", "made_without"),
    [
        ("depth", True, False),
        ("not depth", False, True),
        ("depth | cloud", True, False),
        ("depth | image", True, True),
        ("[image, not depth]", False, True),
        ("[image, depth, true]", True, False),
    ],
)
def test_conditions_ask_which_inputs_are_given(when: str, made_with: bool, made_without: bool) -> None:
    part = PART.replace('when: "${detect}"', f"when: {when}")
    assert ("part/detector" in outer(", depth: camera/depth, lens: camera/info", part=part).nodes) is made_with
    assert ("part/detector" in outer("", part=part).nodes) is made_without


def test_a_nested_graph_is_left_out_whole() -> None:
    text = """\
graph: outer
params: {more: false}
operators:
  camera: {use: "graph_operators:Camera"}
  part: {use: part.yaml, when: "${more}", inputs: {image: camera/image}}
  echo: {use: "graph_operators:Echo", inputs: {pose: part/pose}}
"""
    graph = load_text(text, files={"part.yaml": PART})
    assert list(graph.nodes) == ["camera"]
    assert graph.left_out.keys() == {"part", "echo"}
    assert "part/odometry" in load_text(text, files={"part.yaml": PART}, settings=["more=true"]).nodes


def test_left_out_operators_survive_bundle_and_json() -> None:
    graph = outer("")
    again = load_bundle(graph.bundle())
    assert again.left_out == graph.left_out
    assert again.nodes.keys() == graph.nodes.keys()
    assert Graph.from_json(graph.to_json()).left_out == graph.left_out


@pytest.mark.parametrize(
    ("part", "fault"),
    [
        (PART.replace("TestDepth?", "TestDept?"), "unknown message type 'TestDept'"),
        (PART.replace("cloud | builder/cloud, pose: odometry/pose}", "'*/cloud | cloud', pose: odometry/pose}"),
         "'*/cloud': streams between '|' are named without wildcards"),
        (PART.replace('when: "${detect}"', "when: 3"),
         "when must be true, false or inputs of this graph, not the number 3"),
        (PART.replace('when: "${detect}"', "when: not dept"), "when: 'dept' is no input of this graph"),
        (PART.replace("inputs: {image: TestPicture,", "inputs: {image: TestPicture, must: TestPose,"),
         "part: input 'must' (TestPose) of part.yaml is not given"),
    ],
    ids=["type", "wildcard", "when", "when_of_no_input", "required"],
)  # fmt: skip
def test_faults_are_reported(part: str, fault: str) -> None:
    assert fault in faults(", depth: camera/depth, lens: camera/info", part=part)
