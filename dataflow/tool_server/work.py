"""One call of a tool, in its own process: the request on standard input, lines of JSON on standard output.

What operators print goes to standard error.
"""

from __future__ import annotations

import json
import os
import sys
import traceback
from typing import Any

from dataflow.extras import missing_extra
from dataflow.text import json_text


def main() -> None:
    """Answers one request."""
    request = json.loads(sys.stdin.readline())
    with os.fdopen(os.dup(1), "w", encoding="utf-8", buffering=1) as answers:
        os.dup2(2, 1)

        def say(text: str) -> None:
            answers.write(json_text({"progress": text}) + "\n")

        answers.write(json_text(_answer(request, say)) + "\n")


def _answer(request: dict[str, Any], say: Any) -> dict[str, Any]:
    from dataflow.tool_server.tools import answer

    try:
        return {"answer": answer(request["tool"], request["arguments"], say)}
    except (Exception, SystemExit) as error:
        return {"error": explained(error)}


def explained(error: BaseException) -> str:
    """Returns what an error is: its message for one of ours, also the place for another; how to get what is missing."""
    text = str(error) or type(error).__name__
    expected = isinstance(error, ValueError | ImportError) or type(error).__module__.startswith("dataflow.")
    if not expected:
        place = traceback.extract_tb(error.__traceback__)[-1]
        text = f"{type(error).__name__}: {text} ({place.filename}:{place.lineno})"
    details = getattr(error, "details", "")
    return "\n".join(part for part in (text, str(details).strip(), missing_extra(error)) if part)


if __name__ == "__main__":
    main()
