"""The meaning of a scene: objects and their relations, what is being done, appearance and language features."""

from __future__ import annotations

from dataflow.messages.arrays import F32, F64, I32, I64
from dataflow.messages.base import Message, array, scalar
from dataflow.messages.checks import (
    class_columns,
    parallel,
    table_indices,
    together,
    unique,
    unit_quaternions,
    within,
    within_length,
)
from dataflow.messages.detection import CLASS_NAMES, labels_of


class SceneGraph(Message):
    """Objects (nodes) and their relations (edges: subject, predicate, object)."""

    frame: str = scalar("str", "frame of the positions")
    class_names: tuple[str, ...] = scalar("strs", CLASS_NAMES, default=())
    labels: tuple[str, ...] = scalar("strs", "name of each node, or empty where nodes have no names", default=())
    predicates: tuple[str, ...] = scalar("strs", "predicate of each relation, such as `on` or `next to`", default=())
    ids: I64 = array("int64", "N", "identity of each node over time, unique")
    class_ids: I32 = array("int32", "N", "class of each node, an index into `class_names`")
    positions: F64 = array("float64", "N 3", "middle of each node", unit="m")
    sizes: F64 = array("float64", "N 3", "full extents along the node's own x, y and z", unit="m")
    orientations: F64 | None = array(
        "float64", "N 4", "unit quaternions (x, y, z, w) that map the node's axes to `frame`", default=None
    )
    scores: F32 | None = array("float32", "N", "confidence in each node, [0, 1]", default=None)
    last_seen: I64 | None = array(
        "int64", "N", "event time at which each node was last observed", unit="ns", default=None
    )
    subjects: I32 = array("int32", "M", "subject of each relation, an index into the nodes")
    objects: I32 = array("int32", "M", "object of each relation, an index into the nodes")
    relation_scores: F32 | None = array("float32", "M", "confidence in each relation, [0, 1]", default=None)
    moving: F32 | None = array(
        "float32",
        "N",
        "probability that each node moves, [0, 1]; NaN where that is left to its places",
        default=None,
        added=True,
    )
    areas: F32 | None = array(
        "float32",
        "N",
        "floor of each node that is a room, as far as it was seen; NaN for other nodes",
        unit="m²",
        default=None,
        added=True,
    )
    tracks: I64 | None = array(
        "int64", "T", "ids of tracks in images that are of nodes, by node, latest last", default=None, added=True
    )
    track_nodes: I32 | None = array(
        "int32", "T", "node of each of these tracks, an index into the nodes", default=None, added=True
    )

    def validate(self) -> None:
        nodes, relations = len(self.ids), len(self.subjects)
        unique(self, "ids")
        table_indices(self, "class_ids", "class_names")
        parallel(self, "labels", nodes, "ids", empty=True)
        parallel(self, "predicates", relations, "subjects")
        within_length(self, "subjects", nodes, f"index the {nodes} nodes")
        within_length(self, "objects", nodes, f"index the {nodes} nodes")
        together(self, "tracks", "track_nodes")
        within_length(self, "track_nodes", nodes, f"index the {nodes} nodes")
        within(self, 0.0, float("inf"), "sizes")
        within(self, 0.0, 1.0, "scores", "relation_scores")
        within(self, 0.0, 1.0, "moving", nan=True)
        within(self, 0.0, float("inf"), "areas", nan=True)
        unit_quaternions(self, "orientations")

    @property
    def count(self) -> int:
        """Number of nodes."""
        return len(self.ids)

    def names(self) -> tuple[str, ...]:
        """Returns what to call each node: its label, else its class name and id."""
        if self.labels:
            return self.labels
        words = labels_of(self.class_ids, self.class_names)
        return tuple(f"{word} {i}" for word, i in zip(words, self.ids.tolist(), strict=True))

    def tracks_of(self, node: int) -> tuple[int, ...]:
        """Returns the ids of the tracks that are of a node (an index), latest last."""
        if self.tracks is None:
            return ()
        return tuple(self.tracks[self.track_nodes == node].tolist())

    def relations(self) -> tuple[tuple[int, str, int], ...]:
        """(subject, predicate, object) of every relation, as node indices."""
        return tuple(zip(self.subjects.tolist(), self.predicates, self.objects.tolist(), strict=True))


class Activity(Message):
    """Activities of subjects (tracks, people, the robot)."""

    class_names: tuple[str, ...] = scalar(
        "strs", "name of each activity, indexed by class id; empty where they have no names", default=()
    )
    goals: tuple[str, ...] = scalar("strs", "goal of each subject as text, or empty where none is inferred", default=())
    subjects: I64 = array("int64", "N", "id of each subject, as in the tracks or the scene graph")
    class_ids: I32 = array("int32", "N", "activity of each subject, an index into `class_names`")
    scores: F32 = array("float32", "N", "confidence, [0, 1]")
    probabilities: F32 | None = array("float32", "N C", "probability of every activity, [0, 1]", default=None)
    objects: I64 | None = array("int64", "N", "id of the object acted upon, -1 for none", default=None)
    since: I64 | None = array("int64", "N", "event time at which each activity began", unit="ns", default=None)

    def validate(self) -> None:
        parallel(self, "goals", len(self.subjects), "subjects", empty=True)
        table_indices(self, "class_ids", "class_names")
        within(self, 0.0, 1.0, "scores", "probabilities")
        class_columns(self, "probabilities")

    @property
    def count(self) -> int:
        """Number of subjects."""
        return len(self.subjects)


class Classification(Message):
    """Classes of whole images (N = 1) or of the objects found in them."""

    frame: str = scalar("str", "frame of the sensor; empty where none applies", default="")
    class_names: tuple[str, ...] = scalar("strs", CLASS_NAMES, default=())
    class_ids: I32 = array("int32", "N", "the likeliest class, an index into `class_names`")
    scores: F32 = array("float32", "N", "its probability, [0, 1]")
    probabilities: F32 | None = array("float32", "N C", "probability of every class, [0, 1]", default=None)
    ids: I64 | None = array("int64", "N", "what each row is about, detection or track; None: the image", default=None)

    def validate(self) -> None:
        table_indices(self, "class_ids", "class_names")
        within(self, 0.0, 1.0, "scores", "probabilities")
        class_columns(self, "probabilities")

    def labels(self) -> tuple[str, ...]:
        """The name of each row's class (its number where classes have no names)."""
        return labels_of(self.class_ids, self.class_names)


class FeatureVector(Message):
    """Embeddings: of a whole image (N = 1), of the objects found in it, of places or of text."""

    frame: str = scalar("str", "frame of the sensor; empty where none applies", default="")
    model: str = scalar("str", "name and version of the model that made the vectors: only equal names are comparable")
    labels: tuple[str, ...] = scalar("strs", "what each vector stands for, or empty", default=())
    vectors: F32 = array("float32", "N D", "one embedding per row")
    ids: I64 | None = array("int64", "N", "what each vector belongs to: detection, track or node id", default=None)

    def validate(self) -> None:
        if self.labels:
            parallel(self, "labels", len(self.vectors), "vectors")

    @property
    def count(self) -> int:
        """Number of vectors."""
        return len(self.vectors)
