"""Questions to a scene graph, from Python and on the command line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from made_graphs import scene_graph
from made_towers import write_row
from typer.testing import CliRunner

from dataflow.graph import load_graph
from dataflow.messages import FeatureVector, SceneGraph
from dataflow.recording import RecordingWriter
from dataflow.reexecution.recorded_run import graph_metadata
from operators.labels import LabelSpace, labels_file
from operators.scene.commands import scene
from operators.scene.graph.query import _MEANT, _PHRASES, Clause, QueryError, as_json, ask, parse
from operators.scene.graph.spark import as_spark_dsg

GRAPHS = Path(__file__).resolve().parents[4] / "graphs"
NAMES = ("mug", "table", "person", "floor", "room")
NODES = ((-2, "room"), (0, "floor"), (1, "table"), (2, "mug"), (3, "mug"), (4, "person"), (5, "table"))
RELATIONS = ((2, "on", 1, 0.9), (3, "on", 0, 0.8), (2, "near", 4, 0.7), (1, "left_of", 5, 0.6), (4, "holding", 3, 0.4))


def graph(stamp: int = 1_000_000_000) -> SceneGraph:
    """Two tables, two mugs, a person: mug 2 is on table 1 near person 4, mug 3 on the floor."""
    ids = [id for id, _ in NODES]
    return scene_graph(
        [(id, name, (3.0 * k, 3.0 * k + 1, 3.0 * k + 2), (1, 1, 1)) for k, (id, name) in enumerate(NODES)],
        RELATIONS,
        stamp=stamp,
        class_names=NAMES,
        class_ids=np.array([NAMES.index(name) for _, name in NODES], np.int32),
        scores=np.full(len(NODES), 0.95, np.float32),
        tracks=np.array([12, 31, 7]),
        track_nodes=np.array([ids.index(i) for i in (2, 2, 4)], np.int32),
    )


@pytest.mark.parametrize(
    ("question", "ids"),
    [
        ("mug on table near person", [2]),
        ("the mug that is on a floor", [3]),
        ("table supports mug", [1]),
        ("table right of table 1", [5]),
        ("mug not on table", [3]),
        ("person near mug", [4]),
        ("anything on anything", [2, 3]),
        ("person holding mug 3", [4]),
        ("mug 2", [2]),
        ("person on table", []),
    ],
)
def test_query_finds_the_matching_nodes(question: str, ids: list[int]) -> None:
    made = graph()
    assert [int(made.ids[m.node]) for m in ask(made, question)] == ids


def test_the_score_is_that_of_the_weakest_link() -> None:
    assert ask(graph(), "mug on table near person")[0].score == pytest.approx(0.7)


def test_relations_of_several_words_are_understood() -> None:
    assert parse("mug in front of table and not left_of person", NAMES) == (
        "mug",
        [Clause("in_front_of", "table"), Clause("left_of", "person", False)],
    )


@pytest.mark.parametrize(
    ("question", "words"),
    [
        ("mugg on table", "did you mean 'mug'"),
        ("mug nearr table", "'nearr' is no relation; did you mean 'near'"),
        ("mug inside table", "did you mean 'in'"),
        ("mug on top of table", "'on top of' is no relation; did you mean 'on'"),
        ("mug below table", "did you mean 'under'"),
        ("mug left table", "did you mean 'left of'"),
        ("mug nearr table", "there are above, approaching, behind, connected to, facing, heads for"),
        ("mug xyzzy table", "'xyzzy' is no relation; there are above"),
        ("mug not", "ends where a relation should be named; there are above"),
        ("mug on", "ends where a thing should be named"),
        ("", "the question is empty"),
    ],
)
def test_unparsable_query_is_refused_by_name(question: str, words: str) -> None:
    with pytest.raises(QueryError, match=words):
        ask(graph(), question)


COCO = LabelSpace.read(Path(labels_file("coco")))


@pytest.mark.parametrize(
    ("question", "ids"),
    [
        ("cup on dining table", [2, 3]),
        ("mug on table", [2, 3]),  # on a table top, too, of a table that may be unseen
        ("mug on desk 1", [2]),
        ("mug not on table", []),
        ("cup on tabletop", [3]),
        ("cup on tabletop 1", [3]),
        ("table supports mug", [1]),
        ("desk", [1]),
        ("human near screen", [4]),
        ("anything near TV monitor", [4]),
    ],
)
def test_other_names_of_classes_are_those_of_the_label_space(question: str, ids: list[int]) -> None:
    """Cup 2 is on table 1, cup 3 on a table top; person 4 is near a television."""
    made = graph().replace(
        class_names=("cup", "dining table", "person", "tabletop", "room", "tv"),
        ids=np.array([-2, -11, 1, 2, 3, 4, 5]),
        class_ids=np.array([4, 3, 1, 0, 0, 2, 5], np.int32),
        labels=("room", "tabletop 1", "dining table 1", "cup 2", "cup 3", "person 4", "tv 5"),
        predicates=("on", "on", "near"),
        subjects=np.array([3, 4, 5], np.int32),
        objects=np.array([2, 1, 6], np.int32),
        relation_scores=np.array([0.9, 0.8, 0.7], np.float32),
    )
    assert sorted(int(made.ids[m.node]) for m in ask(made, question, COCO)) == ids
    with pytest.raises(QueryError, match="'sofa' is no class of this graph"):
        ask(made, "cup on sofa", COCO)


def test_a_class_of_the_very_name_comes_before_one_that_is_called_so_too() -> None:
    made = graph().replace(class_names=("cup", "table", "person", "mug", "desk"))
    assert [int(made.ids[m.node]) for m in ask(made, "desk", COCO)] == [-2]
    assert sorted(int(made.ids[m.node]) for m in ask(made, "dining table", COCO)) == [-2, 1, 5]


def test_suggested_relations_exist_and_shadow_no_relation() -> None:
    assert set(_MEANT.values()) <= set(_PHRASES)
    assert not set(_MEANT) & set(_PHRASES)


def test_the_graph_as_json_names_layers_and_scores() -> None:
    made = as_json(graph())
    assert {n["name"]: n["layer"] for n in made["nodes"]}["room -2"] == "room"
    assert {n["id"]: n["tracks"] for n in made["nodes"] if n["tracks"]} == {2: [12, 31], 4: [7]}
    assert made["relations"][0] == {"subject": 2, "predicate": "on", "object": 1, "score": 0.9}
    json.dumps(made)


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    file = tmp_path / "room.mcap"
    with RecordingWriter(file, metadata={}) as writer:
        writer.add_stream("robot1/scene/graph", SceneGraph)
        for k in range(3):
            writer.write("robot1/scene/graph", graph((k + 1) * 1_000_000_000), seq=k)
    return file


def asked(*words: str) -> tuple[int, str]:
    """The exit code, and the output in one line."""
    done = CliRunner().invoke(scene, list(words))
    return done.exit_code, " ".join(done.output.split())


def test_the_command_answers_from_a_recording(recording: Path) -> None:
    said = "mug 2 at (9.00, 10.00, 11.00) m, score 0.70: on table 1; near person 4"
    assert asked(str(recording), "--query", "mug on table near person") == (0, said)
    assert asked(str(recording), "--query", "person on table")[0] == 1
    answer = json.loads(asked(str(recording), "--at", "1.2", "--query", "mug", "--json")[1])
    assert (answer["stamp"], [m["id"] for m in answer["matches"]]) == (2_000_000_000, [2, 3])


@pytest.mark.parametrize("there", [True, False])
def test_query_command_uses_the_label_space_of_the_recorded_graph(tmp_path: Path, there: bool) -> None:
    own = tmp_path / "own.yaml"
    own.write_text("label_space: own\nunit: m\nlabels:\n  mug: {aliases: [teacup]}\n")
    made = load_graph(GRAPHS / "perception_rgbd.yaml", settings=[f"labels={own}"])
    (stream,) = (name for name in made.streams if name.endswith("scene/graph"))
    with RecordingWriter(tmp_path / "room.mcap", metadata=graph_metadata(made)) as writer:
        writer.add_stream(stream, SceneGraph)
        writer.write(stream, graph(), seq=0)
    if not there:
        own.unlink()
    code, out = asked(str(tmp_path / "room.mcap"), "--query", "teacup on table")
    assert (code, ("mug 2" if there else "label space cannot be read") in out) == (0 if there else 2, True)


def test_an_export_is_not_replaced_unasked(recording: Path, tmp_path: Path) -> None:
    file = tmp_path / "out" / "scene.json"
    words = (str(recording), "--export", str(file))
    assert asked(*words)[0] == 0
    made = file.read_bytes()
    file.write_text("mine")
    code, out = asked(*words)
    assert (code, file.read_text()) == (2, "mine")
    assert "--overwrite" in out
    assert asked(*words, "--overwrite")[0] == 0
    assert file.read_bytes() == made
    assert asked(*words[:2], str(tmp_path))[0] == 2  # a folder


@pytest.mark.parametrize(
    ("words", "code", "told"),
    [
        (["--query", "cup on table"], 2, "'cup' is no class of this graph"),
        (["--query", "something to drink from"], 2, "'to' is no relation"),
        (["--query", "something to drink from"], 2, "no embeddings; dataflow models get clip_vit_b32, then run"),
        (["--stream", "other"], 2, "robot1/scene/graph"),
        (["--at", "99"], 0, "nothing is newer than 2.0 s"),
        ([], 0, "who does what"),
        ([], 0, "what carries what"),
        (["--nodes"], 0, "position, m"),
        (["--nodes"], 0, "holding"),
        (["--nodes"], 0, "12, 31"),
    ],
)
def test_command_shows_the_graph_or_names_the_error(recording: Path, words: list[str], code: int, told: str) -> None:
    found, out = asked(str(recording), *words)
    assert (found, told in out) == (code, True)
    assert ("newer" in out) == (words[:1] == ["--at"])


@pytest.mark.parametrize(("there", "told"), [(False, "there is no file"), (True, "holds no scene graph")])
def test_a_recording_without_a_graph_is_refused(tmp_path: Path, there: bool, told: str) -> None:
    if there:
        with RecordingWriter(tmp_path / "run.mcap", metadata={}):
            pass
    code, out = asked(str(tmp_path / "run.mcap"))
    assert (code, told in out) == (2, True)


def embedded(folder: Path, model: str = "colors-0123") -> Path:
    """The recording with vectors: mug 2 becomes blue, mug 3 is red, table 1 green and red; tracks have others."""
    seen = [{2: (1, 0, 0), 3: (1, 0, 0)}, {1: (0.6, 0.8, 0)}, {2: (0, 0, 1)}, {3: (0, 0, 1)}]
    file = folder / f"{model}.mcap"
    with RecordingWriter(file, metadata={}) as writer:
        writer.add_stream("robot1/scene/graph", SceneGraph)
        for name in ("robot1/meaning/means", "robot1/tracker/looks", "robot2/meaning/means"):
            writer.add_stream(name, FeatureVector)
        for k, known in enumerate(seen):
            stamp = (k + 1) * 1_000_000_000
            vectors = np.array([*known.values()], np.float32)
            made = FeatureVector(stamp=stamp, model=model, vectors=vectors, ids=np.array([*known], np.int64))
            writer.write("robot1/meaning/means", made, seq=k)
            for other in ("robot1/tracker/looks", "robot2/meaning/means"):
                writer.write(other, made.replace(vectors=-vectors), seq=k)
            if k < 3:
                writer.write("robot1/scene/graph", graph(stamp), seq=k)
    return file


@pytest.fixture
def colors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A registry with an image-text network, and its cache."""
    pytest.importorskip("onnx")
    monkeypatch.setenv("DATAFLOW_MODELS", str(write_row(tmp_path)))
    monkeypatch.setenv("DATAFLOW_MODEL_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def test_free_text_ranks_the_nodes_by_meaning(tmp_path: Path, colors: Path) -> None:
    file = embedded(tmp_path)
    _, out = asked(str(file), "--query", "something red to drink from", "--json")
    matches = [(m["id"], m["score"]) for m in json.loads(out[out.index("{") :])["matches"]]
    assert matches == [(3, 1.0), (1, 0.6), (2, 0.0)]
    code, out = asked(str(file), "--query", "blue thing")
    assert code == 0
    assert "note: by meaning, since 'blue' is no class of this graph" in out
    assert "mug 2 at (9.00, 10.00, 11.00) m, score 1.00" in out
    assert "by meaning" not in asked(str(file), "--query", "mug on table")[1]
    _, out = asked(str(file), "--at", "0.5", "--query", "red one", "--json")  # when mug 2 was red, and the table unseen
    assert [m["id"] for m in json.loads(out[out.index("{") :])["matches"]] == [2, 3]


def test_a_model_without_text_and_one_that_is_not_here_are_named(tmp_path: Path, colors: Path) -> None:
    code, out = asked(str(embedded(tmp_path, "torchvision-resnet50-own")), "--query", "red one")
    assert (code, "no row of `dataflow models list` has text in that space" in out) == (2, True)
    (colors / "colors.text.onnx").unlink()
    code, out = asked(str(embedded(tmp_path)), "--query", "red one")
    assert (code, "dataflow models get colors.text" in out) == (2, True)


def test_a_surface_is_asked_for_by_its_name_and_has_its_layer() -> None:
    made = graph()
    names = ["room", "floor", "table 1", "mug 2", "mug 3", "person 4", "wall 1"]
    made = made.replace(
        class_names=(*NAMES, "wall"),
        ids=np.array([*made.ids[:-1], -11]),
        class_ids=np.array([*made.class_ids[:-1], len(NAMES)], np.int32),
        labels=tuple(names),
    )
    assert [int(made.ids[m.node]) for m in ask(made, "wall 1")] == [-11]
    assert [int(made.ids[m.node]) for m in ask(made, "table left of wall 1")] == [1]
    layers = {node["name"]: node["layer"] for node in as_json(made)["nodes"]}
    assert (layers["wall 1"], layers["floor"], layers["room"]) == ("surface", "surface", "room")
    exported = {node["attributes"]["name"]: node for node in as_spark_dsg(made)["nodes"]}
    assert {name for name, node in exported.items() if node["layer"] == 3} == {"wall 1", "floor"}
    assert len({node["id"] for node in exported.values()}) == len(names)


def test_the_export_has_every_node_its_layer_and_one_edge_for_two_nodes(tmp_path: Path) -> None:
    exported = as_spark_dsg(graph())
    names = {node["id"]: node["attributes"]["name"] for node in exported["nodes"]}
    assert len(names) == len(NODES)
    assert [node["attributes"]["name"] for node in exported["nodes"] if node["layer"] == 4] == ["room -2"]
    pairs = [frozenset((edge["source"], edge["target"])) for edge in exported["edges"]]
    assert len(pairs) == len(set(pairs)) == len(RELATIONS) + len(NODES) - 1
    told = [relation for edge in exported["edges"] for relation in edge["info"]["metadata"]["relations"]]
    assert "mug 2 on table 1" in told


def test_spark_dsg_opens_the_export(tmp_path: Path) -> None:
    spark_dsg = pytest.importorskip("spark_dsg", reason="spark-dsg is not installed")
    file = tmp_path / "graph.json"
    file.write_text(json.dumps(as_spark_dsg(graph())))
    opened = spark_dsg.DynamicSceneGraph.load(str(file))
    assert opened.num_nodes() == len(NODES)
    mug = opened.get_node(spark_dsg.NodeSymbol("O", 2).value)
    assert mug.attributes.name == "mug 2"
    np.testing.assert_allclose(mug.attributes.position, graph().positions[3])
    assert opened.get_labelspace(2, 0).get_category(mug.attributes.semantic_label) == "mug"
