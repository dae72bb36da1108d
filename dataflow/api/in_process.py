"""Verification's calls in this process, for operators that no other process finds."""

from __future__ import annotations

import importlib
import os
import traceback
from collections.abc import Sequence
from contextlib import closing
from typing import Any

from dataflow.execution.threads import limited_threads
from dataflow.supervision.core.report import RunFailed
from dataflow.verification.workers.board import Board
from dataflow.verification.workers.job_file import read_job_file, write_job_file
from dataflow.verification.workers.processes import Call


def call_here(calls: Sequence[Call], *, threads: int, **watching: Any) -> list[Any]:
    """The answers to `calls`, one after the other, unsupervised. Raises `RunFailed` as workers do."""
    with limited_threads(threads):
        return [_answer(call) for call in calls]


def _answer(call: Call) -> Any:
    module, _, name = call.function.partition(":")
    function = getattr(importlib.import_module(module), name)
    shared, job_file = os.memfd_create("board"), os.memfd_create("answer")
    try:
        with closing(Board(shared, call.operators)) as board:
            write_job_file(job_file, call.request)  # a worker gets plain values, too
            write_job_file(job_file, {"value": function(read_job_file(job_file), board)})
        return read_job_file(job_file)["value"]
    except Exception as error:
        own: str | None = getattr(error, "traceback", None)
        text = "".join(traceback.format_exception(error)) if own is None else own
        raise RunFailed(str(error) or type(error).__name__, text, getattr(error, "operator", None)) from error
    finally:
        os.close(shared)
        os.close(job_file)
