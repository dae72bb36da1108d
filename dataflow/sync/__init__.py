"""Event time: stamps, frontiers, and the aligner that decides when operators fire. Pure: no clock, no thread, no
I/O."""

from typing import TYPE_CHECKING

from dataflow.lazy import lazily

if TYPE_CHECKING:
    from dataflow.sync.aligner import Aligner, StreamEnd
    from dataflow.sync.demand import Cycle, Edge, stuck_cycle
    from dataflow.sync.drops import DropLog
    from dataflow.sync.entries import (
        MISSES,
        TICK,
        Drop,
        DropReason,
        Entry,
        Firing,
        FiringKind,
        InputValue,
        StreamOrderError,
        Waiting,
    )
    from dataflow.sync.recorded import RecordedAligner, Uses
    from dataflow.sync.refs import FiringInputs, InputRef, MessageRef, RunRef, input_refs, messages_of, refs_of
    from dataflow.sync.spec import AlignSpec, BatchSpec, SampledSpec, TriggerSpec
    from dataflow.sync.stamps import FOREVER, NEVER, format_duration, format_stamp, parse_duration, trail
else:
    __getattr__, __dir__ = lazily(
        __name__,
        {
            "aligner": ("Aligner", "StreamEnd"),
            "demand": ("Cycle", "Edge", "stuck_cycle"),
            "drops": ("DropLog",),
            "entries": (
                "MISSES",
                "TICK",
                "Drop",
                "DropReason",
                "Entry",
                "Firing",
                "FiringKind",
                "InputValue",
                "StreamOrderError",
                "Waiting",
            ),
            "recorded": ("RecordedAligner", "Uses"),
            "refs": ("FiringInputs", "InputRef", "MessageRef", "RunRef", "input_refs", "messages_of", "refs_of"),
            "spec": ("AlignSpec", "BatchSpec", "SampledSpec", "TriggerSpec"),
            "stamps": ("FOREVER", "NEVER", "format_duration", "format_stamp", "parse_duration", "trail"),
        },
    )

__all__ = [
    "FOREVER",
    "MISSES",
    "NEVER",
    "TICK",
    "AlignSpec",
    "Aligner",
    "BatchSpec",
    "Cycle",
    "Drop",
    "DropLog",
    "DropReason",
    "Edge",
    "Entry",
    "Firing",
    "FiringInputs",
    "FiringKind",
    "InputRef",
    "InputValue",
    "MessageRef",
    "RecordedAligner",
    "RunRef",
    "SampledSpec",
    "StreamEnd",
    "StreamOrderError",
    "TriggerSpec",
    "Uses",
    "Waiting",
    "format_duration",
    "format_stamp",
    "input_refs",
    "messages_of",
    "parse_duration",
    "refs_of",
    "stuck_cycle",
    "trail",
]
