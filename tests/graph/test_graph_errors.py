"""Every fault of a graph file is reported with its place and the nearest right word, and all of them together."""

# ruff: noqa: E501  (golden texts)

from __future__ import annotations

import re
from pathlib import Path

import pytest

from dataflow.graph import GraphError, Problem, load_bundle, load_graph, load_text
from dataflow.graph.yaml import document

HEAD = """\
graph: g
operators:
  camera: {use: "graph_operators:Camera"}
"""
"""Three lines: what follows begins at line 4."""


def problems(text: str, **options: object) -> tuple[Problem, ...]:
    with pytest.raises(GraphError) as caught:
        load_text(text, **options)
    return caught.value.problems


def operator(text: str) -> str:
    return f"{HEAD}  {text}\n"


BELOW_HEAD = """\
---
a: 1
4:1: not readable as YAML: a second document begins here
> a graph file holds one document: remove the '---'
seed: \x00
4:7: character U+0000 is not allowed
seed: *none
4:7: not readable as YAML: found undefined alias 'none'
  c: {use: "graph_operators:Camera", params: {path: &a [*a]}}
4:53: an alias (*) refers to the value it is part of
seed: !x 1
4:7: tags (!x) are not part of the graph language
> remove the tag
  c: {use: "graph_operators:Camera", params: {<<: {rate: 1}}}
4:47: merge keys (<<) are not part of the graph language
> use graph parameters
seed: 010
4:7: 010 is octal to some and decimal to others
> write 10 or '010'
  c: {use: "graph_operators:Camera", params: {rate: .nan}}
4:53: NaN (not a number) is no value
> leave it out, or give a number
namespce: r
4:1: unknown key 'namespce' in the graph file
> did you mean 'namespace'?
  c: {use: "graph_operators:Camera", parms: {}}
4:38: unknown key 'parms' in operator 'c'
> did you mean 'params'?
namespace: robot1/*
4:12: namespace 'robot1/*': '*' contains '*'
> names joined by '/', such as robot1 or site/robot1; a name is letters, digits, '_' and '-', and begins with a letter or '_'
  "a/b": {use: "graph_operators:Camera"}
4:3: operator name 'a/b' contains '/'
> a name is letters, digits, '_' and '-', and begins with a letter or '_'
threads: yes
4:10: threads must be a whole number from 1 to 256, not the text 'yes'
  c: {use: "graph_operators:Camera", process: 3}
4:47: process must be a text, not the number 3
> write '3' in quotes
  c: {params: {}}
4:3: operator 'c' has no 'use:'
> use: package.module:Class
  c: {use: graph_operater:Camera}
4:12: no module 'graph_operater'
> did you mean 'graph_operators'?
> looked among the installed packages; --path DIR names another folder
  c: {use: "graph_operators:Camra"}
4:12: module 'graph_operators' has no operator 'Camra'
> did you mean 'Camera'?
  c: {use: Camera}
4:12: 'Camera' names no operator
> write 'package.module:Class', or the path of a graph file (*.yaml)
  c: {use: "graph_operators:NotAnOperator"}
4:12: 'graph_operators:NotAnOperator' is the class NotAnOperator, not an Operator
> operators in 'graph_operators': Camera, CloudBuilder, Detector, Device, Echo, Fuse, Log, Mapper, Odometry, StaticUser, Ticker, Watchdog
  c: {use: "graph_operators:Abstract"}
4:12: 'graph_operators:Abstract' is abstract: it declares no ports
> operators in 'graph_operators': Camera, CloudBuilder, Detector, Device, Echo, Fuse, Log, Mapper, Odometry, StaticUser, Ticker, Watchdog
  c: {use: "graph_operators:Camera", params: {rte: 3}}
4:47: c: Camera has no parameter 'rte'
> did you mean 'rate'?
  c: {use: "graph_operators:Camera", params: {path: x, rate: -3}}
4:62: c: parameter 'rate': input should be greater than 0, got -3
> rate: pictures a second
  c: {use: "graph_operators:CloudBuilder", params: {mode: exct}, inputs: {depth: camera/depth, image: camera/image, camera: camera/info}}
4:59: c: parameter 'mode': input should be 'fast' or 'exact', got exct
> did you mean 'exact'?
  c: {use: "graph_operators:Camera", params: {path: 0x10}}
4:53: c: parameter 'path': input should be a valid string, got 0x10
> write '0x10' in quotes
  d: {use: "graph_operators:Detector", inputs: {image: camera/image}, params: {model: m, labels: [a, 2]}}
4:102: d: parameter 'labels.1': input should be a valid string, got 2
> write '2' in quotes
  c: {use: "graph_operators:CloudBuilder", params: {window: 3x}, inputs: {depth: camera/depth, image: camera/image, camera: camera/info}}
4:61: c: parameter 'window': duration '3x': unknown unit 'x'; the units are ns, us, ms, s, min, h, got 3x
> window: how far back
  d: {use: "graph_operators:Detector", inputs: {image: camera/image}}
4:3: d: parameter 'model' must be given
> model: ONNX file
  e: {use: "graph_operators:Log", inputs: {images: camera/image, image: camera/image}}
4:66: e: Log has no input 'image'
> did you mean 'images'?
  c: {use: "graph_operators:CloudBuilder", inputs: {depth: camera/depth, image: camera/image}}
4:44: c: input 'camera' (Sampled[TestLens]) is not wired
> streams of TestLens: camera/info
  e: {use: "graph_operators:Log", inputs: {images: camera/imge}}
4:52: e.images: 'camera/imge' is no stream of this graph
> did you mean 'camera/image'?
  e: {use: "graph_operators:Log", inputs: {images: camra/image}}
4:52: e.images: 'camra/image' is no stream of this graph
> did you mean 'camera/image'?
  e: {use: "graph_operators:Log", inputs: {images: camera}}
4:52: e.images: 'camera' is no stream of this graph
> name one of its ports: camera/image, camera/depth, camera/info
  e: {use: "graph_operators:Log", inputs: {images: lidar/*}}
4:52: e.images: 'lidar/*' matches no stream
> streams of TestPicture: camera/image
  e: {use: "graph_operators:Log", inputs: {images: cam*/image}}
4:52: 'cam*/image' is no key expression: in 'cam*': a '*' inside a part is written '$*' (and '*' or '**' alone is a whole part)
  e: {use: "graph_operators:Log", inputs: {images: "@/camera/image"}}
4:52: '@/camera/image' is no key expression: '@': parts that begin with '@' are the runtime's own
  e: {use: "graph_operators:Log", inputs: {images: camera/depth}}
4:52: e.images takes TestPicture, but 'camera/depth' (Camera.depth) carries TestDepth
> streams of TestPicture: camera/image
  d: {use: "graph_operators:Detector", params: {model: m}, inputs: {image: camera/*}}
4:76: d.image: it takes one stream, but 2 match: camera/depth, camera/image
> name one, or declare the input In(many=True); streams of TestPicture: camera/image
  c: {use: "graph_operators:CloudBuilder", inputs: {depth: camera/*, image: camera/image, camera: camera/info}}
4:60: c.depth: a joined input takes one stream, but 2 match: camera/depth, camera/image
> name one of them; streams of TestDepth: camera/depth
  w: {use: "graph_operators:StaticUser", inputs: {lens: camera/info}}
4:57: w.lens: 'camera/info' is static (one message, valid at all times), which cannot trigger
> the operator should declare it lens: Sampled[TestLens]
  t: {use: "graph_operators:Ticker", inputs: {lens: camera/info}}
4:38: t: Ticker ticks every 1s, but every wired input is static or 'before': the beginning and the end of ticks are unknown
> wire an input to a stream that is neither
  a: {use: "graph_operators:Echo", inputs: {pose: b/echo}}
  b: {use: "graph_operators:Echo", inputs: {pose: a/echo}}
4:51: cycle without 'before': b -> a -> b would wait for itself (its demands sum to 0s, and must be below 0)
> declare one of these inputs Sampled(before=True)
  o: {use: "graph_operators:Odometry", inputs: {image: camera/image, map: m/map}}
  m: {use: "graph_operators:Mapper", inputs: {cloud: c/cloud, pose: o/pose}}
  c: {use: "graph_operators:CloudBuilder", inputs: {depth: camera/depth, image: camera/image, camera: camera/info}}
4:75: cycle whose 'before' is too short: m -> o -> m would wait for itself (its demands sum to 19.999999ms, and must be below 0)
> lengthen it by more than that sum
  c: {use: "graph_operators:Camera", params: {path: "${env:NO_SUCH_VARIABLE_HERE}"}}
4:54: environment variable 'NO_SUCH_VARIABLE_HERE' is not set
> set it, or give a default: ${env:NO_SUCH_VARIABLE_HERE:-default}
  e: {use: "graph_operators:Log", inputs: {images: camera/image}, live: {deadline: 100}}
4:84: deadline must be a duration with a unit, such as 100ms, not the number 100
  e: {use: "graph_operators:Log", inputs: {images: camera/image}, live: {deadline: 3 weeks}}
4:84: deadline: duration '3 weeks': unknown unit 'weeks'; the units are ns, us, ms, s, min, h
  e: {use: "graph_operators:Log", inputs: {images: camera/image}, live: {queue: newst}}
4:81: queue must be one of newest, oldest, block, not the text 'newst'
> did you mean 'newest'?
  e: {use: "graph_operators:Log", inputs: {images: camera/image}, live: {wait: {image: 1s}}}
4:81: e: Log has no input 'image'
> did you mean 'images'?
  e: {use: "graph_operators:Log", inputs: {images: camera/image}, live: {memory: 2 gigs}}
4:82: memory must be a size such as 512MiB or 2GB, not the text '2 gigs'
  e: {use: "graph_operators:Log", inputs: {images: camera/image}, sync: {tolerance: 5ms}}
4:85: e: 'tolerance' means nothing here: Log has no two inputs to join
  e: {use: "graph_operators:Log", inputs: {images: camera/image}, sync: {every: 5ms}}
4:81: e: 'every' cannot be set: Log does not tick
> its class would have to say every=... (Log fires on messages only)
  a: {use: "graph_operators:Camera", process: p, machine: left}
  b: {use: "graph_operators:Camera", process: p, machine: right}
5:59: process 'p' is on two machines: a on left, b on right
> give them the same 'machine:', or different 'process:' labels
  a: {use: "graph_operators:Camera", process: p, env: one}
  b: {use: "graph_operators:Camera", process: p, env: two}
5:55: process 'p' is in two environments: a in one, b in two
> give them the same 'env:', or different 'process:' labels
  a: {use: "graph_operators:Camera", live: {clock: corrected}}
4:52: a: 'clock: corrected' is for a source on another machine (machine:)
record: {topics: [camera/imge]}
4:19: record: 'camera/imge' is no stream of this graph
> did you mean 'camera/image'?
record: some
4:9: record must be 'all' or a mapping with 'topics' or 'exclude', not the text 'some'
view: {hide: [camera/imge]}
4:15: hide: 'camera/imge' is no stream of this graph
> did you mean 'camera/image'?
view: {panels: [world, plot]}
4:24: panels must be one of world, cameras, scene, map, text, scores, plots, status, log, not the text 'plot'
> did you mean 'plots'?
view: {layout: mine.rrd}
4:16: layout must be a file of the viewer's, NAME.rbl, not the text 'mine.rrd'
network: {listen: [192.168.1.2:7447]}
4:20: listen: '192.168.1.2:7447' is no Zenoh endpoint
> protocol/address:port, such as tcp/192.168.1.2:7447 or tls/robot1.local:7447
network: {listen: [tcp/nohost]}
4:20: listen: 'tcp/nohost' has no port from 0 to 65535
> protocol/address:port, such as tcp/192.168.1.2:7447 or tls/robot1.local:7447
network: {connect: ['tcp/robot:99999']}
4:21: connect: 'tcp/robot:99999' has no port from 0 to 65535
> protocol/address:port, such as tcp/192.168.1.2:7447 or tls/robot1.local:7447
network: {connect: ['tcp/fe80::1:7447']}
4:21: connect: 'tcp/fe80::1:7447' has an IPv6 address without [ ]
> protocol/address:port, such as tcp/192.168.1.2:7447 or tls/robot1.local:7447
network: {tls: {listen_certificat: a}}
4:16: tls: Zenoh refuses it: unknown field `listen_certificat`
> did you mean 'listen_certificate'?
network: {shared_memory: yes}
4:26: shared_memory must be true or false, not the text 'yes'
  n: {use: other.yaml}
4:12: cannot read graph file 'other.yaml': not among graph.yaml
  n: {use: graph.yaml}
4:12: graph nests in itself: graph.yaml -> graph.yaml
  n: {use: graph.yaml, live: {}}
4:24: unknown key 'live' in the nested graph 'n'
> known here: use, when, inputs, params, process, machine, env
"""
WHOLE = """\
graph: g
operators: {a: [1, 2
seed: 1
3:5: not readable as YAML: expected ',' or ']', but got ':'
graph: g
operators:
\tcamera: 1
3:1: not readable as YAML: found character '\\t' that cannot start any token
> indent with spaces
# nothing
1:1: the graph file is empty
> it needs at least 'operators:'
- 1
1:1: the graph file must be a mapping, not a list
%YAML 1.1
---
graph: g
operators:
  camera: {use: "graph_operators:Camera"}
1:1: YAML directives are not part of the graph language
operators:
  camera: {use: graph_operators:Camera}
1:1: the graph has no name
> begin with 'graph: some_name'
graph: g
1:1: the graph has no operators
> add 'operators:' with at least one operator
graph: my robot
operators:
  camera: {use: graph_operators:Camera}
1:8: graph name 'my robot' contains a space
> a name is letters, digits, '_' and '-', and begins with a letter or '_'
graph: g
params: {rate: 3}
operators:
  camera: {use: graph_operators:Camera, params: {rate: ${rte}}}
4:56: unknown graph parameter 'rte'
> did you mean 'rate'?
graph: g
params: {a: '${b}', b: 1}
operators:
  camera: {use: graph_operators:Camera}
2:14: graph parameter 'b' is used before it is defined
> move it up in 'params:'
graph: g
params:
  data:
operators:
  camera: {use: graph_operators:Camera, params: {path: ${data}/x}}
5:56: graph parameter 'data' has no value
> give one: --set data=..., or a default below 'params:'
graph: g
params: {a: [1]}
operators:
  camera: {use: graph_operators:Camera, params: {path: x${a}}}
4:57: ${a} is a list, which cannot stand inside a text
graph: g
inputs: [depth]
operators:
  camera: {use: graph_operators:Camera}
2:10: graph input 'depth' is bound to nothing
> a graph with inputs runs inside another graph: name this file there with 'use:'
"""
"""What follows the head, or a whole file; the fault that is reported for it; after `> ` its hint."""


def cases(table: str, head: str) -> list[tuple[str, str, str]]:
    """(text of a graph file, fault, hint) of each case."""
    found = re.findall(r"((?:.*\n)*?)(\d+:\d+: .*)\n((?:> .*\n)*)", table)
    return [(head + text, said, hint.replace("> ", "").rstrip("\n")) for text, said, hint in found]


@pytest.mark.parametrize(("text", "said", "hint"), [*cases(BELOW_HEAD, HEAD), *cases(WHOLE, "")])
def test_fault_is_reported_at_its_place_with_a_hint(text: str, said: str, hint: str) -> None:
    found = [(f"{p.line}:{p.column}: {p.message}", p.hint) for p in problems(text)]
    assert (said, hint) in found
    if "live_of" not in said:
        others = [f for f in found if f != (said, hint)]
        assert len(others) <= (1 if "nested graph" in said else 0), f"one fault, several reports: {others}"


def test_rendering_shows_file_line_column_caret_and_suggestion() -> None:
    (problem,) = problems(
        operator('e: {use: "graph_operators:Log", inputs: {images: camera/imge}}'), file="graphs/rgbd.yaml"
    )
    assert str(problem) == (
        "graphs/rgbd.yaml:4:52: e.images: 'camera/imge' is no stream of this graph\n"
        '    4 |   e: {use: "graph_operators:Log", inputs: {images: camera/imge}}\n'
        "      |                                                    ^^^^^^^^^^^\n"
        "      did you mean 'camera/image'?"
    )


def test_duplicate_key_names_both_places() -> None:
    (problem,) = problems(operator('camera: {use: "graph_operators:Device"}'))
    assert str(problem) == (
        "graph.yaml:4:3: duplicate key 'camera'\n"
        '    4 |   camera: {use: "graph_operators:Device"}\n'
        "      |   ^^^^^^\n"
        "      graph.yaml:3:3: first given here"
    )


def test_cycle_names_each_of_its_edges() -> None:
    text = operator(
        'a: {use: "graph_operators:Echo", inputs: {pose: b/echo}}\n'
        '  b: {use: "graph_operators:Echo", inputs: {pose: a/echo}}'
    )
    (problem,) = problems(text)
    assert [(place.line, word) for place, word in problem.related] == [
        (4, "a.pose takes b/echo"),
        (5, "b.pose takes a/echo"),
    ]


def test_all_faults_are_reported_together_in_file_order() -> None:
    found = problems(
        "graph: g\nthreads: 0\noperators:\n"
        '  a: {use: "graph_operators:Camra"}\n'
        '  b: {use: "graph_operators:Camera", params: {rate: 0, pth: x}}\n'
        '  c: {use: "graph_operators:Log", inputs: {images: b/imge}, live: {queue: x}}\n'
        "record: {topics: [b/nothing]}\n"
    )
    assert [(p.line, p.column) for p in found] == [(2, 10), (4, 12), (5, 53), (5, 56), (6, 52), (6, 75), (7, 19)]


def test_streams_of_a_broken_operator_cause_no_further_faults() -> None:
    found = problems(
        'graph: g\noperators:\n  a: {use: "graph_operators:Camra"}\n'
        '  c: {use: "graph_operators:Log", inputs: {images: a/image}}\n'
        '  d: {use: "graph_operators:Log", inputs: {images: "*/image"}}\n'
    )
    assert [p.message for p in found] == ["module 'graph_operators' has no operator 'Camra'"]


def test_import_failure_of_a_module_has_its_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "broken_operators.py").write_text("x = 1\nraise RuntimeError('no camera library')\n")
    (tmp_path / "needy_operators.py").write_text("import no_such_library_at_all\n")
    monkeypatch.syspath_prepend(tmp_path)
    failing, needy = problems(
        "graph: g\noperators:\n  a: {use: 'broken_operators:A'}\n  b: {use: 'needy_operators:B'}\n"
    )
    assert failing.message == "module 'broken_operators' fails to import: RuntimeError: no camera library"
    assert failing.hint == f"raised at {tmp_path / 'broken_operators.py'}:2"
    assert needy.message == "module 'needy_operators' needs 'no_such_library_at_all', which is not installed"


@pytest.mark.parametrize(
    ("setting", "said", "hint"),
    [
        ("camera.rte=3", "1:1: camera: Camera has no parameter 'rte'", "did you mean 'rate'?"),
        (
            "camera.rate=-3",
            "1:13: camera: parameter 'rate': input should be greater than 0, got -3",
            "rate: pictures a second",
        ),
        (
            "camera.rate=fast",
            "1:13: camera: parameter 'rate': input should be a valid number, got fast",
            "rate: pictures a second",
        ),
        ("camra.rate=3", "1:1: the graph has no operator 'camra'", "did you mean 'camera'?"),
        ("rte=3", "1:1: the graph has no parameter 'rte'", "graph parameters: none"),
        (
            "camera.rate",
            "1:1: 'camera.rate' sets nothing",
            "write operator.param=value, or param=value for the graph's own",
        ),
        ("camera.rate=[1", "1:15: not readable as YAML: expected ',' or ']', but got 'the end of the file'", ""),
    ],
)
def test_fault_of_a_setting_is_shown_in_its_own_words(setting: str, said: str, hint: str) -> None:
    (problem,) = problems(HEAD, settings=[setting])
    assert (problem.file, f"{problem.line}:{problem.column}: {problem.message}", problem.hint) == ("--set", said, hint)
    assert problem.source == setting


GIVEN = """\
graph: g
params: {rate: 30, limit: 2, both: "${rate}"}
threads: ${limit}
operators:
  camera: {use: "graph_operators:Camera", params: {rate: "${both}"}}
"""


@pytest.mark.parametrize(
    ("setting", "message", "column", "used"),
    [
        ("rate=-3", "camera: parameter 'rate': input should be greater than 0, got -3", 6, "graph.yaml:5:58"),
        ("both=fast", "camera: parameter 'rate': input should be a valid number, got fast", 6, "graph.yaml:5:58"),
        ("limit=none", "threads must be a whole number from 1 to 256, not the text 'none'", 7, "graph.yaml:3:10"),
    ],
)
def test_error_of_a_setting_is_shown_in_the_setting(setting: str, message: str, column: int, used: str) -> None:
    (problem,) = problems(GIVEN, settings=[setting])

    assert (problem.file, problem.line, problem.column, problem.message) == ("--set", 1, column, message)
    assert problem.source == setting
    assert [(str(place), word) for place, word in problem.related] == [(used, "stands for it here")]


def test_fault_of_a_text_with_a_setting_in_it_stays_where_the_text_is() -> None:
    text = 'graph: g\nparams: {part: a}\noperators:\n  camera: {use: "${part}_operators:Camra"}\n'
    (problem,) = problems(text, settings=["part=graph"])

    assert str(problem).startswith("graph.yaml:4:17: module 'graph_operators' has no operator 'Camra'")


def test_graph_parameter_error_points_to_where_its_value_is_given() -> None:
    text = GIVEN.replace("rate: 30", "rate: -3")
    (problem,) = problems(text)

    assert (problem.line, problem.column) == (5, 58)
    assert [(str(place), word) for place, word in problem.related] == [("graph.yaml:2:16", "given here")]


def test_a_default_in_a_reference_is_given_where_it_stands() -> None:
    (problem,) = problems(operator('c: {use: "graph_operators:Camera", params: {rate: "${env:NO_SUCH_RATE:--3}"}}'))

    assert problem.line == 4
    assert problem.related == ()


def test_alias_bomb_is_refused_quickly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(document, "MAX_VALUES", 1_000)
    text = "graph: g\nparams:\n  a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]\n"
    for i in range(1, 9):
        text += f"  a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]\n"
    found = problems(text)
    assert any("aliases (*) multiply" in p.hint for p in found)


def test_file_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(GraphError, match=r"cannot read graph file .*nothing\.yaml'"):
        load_graph(tmp_path / "nothing.yaml")
    (tmp_path / "latin.yaml").write_bytes(b"graph: caf\xe9\n")
    with pytest.raises(GraphError, match="is not UTF-8 text"):
        load_graph(tmp_path / "latin.yaml")


def test_bundle_that_is_none_is_refused() -> None:
    with pytest.raises(GraphError, match="not a graph bundle"):
        load_bundle("{}")


def test_problems_are_json() -> None:
    (problem,) = problems(operator('camera: {use: "graph_operators:Device"}'))
    assert problem.to_json() == {
        "file": "graph.yaml",
        "line": 4,
        "column": 3,
        "message": "duplicate key 'camera'",
        "hint": "",
        "related": [{"file": "graph.yaml", "line": 3, "column": 3, "message": "first given here"}],
    }


def test_faults_that_one_extra_mends_are_counted_behind_the_first() -> None:
    hint = "it comes with: pip install 'robot-dataflow[perception]'"
    missing = [Problem("graph.yaml", line, 10, f"module 'm{line}' needs 'cv2'", hint) for line in (3, 4, 5)]
    other = Problem("graph.yaml", 6, 1, "unknown key")
    assert str(GraphError([*missing, other])).splitlines() == [
        "graph.yaml:3:10: module 'm3' needs 'cv2'",
        f"      {hint}",
        "graph.yaml:6:1: unknown key",
        f"      and 2 more: {hint}",
    ]
    assert len(GraphError(missing).problems) == 3
