"""Numbers, texts, switches and alarms."""

from __future__ import annotations

import pytest
from foxglove_schemas_protobuf.Log_pb2 import Log

from dataflow.messages import Alarm
from dataflow.messages.values import ALARM_LEVELS
from dataflow.recording.streams.codecs import SchemaText, codec_for
from dataflow.recording.streams.foreign import foreign_decoder


def test_the_severity_of_alarms_grows_with_their_level() -> None:
    assert [Alarm(stamp=1, level=level, name="x").severity for level in ALARM_LEVELS] == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("level", ALARM_LEVELS)
def test_an_alarm_is_a_line_of_foxgloves_log(level: str) -> None:
    parts, companion = codec_for(Alarm).encode(Alarm(stamp=1_500_000_000, level=level, name="arm", text="too hot"))
    log = Log.FromString(b"".join(parts))
    assert (Log.Level.Name(log.level).lower(), log.name, log.message) == (level, "arm", "too hot")
    assert (log.timestamp.seconds, log.timestamp.nanos) == (1, 500_000_000)
    assert companion is None


def test_a_log_of_another_program_is_read_as_alarms() -> None:
    decode = foreign_decoder("protobuf", SchemaText("foxglove.Log", "protobuf", b""))
    assert decode is not None
    assert decode(Log(message="hello").SerializeToString(), 7) == Alarm(stamp=7, level="info", name="", text="hello")
