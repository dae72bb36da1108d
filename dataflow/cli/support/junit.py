"""Results of the regression gate as JUnit XML, for the test pages of CI systems.

One suite a recording, one case an operator. The elements and attributes are those of the schema of Ant's JUnit task,
which is the narrowest in use: what satisfies it is read by Jenkins, GitLab, GitHub actions and the rest.
"""

from __future__ import annotations

import re
import socket
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path
from xml.etree import ElementTree

from dataflow.cli.support.verdicts import explain, reservations
from dataflow.verification.gate import Checked

_FORBIDDEN = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Characters that no XML document may hold."""


def write_junit(file: Path, checked: Iterable[Checked]) -> None:
    """Writes the file."""
    root = ElementTree.Element("testsuites")
    now = datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%S")
    for number, one in enumerate(checked):
        root.append(_suite(number, one, now))
    ElementTree.indent(root)
    file.parent.mkdir(parents=True, exist_ok=True)
    ElementTree.ElementTree(root).write(file, encoding="utf-8", xml_declaration=True)


def _suite(number: int, one: Checked, now: str) -> ElementTree.Element:
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
    facts: dict[str, str] = {"verdict": one.verdict}
    if one.report is not None:
        facts |= {"messages": str(one.report.messages), "streams": str(one.report.streams)}
        facts |= {f"differs: {fact}": f"{then} → {here}" for fact, then, here in one.report.facts}
    properties = ElementTree.SubElement(suite, "properties")
    for name, value in facts.items():
        ElementTree.SubElement(properties, "property", name=_clean(name), value=_clean(value))
    # The operators ran side by side: the time of one alone is not known, that of the suite is.
    for judged in one.judged:
        case = ElementTree.SubElement(
            suite, "testcase", name=_clean(judged.operator), classname=_clean(one.name), time="0"
        )
        if not judged.passed:
            message, kind = f"{judged.operator}: {judged.verdict}", judged.verdict.replace(" ", "_")
            failure = ElementTree.SubElement(case, "failure", message=_clean(message), type=kind)
            failure.text = _clean("\n".join(explain(one, judged)))
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
