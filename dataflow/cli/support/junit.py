"""Results of the regression gate as JUnit XML, for the test pages of CI systems.

One suite a recording, one case an operator. The elements and attributes are those of the schema of Ant's JUnit task,
which is the narrowest in use: what satisfies it is read by Jenkins, GitLab, GitHub actions and the rest.
"""

from __future__ import annotations

import re
import socket
from collections.abc import Callable, Iterable
from datetime import UTC, datetime
from pathlib import Path
from xml.etree import ElementTree

from dataflow.verification.gate import Checked, Judged

_FORBIDDEN = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Characters that no XML document may hold."""


def write_junit(
    file: Path,
    checked: Iterable[Checked],
    explain: Callable[[Checked, Judged], Iterable[str]],
    reservations: Callable[[Checked], Iterable[str]],
) -> None:
    """Writes the file. `explain` gives the lines about an operator that did not pass, `reservations` those about a
    recording that did."""
    root = ElementTree.Element("testsuites")
    now = datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%S")
    for number, one in enumerate(checked):
        root.append(_suite(number, one, now, explain, reservations))
    ElementTree.indent(root)
    file.parent.mkdir(parents=True, exist_ok=True)
    ElementTree.ElementTree(root).write(file, encoding="utf-8", xml_declaration=True)


def _suite(
    number: int,
    one: Checked,
    now: str,
    explain: Callable[[Checked, Judged], Iterable[str]],
    reservations: Callable[[Checked], Iterable[str]],
) -> ElementTree.Element:
    failures = sum(not j.passed for j in one.judged)
    suite = ElementTree.Element(
        "testsuite",
        name=_clean(one.name),
        package="dataflow.verify",
        id=str(number),
        timestamp=now,
        hostname=socket.gethostname() or "localhost",
        tests=str(len(one.judged) or 1),
        failures=str(failures),
        errors=str(int(one.report is None)),
        skipped="0",
        time=f"{one.wall:.3f}",
    )
    properties = ElementTree.SubElement(suite, "properties")
    ElementTree.SubElement(properties, "property", name="verdict", value=one.verdict)
    if one.report is not None:
        for name, value in (("messages", one.report.messages), ("streams", one.report.streams)):
            ElementTree.SubElement(properties, "property", name=name, value=str(value))
        for fact, then, here in one.report.facts:
            ElementTree.SubElement(
                properties, "property", name=_clean(f"differs: {fact}"), value=_clean(f"{then} → {here}")
            )
    # The operators ran side by side: the time of one alone is not known, that of the suite is.
    for judged in one.judged:
        case = ElementTree.SubElement(
            suite, "testcase", name=_clean(judged.operator), classname=_clean(one.name), time="0"
        )
        if not judged.passed:
            lines = list(explain(one, judged))
            kind = judged.verdict.replace(" ", "_")
            message = f"{judged.operator}: {judged.verdict}"
            failure = ElementTree.SubElement(case, "failure", message=_clean(message), type=kind)
            failure.text = _clean("\n".join(lines))
    if one.report is None:
        case = ElementTree.SubElement(
            suite, "testcase", name="verify", classname=_clean(one.name), time=f"{one.wall:.3f}"
        )
        error = ElementTree.SubElement(case, "error", message=_clean(one.error), type="could_not_run")
        error.text = _clean(one.details or one.error)
    ElementTree.SubElement(suite, "system-out").text = _clean("\n".join(reservations(one))) or None
    ElementTree.SubElement(suite, "system-err")
    return suite


def _clean(text: str) -> str:
    return _FORBIDDEN.sub("�", text)
