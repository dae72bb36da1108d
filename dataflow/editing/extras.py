"""Attachments and metadata records of several files on their way into one."""

from __future__ import annotations

from collections.abc import Hashable, Sequence

from dataflow.editing.report import Edited
from dataflow.recording.attachments import names_once, tells_of_run
from dataflow.recording.copying import Copy, Origin

Items = list[tuple[str, Hashable]]


def is_fact(origin: Origin, name: str) -> bool:
    """Returns whether a metadata record of `origin` describes its run, rather than being added later."""
    return origin.own and tells_of_run(name)


def take_over(
    copy: Copy, origins: Sequence[Origin], labels: Sequence[str], done: Edited, *, joined: bool = False
) -> None:
    """Writes the attachments of all files, and their metadata records but for those that describe the first one's run.

    What two files hold equally is taken once. Of one name and other content, the later file's is kept as `LABEL/NAME`,
    with the label of that file, or its stem where that is empty. So are records that describe a later file's run,
    unless the files are parts of one (`joined`). Renamed ones are noted.
    """
    called = [label or origin.path.stem for label, origin in zip(labels, origins, strict=True)]
    attached: list[Items] = [
        [(found.name, found.key) for found in map(origin.file.attachment, origin.file.attachments)]
        for origin in origins
    ]
    names = names_once(list(zip(called, attached, strict=True)))
    for origin, items, chosen in zip(origins, attached, names, strict=True):
        copy.attachments(origin, chosen)
        _tell("attachment", origin, [name for name, _ in items], chosen, done)
    done.attachments = copy.attached

    records = [
        [
            (f"{label}/{name}" if is_fact(origin, name) else name, values)
            for name, values in origin.records()
            if not is_fact(origin, name) or (number and not joined)
        ]
        for number, (origin, label) in enumerate(zip(origins, called, strict=True))
    ]
    contents: list[Items] = [[(name, tuple(sorted(values.items()))) for name, values in listed] for listed in records]
    names = names_once(list(zip(called, contents, strict=True)))
    for origin, listed, chosen in zip(origins, records, names, strict=True):
        for (_, values), name in zip(listed, chosen, strict=True):
            if name is not None:
                copy.writer.add_metadata(name, values)
        _tell("metadata", origin, [name for name, _ in listed], chosen, done)


def _tell(what: str, origin: Origin, names: Sequence[str], chosen: Sequence[str | None], done: Edited) -> None:
    for name, given in zip(names, chosen, strict=True):
        if given not in (name, None):
            done.notes.append(
                f"{what} {name!r} of {origin.path.name} differs from that of a file before it: kept as {given!r}"
            )
