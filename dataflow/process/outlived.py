"""Reports failures that an operator or a process outlives: no other output would show where they happened."""

from __future__ import annotations

from dataflow.execution.failure import OperatorFailure
from dataflow.process.channel import Channel
from dataflow.process.log_pipe import log_failure


def tell_outlived(channel: Channel, failure: OperatorFailure, pause: float) -> None:
    """Logs the traceback of a failure, and reports to the supervisor that the operator is made anew in `pause` s.

    Raises `ChannelClosed`.
    """
    log_failure(failure)
    channel.send(
        "restarting",
        operator=failure.operator,
        when=failure.when,
        summary=failure.summary,
        where=failure.where,
        traceback=failure.traceback,
        pause=pause,
    )
