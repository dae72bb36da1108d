"""What is read from Unix sockets."""

from __future__ import annotations

import socket

from dataflow.process.polling import received


def test_one_that_closes_with_unread_data_is_gone_like_any_other() -> None:
    ours, theirs = socket.socketpair()
    socket.send_fds(ours, [b"request"], [ours.fileno()])
    data, (descriptor,) = received(theirs, 64, 4)
    assert data == b"request"
    socket.close(descriptor)
    theirs.send(b"an answer that nobody reads")

    ours.close()

    assert received(theirs, 64, 4) == (b"", [])
    theirs.close()
