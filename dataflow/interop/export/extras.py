"""Attachments and metadata records of MCAP files on their way into another format."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import replace
from itertools import zip_longest

from mcap.writer import Writer

from dataflow.interop.export.report import Exported
from dataflow.interop.export.source import ExportSource
from dataflow.interop.mcap_bag import McapBag
from dataflow.recording.layout import RESERVED_METADATA
from dataflow.recording.mcap.attachments import Attachment, names_once, tells_of_run
from dataflow.recording.mcap.index import McapFile

RUN_FACTS = "metadata of the run"
ROSBAG2 = "rosbag2"
"""The metadata record in which rosbag2 keeps a bag's own summary."""


class Extras:
    """Attachments and metadata records of a source's files, under the names that they get in one file.

    Of several files (a split bag), what they hold equally is there once, and other content of one name is called
    `FILE/NAME`. `runs`: metadata records that describe a run of ours, which a conversion does not keep.
    """

    def __init__(self, source: ExportSource) -> None:
        files = source.bag.files if isinstance(source.bag, McapBag) else ()
        self._files = list(files)
        listed = [[(n, v) for n, v in f.metadata if source.foreign or not tells_of_run(n)] for f in files]
        names_of_all = {name for f in files for name, _ in f.metadata}
        kept = {name for one in listed for name, _ in one}
        self.runs = len(names_of_all - kept - RESERVED_METADATA)
        labels = [f.path.stem for f in files]
        names = names_once(
            [
                (label, [(name, tuple(sorted(values.items()))) for name, values in one])
                for label, one in zip(labels, listed, strict=True)
            ]
        )
        self.metadata: list[tuple[str, dict[str, str]]] = [
            (name, values)
            for one, chosen in zip(listed, names, strict=True)
            for (_, values), name in zip(one, chosen, strict=True)
            if name is not None
        ]
        """Name and values of each record."""
        attached = [[(a.name, a.key) for a in map(f.attachment, f.attachments)] for f in files]
        self._names = names_once(list(zip(labels, attached, strict=True)))
        self.names = [name for chosen in self._names for name in chosen if name is not None]
        """The names of the attachments."""

    def attachments(self) -> Iterator[Attachment]:
        """The attachments, one in memory at a time."""
        for file, chosen in zip(self._files, self._names, strict=True):
            yield from _renamed(file, chosen)


def _renamed(file: McapFile, names: Collection[str | None]) -> Iterator[Attachment]:
    for place, name in zip_longest(file.attachments, names):
        if name is not None:
            yield replace(file.attachment(place), name=name)


def carry(source: ExportSource, writer: Writer, done: Exported, *, without: Collection[str] = ()) -> None:
    """Writes attachments and metadata records into an MCAP file; records called as in `without` are left out."""
    extras = Extras(source)
    for name, values in extras.metadata:
        if name in without:
            done.left_out[f"metadata {name}"] = "it describes the file that it was in, and is written anew"
        else:
            writer.add_metadata(name, values)
            done.metadata += 1
    for found in extras.attachments():
        writer.add_attachment(found.created, found.log_time, found.name, found.media_type, found.data)
        done.attachments += 1
    tell_runs(extras, done)


def tell_left_out(source: ExportSource, what: str, done: Exported) -> None:
    """Reports which attachments and metadata records a format has no place for."""
    extras = Extras(source)
    for name in extras.names:
        done.left_out[f"attachment {name}"] = f"{what} has no place for it"
    for name, _ in extras.metadata:
        done.left_out[f"metadata {name}"] = f"{what} has no place for it"


def tell_runs(extras: Extras, done: Exported) -> None:
    """Notes in `done` that the metadata of a run are not carried over."""
    if extras.runs:
        describe = "record describes" if extras.runs == 1 else "records describe"
        done.left_out[RUN_FACTS] = f"{extras.runs} {describe} the run and its firing records, which stay behind"
