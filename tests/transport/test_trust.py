"""A message counts only when a process of the run published it, and only the run's user can reach its sockets."""

from __future__ import annotations

import os
import socket
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
import zenoh
from transport_envelopes import carrying

from dataflow.messages import DepthImage
from dataflow.transport import Bus, Envelope, Kind, NetworkConfig, decode, encode, new_secret, reserve_endpoints
from dataflow.transport.envelope import MAGIC, PRELUDE, VERSION
from dataflow.transport.registry import RegistryError
from dataflow.transport.seal import SEALED, Seal

DEPTH = "robot1/camera/depth"
NOBODY = 65534


def depth_image(stamp: int, side: int = 4) -> DepthImage:
    return DepthImage(stamp=stamp, frame="camera", data=np.full((side, side), stamp, np.float32))


@pytest.fixture
def run(endpoint: str, eventually: Callable[..., None]) -> Iterator[tuple[Bus, Bus, deque[Any]]]:
    """Two processes of one run, as they are in a graph: a publisher's, a subscriber's, and the latter's inbox."""
    secret = new_secret()
    inbox: deque[Any] = deque()
    with (
        Bus(NetworkConfig(listen=(endpoint,), secret=secret)) as publishing,
        Bus(NetworkConfig(connect=(endpoint,), secret=secret)) as subscribing,
    ):
        subscribing.subscribe(DEPTH, inbox.append)
        publisher = publishing.publisher(DEPTH)
        eventually(lambda: bool(publisher.probe()) and bool(inbox))
        yield publishing, subscribing, inbox


@pytest.fixture
def intruder(endpoint: str, eventually: Callable[..., None]) -> Iterator[Callable[[str], zenoh.Session]]:
    """Opens Zenoh sessions of a program that is connected to a process, and has not the run's secret."""
    opened: list[zenoh.Session] = []

    def connected(to: str) -> zenoh.Session:
        session = zenoh.open(NetworkConfig(connect=(to,)).zenoh_config())
        opened.append(session)
        eventually(lambda: bool(list(session.info.peers_zid())))
        return session

    yield connected
    for session in opened:
        session.close()


def reference() -> bytes:
    head = msgpack.packb((DEPTH, 0, 5, 1, 0, ""))
    body = msgpack.packb(("0" * 16, 1, os.getpid(), 3, 0, 1 << 40, 0, 1))
    return PRELUDE.pack(MAGIC, VERSION, Kind.REFERENCE, len(head), len(body)) + head + body


FORGED = {
    "end": encode(Envelope(Kind.END, DEPTH, 0, 0, 2**62, None, "forged")),
    "frontier": encode(Envelope(Kind.FRONTIER, DEPTH, 0, 0, 2**62)),
    "last frontier": encode(Envelope(Kind.FRONTIER, DEPTH, 0, 0, 2**63 - 1)),
    "probe": encode(Envelope(Kind.PROBE, DEPTH, 0, 10**6, 0)),
    "wrong number": encode(carrying(depth_image(2**61), DEPTH, 10**6)),
    "next number": encode(carrying(depth_image(2**61), DEPTH, 0)),
    "other incarnation": encode(carrying(depth_image(2**61), DEPTH, 0, 99)),
    "reference": reference(),
    "garbage": os.urandom(50),
    "nothing": b"",
}


def test_nothing_that_is_forged_reaches_a_subscriber_and_all_of_it_is_counted(
    endpoint: str, open_bus: Callable[..., Bus], eventually: Callable[..., None]
) -> None:
    """The forger is what the subscriber connects to: nobody on the bus is nearer."""
    forger = zenoh.open(NetworkConfig(listen=(endpoint,)).zenoh_config())
    try:
        bus = open_bus(connect=(endpoint,), secret=new_secret())
        inbox: deque[Any] = deque()
        bus.subscribe(DEPTH, inbox.append)
        eventually(lambda: bool(forger.put(DEPTH, b"x")) or bus.counters()["foreign"] > 0)
        before = bus.counters()["foreign"]
        wrong = Seal(new_secret(), DEPTH)
        for payload in FORGED.values():
            forger.put(DEPTH, payload)
            forger.put(DEPTH, payload, attachment=b"")
            forger.put(DEPTH, payload, attachment=b"x" * 16)
            forger.put(DEPTH, payload, attachment=wrong.of(payload))
            forger.put(DEPTH, payload, attachment=Seal("", DEPTH).of(payload))
        eventually(lambda: bus.counters()["foreign"] >= before + 5 * len(FORGED))
        assert not inbox
        assert bus.counters()["received_messages"] == 0
    finally:
        forger.close()


def test_messages_of_the_run_arrive_among_forged_ones(
    run: tuple[Bus, Bus, deque[Any]], eventually: Callable[..., None]
) -> None:
    publishing, subscribing, inbox = run
    publisher = publishing.publisher(DEPTH)
    block = zenoh.CongestionControl.BLOCK
    for seq in range(20):
        for payload in FORGED.values():  # on the publisher's own link, so before what follows
            publishing.session.put(DEPTH, payload, congestion_control=block)
        publisher.put(carrying(depth_image(seq), DEPTH, seq))

    def messages() -> list[Any]:
        return [envelope.message for envelope in map(decode, list(inbox)) if envelope.kind is not Kind.PROBE]

    eventually(lambda: len(messages()) == 20)
    assert messages() == [depth_image(seq) for seq in range(20)]
    assert subscribing.counters()["foreign"] == 20 * len(FORGED)


def test_a_program_that_may_connect_reads_the_documented_envelope_and_cannot_reuse_its_seal(
    run: tuple[Bus, Bus, deque[Any]],
    endpoint: str,
    intruder: Callable[[str], zenoh.Session],
    eventually: Callable[..., None],
) -> None:
    publishing, subscribing, _ = run
    session = intruder(endpoint)
    seen: deque[Any] = deque()
    session.declare_subscriber(DEPTH, seen.append)
    publisher = publishing.publisher(DEPTH)
    eventually(lambda: bool(publisher.put(carrying(depth_image(1), DEPTH, 0))) and bool(seen))
    payload, seal = bytes(seen[0].payload), bytes(seen[0].attachment)
    found = [decode(bytes(sample.payload)) for sample in list(seen)]
    assert found[-1].message == depth_image(1)
    checked = Seal(subscribing.config.secret, DEPTH)
    assert checked.fits(payload, seal)
    assert not any(checked.fits(forged, seal) for forged in FORGED.values())
    assert not Seal(subscribing.config.secret, "robot1/camera/other").fits(payload, seal)


def test_a_seal_covers_the_beginning_and_differs_for_every_stream_and_run() -> None:
    secret = new_secret()
    seal = Seal(secret, DEPTH)
    payload = bytes(SEALED + 100)
    for changed in (b"\x01" + payload[1:], payload[: SEALED - 1] + b"\x01" + payload[SEALED:], payload[: SEALED - 1]):
        assert not seal.fits(changed, seal.of(payload))
    assert seal.fits(payload, seal.of(payload))
    assert len({Seal(s, d).of(payload) for s in (secret, new_secret()) for d in (DEPTH, "a/b/c")}) == 4
    assert not seal.fits(payload, seal.of(payload)[:15])


def test_a_forged_static_message_is_not_taken_for_the_runs_own(
    endpoint: str, open_bus: Callable[..., Bus], eventually: Callable[..., None]
) -> None:
    info = "robot1/camera/info"
    secret = new_secret()
    bus = open_bus(listen=(endpoint,), secret=secret)
    other = open_bus(connect=(endpoint,), secret=new_secret())
    other.declare_static(info, encode(carrying(depth_image(666), info, 0)))
    eventually(lambda: bool(bus.query_static("robot1", timeout=0.5)))
    assert bus.fetch_statics("robot1", timeout=1.0) == {}
    assert bus.counters()["foreign"] == 1
    own = open_bus(connect=(endpoint,), secret=secret)
    own.declare_static(info, encode(carrying(depth_image(3), info, 0)))
    eventually(lambda: info in bus.fetch_statics("robot1", timeout=0.5))
    assert decode(bus.fetch_statics("robot1")[info]).message == depth_image(3)


# Sockets


def sockets(endpoint: str) -> Path:
    return Path(endpoint.removeprefix("unixsock-stream/"))


def test_sockets_lie_in_a_folder_of_their_owner_and_go_with_it(open_bus: Callable[..., Bus]) -> None:
    with reserve_endpoints(3) as reserved:
        assert len(set(reserved.endpoints)) == 3
        open_bus(listen=reserved.endpoints).close()
        folder = sockets(reserved.endpoints[0]).parent
        assert (folder.stat().st_mode & 0o777, folder.stat().st_uid) == (0o700, os.getuid())
    assert not folder.exists()


def test_a_path_too_long_for_a_socket_is_replaced_by_the_temporary_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, open_bus: Callable[..., Bus]
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / ("long" * 20)))
    with reserve_endpoints(1) as reserved:
        folder = sockets(reserved.endpoints[0]).parent
        assert folder.parent.name == f"dataflow-{os.getuid()}"
        assert folder.stat().st_mode & 0o777 == 0o700
        open_bus(listen=reserved.endpoints).close()


def test_sockets_that_a_killed_run_left_are_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from dataflow.transport.registry import registry_folder, running

    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    left = registry_folder() / "999999999-abcd.run"
    left.mkdir(mode=0o700)
    (left / "0").touch()
    assert running() == []
    assert not left.exists()


def test_a_folder_of_somebody_else_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    folder = tmp_path / "dataflow"
    folder.mkdir(mode=0o700)
    if os.getuid() != 0:
        pytest.skip("only root can make a folder for somebody else")
    os.chown(folder, NOBODY, NOBODY)
    with pytest.raises(RegistryError, match=f"belongs to {NOBODY}"):
        reserve_endpoints(1)


@pytest.mark.skipif(os.getuid() != 0, reason="only root can act as another user")
def test_another_user_can_neither_connect_nor_listen(open_bus: Callable[..., Bus]) -> None:
    with reserve_endpoints(2) as reserved:
        path, free = map(sockets, reserved.endpoints)
        open_bus(listen=reserved.endpoints[:1])
        path.chmod(0o777)  # whatever the socket's own mode, its folder keeps others out
        with socket.socket(socket.AF_UNIX) as own:
            own.connect(str(path))
        assert as_nobody(lambda s: s.connect(str(path))) == "PermissionError"
        assert as_nobody(lambda s: s.bind(str(free))) == "PermissionError"


def as_nobody(act: Callable[[socket.socket], object]) -> str:
    """What another user's process meets that does `act` with a Unix socket: the error's name, or nothing."""
    reading, writing = os.pipe()
    pid = os.fork()
    if pid == 0:
        said = ""
        try:
            os.setgid(NOBODY)
            os.setuid(NOBODY)
            act(socket.socket(socket.AF_UNIX))
        except OSError as error:
            said = type(error).__name__
        finally:
            os.write(writing, said.encode())
            os._exit(0)
    os.close(writing)
    os.waitpid(pid, 0)
    with os.fdopen(reading) as pipe:
        return pipe.read()
