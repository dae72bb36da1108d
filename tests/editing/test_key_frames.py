"""Key frames are found for every start, and a packet is read once however many starts there are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from example_messages import example
from made_video import PERIOD, clip

from dataflow.editing.key_frames import key_frames
from dataflow.messages import CompressedVideo, Imu
from dataflow.recording import RecordingWriter
from dataflow.recording.streams.copying import Origin
from dataflow.video.decoder import is_key

FIRST = 10**9
STARTS = range(FIRST - PERIOD, FIRST + 40 * PERIOD, PERIOD // 2)


def test_the_last_key_frame_up_to_each_start_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    groups, keys, packets = {"v/front": 8, "v/rear": 5}, dict[str, list[int]](), 0
    with RecordingWriter(tmp_path / "video.mcap", metadata={}, namespace="v") as writer:
        writer.add_stream("v/imu", Imu)
        writer.write("v/imu", example(Imu).replace(stamp=FIRST), seq=0)
        for name, group in groups.items():
            writer.add_stream(name, CompressedVideo)
            for k, packet in enumerate(clip("h264", group=group)):
                data = np.frombuffer(packet, np.uint8)
                writer.write(
                    name, CompressedVideo(stamp=FIRST + k * PERIOD, frame=name, format="h264", data=data), seq=k
                )
                packets += 1
                if is_key("h264", packet):
                    keys.setdefault(name, []).append(FIRST + k * PERIOD)
    reads: list[tuple[int, ...]] = []
    with Origin(tmp_path / "video.mcap") as origin:
        read = origin.file.read
        monkeypatch.setattr(origin.file, "read", lambda *place: reads.append(place) or read(*place))
        found = key_frames([origin], list(STARTS))
    before = {s: {name: [k for k in keys[name] if k <= s] for name in groups} for s in STARTS}
    assert found == [{name: max(known) for name, known in before[s].items() if known} for s in STARTS]
    assert len(reads) == len(set(reads)) <= packets
