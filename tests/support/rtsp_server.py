"""A camera of the network: serves JPEG images over RTSP (RFC 2326), interleaved, as RTP (RFC 2435), on loopback."""

from __future__ import annotations

import socket
import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import cv2
import numpy as np

SDP = "v=0\r\no=- 0 0 IN IP4 127.0.0.1\r\ns=made\r\nt=0 0\r\nm=video 0 RTP/AVP 26\r\na=control:track\r\n"


def shade(number: int) -> int:
    """The grey of image `number`."""
    return 40 + 10 * (number % 20)


def _jpeg(number: int, width: int, height: int) -> tuple[bytes, bytes]:
    """Quantization tables and entropy-coded data of an image of one grey."""
    grey = np.full((height, width, 3), shade(number), np.uint8)
    data = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes()
    tables, at = b"", 2
    while data[at + 1] != 0xDA:
        (length,) = struct.unpack(">H", data[at + 2 : at + 4])
        if data[at + 1] == 0xDB:
            tables += b"".join(data[k + 1 : k + 65] for k in range(at + 4, at + 2 + length, 65))
        at += 2 + length
    (length,) = struct.unpack(">H", data[at + 2 : at + 4])
    return tables, data[at + 2 + length : -2]


def _packets(number: int, width: int, height: int) -> Iterator[bytes]:
    """RTP packets of image `number`, each behind its interleaving header."""
    tables, data = _jpeg(number, width, height)
    for start in range(0, len(data), 1200):
        part = data[start : start + 1200]
        last = start + 1200 >= len(data)
        header = struct.pack(">BBHII", 0x80, 26 | (last << 7), (number * 50 + start // 1200) % 65536, number * 3000, 7)
        header += struct.pack(">B", 0) + start.to_bytes(3, "big") + bytes((1, 255, width // 8, height // 8))
        if start == 0:
            header += struct.pack(">BBH", 0, 0, len(tables)) + tables
        yield b"$\0" + struct.pack(">H", len(header) + len(part)) + header + part


def _serve(client: socket.socket, images: range, width: int, height: int) -> None:
    """Answers one client until it plays, then sends the images and hangs up."""
    with client, client.makefile("rb") as lines:
        while request := lines.readline().decode():
            headers = {}
            while (line := lines.readline().decode().strip()) != "":
                name, _, value = line.partition(":")
                headers[name.lower()] = value.strip()
            verb = request.split()[0]
            answer = [f"CSeq: {headers['cseq']}", "Session: 1"]
            answer += ["Public: OPTIONS, DESCRIBE, SETUP, PLAY"] if verb == "OPTIONS" else []
            answer += ["Transport: RTP/AVP/TCP;unicast;interleaved=0-1"] if verb == "SETUP" else []
            body = SDP if verb == "DESCRIBE" else ""
            answer += ["Content-Type: application/sdp", f"Content-Length: {len(body)}"] if body else []
            client.sendall(("\r\n".join(["RTSP/1.0 200 OK", *answer]) + "\r\n\r\n" + body).encode())
            if verb == "PLAY":
                for number in images:
                    for packet in _packets(number, width, height):
                        client.sendall(packet)
                return


@contextmanager
def camera(*runs: range, width: int = 64, height: int = 48) -> Iterator[str]:
    """The address of a camera that sends one run of images to each client in turn, hanging up after each."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(30)

        def serve() -> None:
            for images in runs:
                try:
                    client, _ = server.accept()
                    _serve(client, images, width, height)
                except OSError:  # the test has ended, or the client has gone
                    continue

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield f"rtsp://127.0.0.1:{server.getsockname()[1]}/stream"
    thread.join(timeout=5)
