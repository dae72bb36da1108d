"""What a graph file means: wiring, parameters, nesting, policies, order, and loading it again elsewhere."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import graph_operators
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dataflow.graph import Graph, GraphError, load_bundle, load_graph, load_text
from dataflow.graph.sections import as_values

RGBD = """\
graph: rgbd
namespace: robot1
params: {data: /data, stride: 4, model: }

operators:
  camera:
    use: graph_operators:Camera
    params: {path: ${data}/rgbd_7scenes, rate: 15}
  cloud:
    use: graph_operators:CloudBuilder
    inputs: {depth: camera/depth, image: camera/image, camera: camera/info}
    params: {stride: ${stride}}
    process: vision
  detector:
    use: graph_operators:Detector
    inputs: {image: /robot1/camera/image}
    params: {model: "${model:-nothing}.onnx"}
    process: vision
    live: {queue: newest, deadline: 100ms, memory: 1.5GiB, restart: {max: 3, backoff: 2s}}

record: {topics: ["camera/**"], exclude: [camera/depth]}
view: {hide: [camera/depth]}
seed: 7
threads: 2
"""

FRONT = """\
graph: front_end
params: {rate: 30, stride: 2}
inputs: {picture: TestPicture}
outputs: {cloud: cloud/cloud}
operators:
  camera: {use: "graph_operators:Camera", params: {rate: "${rate}"}}
  cloud:
    use: graph_operators:CloudBuilder
    inputs: {depth: camera/depth, image: picture, camera: camera/info}
    params: {stride: "${stride}"}
"""

OUTER = """\
graph: outer
operators:
  eye: {use: "graph_operators:Camera"}
  front:
    use: parts/front.yaml
    inputs: {picture: eye/image}
    params: {rate: 5}
    process: front_process
  odometry: {use: "graph_operators:Odometry", inputs: {image: eye/image, map: front/cloud}}
"""


def nested(folder: Path, front: str = FRONT) -> Path:
    (folder / "parts").mkdir()
    (folder / "parts" / "front.yaml").write_text(front)
    (folder / "outer.yaml").write_text(OUTER)
    return folder / "outer.yaml"


def test_a_file_resolves_to_streams_parameters_and_policies(tmp_path: Path) -> None:
    (tmp_path / "rgbd.yaml").write_text(RGBD)
    graph = load_graph(tmp_path / "rgbd.yaml")
    assert (graph.name, graph.namespace, graph.seed, graph.threads) == ("rgbd", "robot1", 7, 2)
    assert graph.nodes["camera"].params == {"rate": 15.0, "path": "/data/rgbd_7scenes"}
    assert graph.nodes["cloud"].params["stride"] == 4
    assert graph.nodes["cloud"].inputs == {
        "depth": ("robot1/camera/depth",),
        "image": ("robot1/camera/image",),
        "camera": ("robot1/camera/info",),
    }
    assert graph.nodes["detector"].inputs == {"image": ("robot1/camera/image",)}
    assert graph.nodes["detector"].params["model"] == "nothing.onnx"
    live = graph.nodes["detector"].live
    assert (live.queue, live.size, live.deadline, live.memory) == ("newest", 1, 100_000_000, 3 * 2**29)
    assert (live.restart.max, live.restart.backoff) == (3, 2_000_000_000)
    assert graph.record.streams == ("robot1/camera/image", "robot1/camera/info")
    assert graph.record.thin
    assert graph.view.hide == ("robot1/camera/depth",)
    assert graph.network.loopback_only
    assert graph.streams["robot1/camera/info"].static
    assert [n.name for n in graph.sources()] == ["camera"]
    assert [n.name for n in graph.sinks()] == []
    assert graph.producer("robot1/cloud/cloud") == (graph.nodes["cloud"], "cloud")
    assert [(n.name, port) for n, port in graph.consumers("robot1/camera/image")] == [
        ("cloud", "image"),
        ("detector", "image"),
    ]
    assert graph.nodes["cloud"].make().stride == 4


def test_processes_follow_process_labels_unless_overridden() -> None:
    graph = load_text(RGBD)
    assert graph.processes() == {"camera": ("camera",), "vision": ("cloud", "detector")}
    assert graph.processes("one_process") == {"all": ("camera", "cloud", "detector")}
    assert graph.processes("process_each") == {"camera": ("camera",), "cloud": ("cloud",), "detector": ("detector",)}
    assert graph.processes({"camera": "vision"}) == {"vision": ("camera", "cloud", "detector")}
    with pytest.raises(ValueError, match="camra"):
        graph.processes({"camra": "x"})


@pytest.mark.parametrize(
    ("written", "matched"),
    [
        ("a/pose", {"a/pose"}),
        ("[a/pose, b/pose]", {"a/pose", "b/pose"}),
        ('"*/pose"', {"a/pose", "b/pose"}),
        ('"**/pose"', {"a/pose", "b/pose"}),
        ('"/r/*/pose"', {"a/pose", "b/pose"}),
        ('"/**/a/pose"', {"a/pose"}),
        ('"$*b/pose"', {"b/pose"}),
        ('"{a,b}/pose"', None),
    ],
)
def test_wildcards_choose_streams(written: str, matched: set[str] | None) -> None:
    text = f"""\
graph: g
namespace: r
operators:
  camera: {{use: "graph_operators:Camera"}}
  a: {{use: "graph_operators:Odometry", inputs: {{image: camera/image}}}}
  b: {{use: "graph_operators:Odometry", inputs: {{image: camera/image}}}}
  fuse: {{use: "graph_operators:Fuse", inputs: {{poses: {written}}}}}
"""
    if matched is None:
        with pytest.raises(GraphError, match="is no stream of this graph"):
            load_text(text)
    else:
        assert set(load_text(text).nodes["fuse"].inputs["poses"]) == {f"r/{name}" for name in matched}


def test_wildcard_skips_own_outputs_and_static_streams() -> None:
    graph = load_text("""\
graph: g
operators:
  camera: {use: "graph_operators:Camera"}
  p1: {use: "graph_operators:Odometry", inputs: {image: camera/image}}
  p2: {use: "graph_operators:Fuse", inputs: {poses: "p$*/*"}}
  log: {use: "graph_operators:Log", inputs: {images: "camera/i$*"}}
""")
    assert graph.nodes["p2"].inputs["poses"] == ("g/p1/pose",)
    assert graph.nodes["log"].inputs["images"] == ("g/camera/image",)


def test_whole_references_keep_their_type_and_partial_ones_make_text() -> None:
    graph = load_text(
        """\
graph: g
params: {n: 3, on: true, words: [a, b], more: {gain: 0.5}, folder: "${env:GRAPH_TEST_DIR:-here}", file: "${folder}/m"}
operators:
  camera: {use: "graph_operators:Camera"}
  d:
    use: graph_operators:Detector
    inputs: {image: camera/image}
    params: {model: "${file}_${n}_${on}$${n}.onnx", labels: ${words}, options: ${more}}
"""
    )
    params = graph.nodes["d"].params
    assert params["model"] == "here/m_3_true${n}.onnx"
    assert params["labels"] == ["a", "b"]
    assert params["options"] == {"gain": 0.5}


def test_references_also_serve_names_keys_and_policies() -> None:
    graph = load_text("""\
graph: g
params: {place: vision, from: camera/image, wait: 5ms, size: 3}
operators:
  camera: {use: "graph_operators:Camera"}
  log: {use: "graph_operators:Log", inputs: {images: ${from}}, process: ${place}, live: {wait: ${wait}, size: ${size}}}
""")
    log = graph.nodes["log"]
    assert log.inputs["images"] == ("g/camera/image",)
    assert (log.process, log.live.wait, log.live.size) == ("vision", {"images": 5_000_000}, 3)


def test_settings_override_operators_and_the_graph() -> None:
    words = ["detector.threshold=0.25", "detector.options.gain=2", "stride=8", "model=/m/yolo", "camera.path='010'"]
    graph = load_text(RGBD, settings=words)
    assert graph.nodes["detector"].params["threshold"] == 0.25
    assert graph.nodes["detector"].params["options"] == {"gain": 2.0}
    assert graph.nodes["detector"].params["model"] == "/m/yolo.onnx"
    assert graph.nodes["cloud"].params["stride"] == 8
    assert graph.nodes["camera"].params["path"] == "010"


def test_nested_graph_takes_inputs_and_parameters_and_exports_outputs(tmp_path: Path) -> None:
    graph = load_graph(nested(tmp_path), settings=["front.stride=6", "front/camera.path=x"])
    assert list(graph.nodes) == ["eye", "front/camera", "front/cloud", "odometry"]
    assert graph.nodes["front/cloud"].inputs == {
        "depth": ("outer/front/camera/depth",),
        "image": ("outer/eye/image",),
        "camera": ("outer/front/camera/info",),
    }
    assert graph.nodes["front/camera"].params == {"rate": 5.0, "path": "x"}
    assert graph.nodes["front/cloud"].params["stride"] == 6
    assert graph.nodes["odometry"].inputs["map"] == ("outer/front/cloud/cloud",)
    assert graph.aliases == {"outer/front/cloud": "outer/front/cloud/cloud"}
    assert graph.processes()["front_process"] == ("front/camera", "front/cloud")
    assert (graph.nodes["front/cloud"].file, graph.nodes["front/cloud"].line) == ("parts/front.yaml", 7)


def test_a_graph_may_be_nested_twice_and_export_an_export() -> None:
    middle = """\
graph: middle
inputs: [picture]
outputs: {cloud: inner/cloud}
operators:
  inner: {use: front.yaml, inputs: {picture: picture}}
"""
    outer = """\
graph: outer
operators:
  eye: {use: "graph_operators:Camera"}
  left: {use: parts/middle.yaml, inputs: {picture: eye/image}}
  right: {use: parts/middle.yaml, inputs: {picture: left/inner/camera/image}}
  odometry: {use: "graph_operators:Odometry", inputs: {image: eye/image, map: right/cloud}}
"""
    graph = load_text(outer, files={"parts/middle.yaml": middle, "parts/front.yaml": FRONT})
    assert graph.nodes["right/inner/cloud"].inputs["image"] == ("outer/left/inner/camera/image",)
    assert graph.nodes["odometry"].inputs["map"] == ("outer/right/inner/cloud/cloud",)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("picture: eye/image", "picture: eye/depth"), "6:23: graph input 'front/picture' takes TestPicture, but"),
        (("picture: eye/image", "pictur: eye/image"), "outer.yaml:6:14: parts/front.yaml has no input 'pictur'"),
        (("inputs: {picture: eye/image}", "machine: m"), "5:10: front: input 'picture' (TestPicture) of parts"),
        (("rate: 5", "rte: 5"), "outer.yaml:7:19: front (parts/front.yaml) has no parameter 'rte'"),
        (("rate: 5", "rate: -5"), "parts/front.yaml:6:58: front/camera: parameter 'rate': input should"),
        (("map: front/cloud", "map: front/clod"), "9:79: odometry.map: 'front/clod' is no stream of this graph"),
    ],
)
def test_faults_between_nested_graphs(change: tuple[str, str], said: str) -> None:
    with pytest.raises(GraphError) as caught:
        load_text(OUTER.replace(*change), file="outer.yaml", files={"parts/front.yaml": FRONT})
    assert said in str(caught.value)


def test_consumers_of_an_output_whose_operator_cannot_be_loaded_are_no_faults() -> None:
    inner = "graph: i\noperators:\n  a: {use: 'absent_module:A'}\noutputs: {seen: a/seen}\n"
    middle = "graph: m\noperators:\n  i: {use: inner.yaml}\noutputs: {seen: i/seen}\n"
    outer = """\
graph: o
operators:
  m: {use: middle.yaml}
  b: {use: "graph_operators:Odometry", inputs: {image: m/seen}}
"""
    with pytest.raises(GraphError) as caught:
        load_text(outer, file="outer.yaml", files={"middle.yaml": middle, "inner.yaml": inner})
    assert [p.file for p in caught.value.problems] == ["inner.yaml"]


def test_graphs_that_nest_each_other_are_refused() -> None:
    one = "graph: one\noperators:\n  b: {use: two.yaml}\n"
    two = "graph: two\noperators:\n  a: {use: one.yaml}\n"
    with pytest.raises(GraphError, match=r"two.yaml:3:12: graph nests in itself: one.yaml -> two.yaml -> one.yaml"):
        load_text(one, file="one.yaml", files={"two.yaml": two})


def test_bundle_loads_the_same_graph_without_files_and_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = nested(tmp_path, FRONT.replace("stride: 2", "stride: '${env:GRAPH_TEST_STRIDE}'"))
    monkeypatch.setenv("GRAPH_TEST_STRIDE", "9")
    graph = load_graph(file, settings=["front/camera.path=x"])
    bundle = graph.bundle()
    monkeypatch.delenv("GRAPH_TEST_STRIDE")
    shutil.rmtree(tmp_path)
    again = load_bundle(bundle)
    assert again == graph
    assert again.nodes["front/cloud"].params["stride"] == 9
    assert again.bundle() == bundle
    assert str(tmp_path) not in bundle
    assert OUTER in graph.text
    assert "# file: parts/front.yaml" in graph.text


def test_json_rebuilds_the_same_graph() -> None:
    graph = load_text(RGBD)
    assert Graph.from_json(json.loads(json.dumps(graph.to_json()))) == graph


def test_the_values_of_a_graph_are_those_of_its_dataclasses() -> None:
    graph = load_text(RGBD)
    for part in (*graph.nodes.values(), *graph.streams.values(), graph.record, graph.view, graph.sources_bundle):
        assert as_values(part) == asdict(part)


def test_json_rebuilds_without_importing_operators() -> None:
    script = (
        "import json, sys; from dataflow.graph import Graph; graph = Graph.from_json(json.load(sys.stdin)); "
        "assert list(graph.nodes) == ['camera', 'cloud', 'detector']; assert 'graph_operators' not in sys.modules"
    )
    text = json.dumps(load_text(RGBD).to_json())
    subprocess.run([sys.executable, "-c", script], input=text, text=True, check=True, timeout=60)


def test_result_is_the_same_under_every_hash_seed() -> None:
    script = (
        "import sys, json; from dataflow.graph import load_text; "
        "print(json.dumps(load_text(sys.stdin.read()).to_json()))"
    )
    results = set()
    for seed in ("0", "1", "77"):
        environment = {**os.environ, "PYTHONHASHSEED": seed, "PYTHONPATH": str(Path(graph_operators.__file__).parent)}
        done = subprocess.run(
            [sys.executable, "-c", script], input=RGBD, env=environment, capture_output=True, text=True, timeout=60
        )
        assert done.returncode == 0, done.stderr
        results.add(done.stdout)
    assert len(results) == 1


def test_order_follows_the_flow_and_leaves_feedback_out() -> None:
    graph = load_text("""\
graph: g
operators:
  log: {use: "graph_operators:Log", inputs: {images: camera/image}}
  mapper:
    use: graph_operators:Mapper
    inputs: {cloud: cloud/cloud, pose: odometry/pose}
    sync: {tolerance: 0ms}
  odometry: {use: "graph_operators:Odometry", inputs: {image: camera/image, map: mapper/map}}
  cloud:
    use: graph_operators:CloudBuilder
    inputs: {depth: camera/depth, image: camera/image, camera: camera/info}
  camera: {use: "graph_operators:Camera"}
""")
    assert list(graph.nodes) == ["camera", "log", "odometry", "cloud", "mapper"]
    assert graph.nodes["mapper"].tolerance == 0


@settings(max_examples=25, deadline=None)
@given(st.integers(2, 7), st.data())
def test_order_puts_producers_first_whatever_the_order_in_the_file(count: int, data: st.DataObject) -> None:
    lines = [
        '  camera: {use: "graph_operators:Camera"}',
        '  e0: {use: "graph_operators:Odometry", inputs: {image: camera/image}}',
    ]
    port = {0: "e0/pose"}
    for i in range(1, count):
        pose, hint = (port[data.draw(st.integers(0, i - 1))] for _ in range(2))
        lines.append(f'  e{i}: {{use: "graph_operators:Echo", inputs: {{pose: {pose}, hint: {hint}}}}}')
        port[i] = f"e{i}/echo"
    text = "graph: g\noperators:\n" + "\n".join(data.draw(st.permutations(lines))) + "\n"
    graph = load_text(text)
    place = {name: i for i, name in enumerate(graph.nodes)}
    assert all(place[edge.producer] < place[edge.consumer] for edge in graph.edges())


def test_defaults_of_live_policies_depend_on_whether_the_sources_can_wait() -> None:
    text = """\
graph: g
operators:
  dataset: {use: "graph_operators:Camera"}
  device: {use: "graph_operators:Device"}
  replayed: &cloud
    use: graph_operators:CloudBuilder
    inputs: {depth: dataset/depth, image: dataset/image, camera: dataset/info}
  sensed:
    use: graph_operators:CloudBuilder
    inputs: {depth: device/depth, image: device/image, camera: device/info}
  behind: {use: "graph_operators:Odometry", inputs: {image: dataset/image, map: sensed/cloud}}
"""
    nodes = load_text(text).nodes
    assert nodes["replayed"].live.queue == "block"
    assert nodes["replayed"].live.wait == {"depth": None, "image": None, "camera": None}
    assert (nodes["sensed"].live.queue, nodes["sensed"].live.size) == ("newest", 16)
    assert nodes["sensed"].live.wait == {"depth": 100_000_000, "image": 100_000_000, "camera": 0}
    assert nodes["behind"].live.queue == "newest"


def test_waits_are_set_per_input_or_for_all() -> None:
    text = """\
graph: g
operators:
  device: {use: "graph_operators:Device"}
  a:
    use: graph_operators:CloudBuilder
    inputs: {depth: device/depth, image: device/image, camera: device/info}
    live: {wait: {depth: 30ms, camera: forever}, queue: oldest, size: 4, on_stale: drop}
    sync: {tolerance: 5ms}
"""
    node = load_text(text).nodes["a"]
    assert node.live.wait == {"depth": 30_000_000, "image": 100_000_000, "camera": None}
    assert (node.live.queue, node.live.size, node.live.on_stale) == ("oldest", 4, "drop")
    assert node.tolerance == 5_000_000


def test_every_is_overridden_for_operators_that_tick() -> None:
    text = """\
graph: g
operators:
  camera: {use: "graph_operators:Camera"}
  o: {use: "graph_operators:Odometry", inputs: {image: camera/image}}
  w: {use: "graph_operators:Watchdog", inputs: {poses: o/pose}, sync: {every: 1s}}
"""
    node = load_text(text).nodes["w"]
    assert node.every == 1_000_000_000
    assert node.inputs["lens"] == ()


def test_network_is_loopback_unless_the_graph_configures_more() -> None:
    head = 'graph: g\noperators:\n  camera: {use: "graph_operators:Camera"}\n'
    section = "network: {listen: [tcp/0.0.0.0:7447], connect: tls/base.local:7447, shared_memory: false}\n"
    network = load_text(head + section).network
    assert network.listen == ("tcp/0.0.0.0:7447",)
    assert network.connect == ("tls/base.local:7447",)
    assert not network.shared_memory
    assert not network.loopback_only


def test_yaml_1_2_words_stay_words() -> None:
    head = 'graph: g\noperators:\n  camera: {use: "graph_operators:Camera", params: {path: %s}}\n'
    for written, value in (("no", "no"), ("off", "off"), ("2024-01-01", "2024-01-01"), ("12:30", "12:30")):
        assert load_text(head % written).nodes["camera"].params["path"] == value
