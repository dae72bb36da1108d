"""Makes a recording of many days, and measures how it opens, seeks and verifies its last minute.

python benchmarks/long_recording.py make LONG.mcap --chunks 10000000
python benchmarks/long_recording.py measure LONG.mcap

A source of 2 Hz and an operator with a state, flushed after each message: two chunks every half second. The first 100 s
and the
last hour are as a run writes them; in between, digests in the firing records are zero, so that only these verify.
"""

from __future__ import annotations

import argparse
import resource
import struct
import subprocess
import sys
import tempfile
import time
import zlib
from pathlib import Path

from long_recording_operators import EPOCH, PERIOD, numbered
from mcap.opcode import Opcode
from mcap.records import ChunkIndex

from dataflow.firing.snapshots import pack_state
from dataflow.messages import FeatureVector
from dataflow.recording import Recording, RecordingWriter
from dataflow.recording.codecs import codec_for
from dataflow.recording.layout import RESERVED_METADATA
from dataflow.recording.seals import sealed
from dataflow.records.firing import Emission, FiringRecord, decode_batch, encode_batch, encode_single
from dataflow.sync import FOREVER, MessageRef
from dataflow.verification.verify import verify

GRAPH = """\
graph: long
namespace: g
operators:
  pulse: {use: "long_recording_operators:Pulse"}
  sum: {use: "long_recording_operators:Sum", inputs: {x: pulse/out}}
record: {snapshots: 10s}
"""
SOURCE, SUM = "g/pulse/out", "g/sum/out"
TRUE_HEAD, TRUE_TAIL, SNAPSHOT_EVERY = 200, 7200, 20
"""Messages that are as a run makes them, and between two snapshots there."""


def record_seed(folder: Path) -> Path:
    """A run of the graph, for its metadata and the records of `setup()`."""
    (folder / "long.yaml").write_text(GRAPH)
    out = folder / "seed.mcap"
    command = [str(Path(sys.executable).with_name("dataflow")), "run", str(folder / "long.yaml"), "--record", str(out)]
    environment = {"PATH": "/usr/bin:/bin", "PYTHONPATH": str(Path(__file__).resolve().parent)}
    subprocess.run(command, check=True, timeout=120, env=environment, stdout=subprocess.DEVNULL)
    return out


class Maker:
    """Writes the run step by step; `records` counts what each operator's log holds."""

    def __init__(self, out: Path, seed: Path) -> None:
        with Recording(seed) as recording:
            metadata = {n: v for n, v in recording.metadata.items() if n not in RESERVED_METADATA}
            setups = dict(reversed(list(recording.firings())))
            extras = {name: recording.streams[name].metadata for name in (SOURCE, SUM)}
        self.writer = RecordingWriter(out, metadata=metadata, namespace="g", overwrite=True)
        for stream in (SOURCE, SUM):
            self.writer.add_stream(
                stream, FeatureVector, extra={key: extras[stream][key] for key in ("operator", "port")}
            )
        self.index = {"pulse": 0, "sum": 0}
        for name, payload in setups.items():
            self.writer.write_firings(name, EPOCH, encode_batch([decode_batch(payload).records[0]]))
            self.index[name] = 1

    def write(self, k: int) -> None:
        """Message `k` and what follows from it, as a run writes them."""
        stamp = EPOCH + k * PERIOD
        for operator, payload in self.records(k, true=True):
            self.writer.write_firings(operator, stamp, payload)
        self.writer.write(SOURCE, numbered(stamp, k % 1000), seq=k)
        self.writer.write(SUM, numbered(stamp, (k + 1) % 1000), seq=k)
        self.writer.flush()

    def fill(self, begin: int, end: int) -> None:
        """Messages `begin` to `end` - 1: the chunks that a run writes, without its compression and true digests."""
        file = self.writer._file
        streams = [self.writer._streams[name].channel for name in (SOURCE, SUM)]
        logs = [self.writer._firings[name][0] for name in ("pulse", "sum")]
        body = bytes(codec_for(FeatureVector).encode(numbered(EPOCH, 0))[0][0])
        for k in range(begin, end):
            stamp = EPOCH + k * PERIOD
            records = [payload for _, payload in self.records(k, true=False)]
            parts, indexes, position = [], [], file.saved_bytes
            for channels, bodies in ((logs, records), (streams, [body, body])):
                data, index = chunk(position, channels, bodies, k % 2**32, stamp)
                parts.append(data)
                indexes.append(index)
                position += len(data)
            file._append(b"".join(parts))
            file._chunks.add(indexes)
            for channel in (*streams, *logs):
                file._counts[channel] += 1
        for name in (SOURCE, SUM):
            stream = self.writer._streams[name]
            stream.last_seq, stream.last_stamp = end - 1, EPOCH + (end - 1) * PERIOD

    def records(self, k: int, *, true: bool) -> list[tuple[str, bytes]]:
        """The firing records of message `k`."""
        stamp = EPOCH + k * PERIOD
        digests = [numbered(stamp, n % 1000).digest() for n in (k, k + 1)] if true else [bytes(16)] * 2
        records = [
            FiringRecord("pulse", 0, self.index["pulse"], "fire", stamp, outputs=(Emission(k, stamp, digests[0]),)),
            FiringRecord(
                "sum",
                0,
                self.index["sum"],
                "fire",
                stamp,
                inputs={"x": MessageRef(SOURCE, 0, k)},
                outputs=(Emission(k, stamp, digests[1]),),
            ),
        ]
        for record in records:
            self.index[record.operator] += 1
        found = [(record.operator, encode_single(record)) for record in records]
        if true and k % SNAPSHOT_EVERY == 0:
            state = {"state": pack_state({"calls": k + 1})}
            snapshot = FiringRecord("sum", 0, self.index["sum"], "snapshot", stamp, detail=state)
            found.append(("sum", encode_batch([snapshot])))
            self.index["sum"] += 1
        return found


def chunk(
    position: int, channels: list[int], bodies: list[bytes], sequence: int, stamp: int
) -> tuple[bytes, ChunkIndex]:
    """A chunk of a message on each channel with its message indexes, as it lies at `position`, and its index."""
    content, offsets = b"", []
    for channel, body in zip(channels, bodies, strict=True):
        offsets.append(len(content))
        content += struct.pack("<BQHIQQ", Opcode.MESSAGE, 22 + len(body), channel, sequence, stamp, stamp) + body
    head = struct.pack("<BQQQQI", Opcode.CHUNK, 40 + len(content), stamp, stamp, len(content), zlib.crc32(content))
    data = head + struct.pack("<IQ", 0, len(content)) + content
    length, places = len(data), {}
    for channel, offset in zip(channels, offsets, strict=True):
        places[channel] = position + len(data)
        data += sealed(struct.pack("<BQHIQQ", Opcode.MESSAGE_INDEX, 22, channel, 16, stamp, offset))
    return data, ChunkIndex(
        chunk_length=length,
        chunk_start_offset=position,
        compression="",
        compressed_size=len(content),
        message_end_time=stamp,
        message_index_length=len(data) - length,
        message_index_offsets=places,
        message_start_time=stamp,
        uncompressed_size=len(content),
    )


def make(out: Path, chunks: int) -> None:
    """Writes the recording."""
    messages = chunks // 2
    with tempfile.TemporaryDirectory() as folder:
        maker = Maker(out, record_seed(Path(folder)))
    tail = max(TRUE_HEAD, messages - TRUE_TAIL)
    began = time.monotonic()
    with maker.writer:
        for k in range(TRUE_HEAD):
            maker.write(k)
        maker.fill(TRUE_HEAD, tail)
        for k in range(tail, messages):
            maker.write(k)
        final = EPOCH + messages * PERIOD
        for name in ("pulse", "sum"):
            last = FiringRecord(name, 0, maker.index[name], "finish", FOREVER, outputs=(None,))
            maker.writer.write_firings(name, final, encode_batch([last], last=True))
    size, taken = out.stat().st_size / 1e9, time.monotonic() - began
    print(f"{2 * messages:,} chunks, {messages * PERIOD * 1e-9 / 86400:.1f} days, {size:.2f} GB, made in {taken:.0f} s")


def measure(path: Path) -> None:
    """Prints what opening, seeking and verifying the last minute take."""
    began = time.monotonic()
    with Recording(path) as recording:
        print(f"open            {time.monotonic() - began:6.2f} s, {peak()} MB")
        info = recording.streams[SUM]
        assert info.first is not None
        assert info.last is not None
        for share in (0.5, 0.001, 0.999):
            stamp = info.first + round(share * (info.last - info.first))
            began = time.monotonic()
            found = next(iter(recording.messages([SUM], start=stamp)))
            assert 0 <= found.stamp - stamp <= PERIOD
            print(f"seek to {share:6.1%}  {time.monotonic() - began:6.2f} s, {peak()} MB")
        start = (info.last - info.first) * 1e-9 - 60
    began = time.monotonic()
    report = verify(path, start=start)
    assert report.identical, report
    verified = sum(operator.verified for operator in report.operators)
    workers = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss // 1024
    print(f"verify last min {time.monotonic() - began:6.2f} s, {verified} firings, {peak()} MB, a worker {workers} MB")


def peak() -> int:
    """Peak memory of this process so far, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["make", "measure"])
    parser.add_argument("path", type=Path)
    parser.add_argument("--chunks", type=int, default=10_000_000)
    options = parser.parse_args()
    if options.what == "make":
        make(options.path, options.chunks)
    else:
        measure(options.path)


if __name__ == "__main__":
    main()
