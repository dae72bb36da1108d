"""Only the user of a run can reach its sockets."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable
from pathlib import Path

import pytest

from dataflow.transport import Bus, Reservation
from dataflow.transport.registry import RegistryError

DEPTH = "robot1/camera/depth"
NOBODY = 65534


# Sockets


def sockets(endpoint: str) -> Path:
    return Path(endpoint.removeprefix("unixsock-stream/"))


def test_sockets_lie_in_a_private_folder_removed_at_the_end(open_bus: Callable[..., Bus]) -> None:
    with Reservation(3) as reserved:
        assert len(set(reserved.endpoints)) == 3
        open_bus(listen=reserved.endpoints).close()
        folder = sockets(reserved.endpoints[0]).parent
        assert (folder.stat().st_mode & 0o777, folder.stat().st_uid) == (0o700, os.getuid())
    assert not folder.exists()


def test_a_path_too_long_for_a_socket_is_replaced_by_the_temporary_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, open_bus: Callable[..., Bus]
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / ("long" * 20)))
    with Reservation(1) as reserved:
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


def test_folder_of_another_user_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    folder = tmp_path / "dataflow"
    folder.mkdir(mode=0o700)
    if os.getuid() != 0:
        pytest.skip("only root can make a folder for somebody else")
    os.chown(folder, NOBODY, NOBODY)
    with pytest.raises(RegistryError, match=f"belongs to {NOBODY}"):
        Reservation(1)


@pytest.mark.skipif(os.getuid() != 0, reason="only root can act as another user")
def test_another_user_can_neither_connect_nor_listen(open_bus: Callable[..., Bus]) -> None:
    with Reservation(2) as reserved:
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
